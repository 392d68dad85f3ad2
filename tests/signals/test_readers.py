"""Tables to recordings: the clock, the columns, the rows, and the recordings measured elsewhere."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from logs import as_expected, lines, refusal, signals, written

from servoscope.core.errors import LoopError, RecordingError
from servoscope.models.loop import Columns, Loop
from servoscope.signals import Recording
from servoscope.signals.readers import list_channels, read, read_parts
from servoscope.signals.readers.formats import open_file

CRANFIELD = Columns(
    time="time",
    reference="set_point",
    input="current",
    output="set_point - position_error",
    segment=("group",),
)
EHA_PUMP = Columns(
    time="time",
    time_unit="ms",
    reference="0.025*ADC1_Channel_13",
    input="ADC1_Channel_8",
    output="0.025*ADC1_Channel_14",
)


@pytest.fixture
def loop(rig: dict[str, Any]) -> Loop:
    return Loop.from_dict(rig)


# Time


def test_the_clock_may_be_missing_if_the_loop_knows_the_rate(tmp_path: Path, loop: Loop) -> None:
    path = written(tmp_path, [row.split(",", 1)[1] for row in lines()])
    recording = read(path, loop)
    assert [defect.kind for defect in recording.defects] == ["clock"]
    np.testing.assert_allclose(recording.t, signals()["t"])
    assert "--rate 200" in refusal(path)
    assert read(written(tmp_path, lines()), loop, columns=Columns(time=None)).defects[0].kind == "clock"
    assert "--rate 200" in refusal(path, columns=Columns(time=None))


def test_a_clock_of_another_name_is_not_ignored(tmp_path: Path, loop: Loop) -> None:
    path = written(tmp_path, ["Time [s],r,u,y", *lines()[1:]])
    assert "no column 't', is it 'Time [s]'? then say so in [columns] time" in refusal(path, loop)


def test_a_clock_that_was_asked_for_must_exist(tmp_path: Path, loop: Loop) -> None:
    path = written(tmp_path, lines())
    assert "no column 'stamp'" in refusal(path, loop, columns=Columns(time="stamp"))


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9), ("min", 1 / 60)])
def test_units_of_time(tmp_path: Path, unit: Any, factor: float) -> None:
    as_expected(read(written(tmp_path, lines(t=signals()["t"] * factor)), columns=Columns(time_unit=unit)))


def test_a_forgotten_unit_is_guessed_aloud(tmp_path: Path, loop: Loop) -> None:
    assert 'time_unit = "ms"' in refusal(written(tmp_path, lines(t=signals()["t"] * 1e3)), loop)


@pytest.mark.parametrize(("separator", "zone"), [("T", ""), (" ", ""), ("T", "Z"), ("T", "+02:00")])
def test_date_and_time_count_from_the_first_row(tmp_path: Path, separator: str, zone: str) -> None:
    stamps = np.datetime64("2024-02-29T23:59:59.000") + np.round(signals()["t"] * 1e3).astype("timedelta64[ms]")
    path = written(tmp_path, lines(t=[str(stamp).replace("T", separator) + zone for stamp in stamps]))
    as_expected(read(path))


def test_a_sample_rate_that_differs_is_refused(tmp_path: Path, loop: Loop) -> None:
    text = refusal(written(tmp_path, lines(t=signals()["t"] / 2)), loop)
    assert "sampled at 200 Hz, the loop says 100 Hz" in text


def test_text_in_the_time_column_is_named(tmp_path: Path) -> None:
    assert "row 2, column 't': 'start'" in refusal(written(tmp_path, lines(t=["start", *signals()["t"][1:]])))


# Columns


def test_combinations_of_channels(tmp_path: Path) -> None:
    path = written(tmp_path, lines(e=signals()["r"] - signals()["y"]))
    recording = read(path, columns=Columns(output="r - e", input="-2*(u + 1)/4"))
    np.testing.assert_allclose(recording.y, signals()["y"], atol=1e-12)
    np.testing.assert_allclose(recording.u, -(signals()["u"] + 1.0) / 2.0)


def test_odd_names_stand_in_backticks_or_alone(tmp_path: Path) -> None:
    path = written(tmp_path, ["t,set point,motor-current [A],y", *lines()[1:]])
    as_expected(read(path, columns=Columns(reference="set point", input="2 * `motor-current [A]` / 2")))


def test_a_product_of_channels_is_refused(tmp_path: Path) -> None:
    assert "only sums of channels" in refusal(written(tmp_path, lines()), columns=Columns(input="u*y"))


def test_constant_channels_are_named_with_their_column(tmp_path: Path) -> None:
    path = written(tmp_path, lines(flat=[1] * 300))
    assert "y ('flat') is constant: 1 in all 300 rows" in refusal(path, columns=Columns(output="flat"))


def test_swapped_columns_are_refused(tmp_path: Path) -> None:
    assert "swap the two columns" in refusal(written(tmp_path, lines()), columns=Columns(input="y", output="u"))


def test_a_segment_column_starts_runs(tmp_path: Path) -> None:
    path = written(tmp_path, lines(cycle=["a"] * 100 + ["b"] * 200))
    recording = read(path, columns=Columns(segment=("cycle",)))
    assert recording.restart.nonzero()[0].tolist() == [0, 100]
    assert "no column 'cycel', did you mean cycle?" in refusal(path, columns=Columns(segment=("cycel",)))


def test_rows_are_chosen_by_value_list_and_range(tmp_path: Path) -> None:
    path = written(tmp_path, lines(load=np.repeat([-40, 20, 40], 100), kind=["a"] * 150 + ["b"] * 150))
    assert read(path, where={"load": "20"}).samples == 100
    assert read(path, where={"load": "-40, 20"}).samples == 200
    assert read(path, where={"load": "-40-20"}).samples == 200
    assert read(path, where={"load": "20", "kind": "b"}).samples == 50
    assert "load takes -40, 20, 40" in refusal(path, where={"load": "99"})
    assert "neither a number nor a range" in refusal(path, where={"load": "heavy"})
    assert "no row meets all" in refusal(path, where={"load": "-40", "kind": "b"})
    assert "no column 'laod', did you mean load?" in refusal(path, where={"laod": "20"})


def test_parts_come_by_value(tmp_path: Path) -> None:
    path = written(tmp_path, lines(batch=np.repeat([2, 1, 3], 100)))
    parts = read_parts(path, by="batch")
    assert [part.name for part in parts] == ["x.csv[batch=2]", "x.csv[batch=1]", "x.csv[batch=3]"]
    assert [part.samples for part in parts] == [100] * 3
    assert [part.name for part in read_parts(path)] == ["x.csv"]
    with pytest.raises(RecordingError, match="by: no column 'bach', did you mean batch"):
        read_parts(path, by="bach")


def test_limits_of_the_loop_count_saturation(tmp_path: Path, rig: dict[str, Any]) -> None:
    u = np.clip(signals()["u"], -10.0, 0.05)
    recording = read(written(tmp_path, lines(u=u)), Loop.from_dict(rig | {"input_limits": [-10.0, 0.05]}))
    assert {defect.kind for defect in recording.defects} == {"saturation"}


# Channels


def test_channels_are_listed_with_their_ranges(tmp_path: Path) -> None:
    path = written(tmp_path, lines(note=["a"] * 300, flag=[1, 0] * 150))
    found = {info.name: info for info in list_channels(path)}
    assert list(found) == ["t", "r", "u", "y", "note", "flag"]
    assert (found["t"].min, found["t"].max) == (0.0, 2.99)
    assert np.isnan(found["note"].min)
    assert found["flag"].dtype == "int64"


# Measured recordings


def no_spikes(recording: Recording) -> None:
    assert {defect.kind for defect in recording.defects} <= {"saturation"}, recording.name


def test_every_measured_csv_is_sound(shared_data: Path) -> None:
    for path in sorted((shared_data / "real" / "eha_pump").glob("*.csv")):
        recording = read(path, columns=EHA_PUMP)
        no_spikes(recording)
        assert (recording.samples, recording.sample_rate) == (31000, 1000.0)
        assert recording.duration_s == pytest.approx(31.0)
    for path in sorted((shared_data / "real" / "qube").glob("*.csv")):
        for angle in ("theta", "alpha"):
            recording = read(path, columns=Columns(reference=f"target_{angle}", input="plant_input", output=angle))
            no_spikes(recording)
            assert (recording.samples, recording.sample_rate) == (10000, 500.0)


def test_the_measured_mat_file_is_sound(shared_data: Path) -> None:
    path = shared_data / "real" / "emps" / "DATA_EMPS.mat"
    recording = read(path, columns=Columns(reference="qg", input="35.15 * vir", output="qm"))
    no_spikes(recording)
    assert (recording.samples, recording.sample_rate) == (24841, 1000.0)
    assert "no column 'VIR', did you mean vir?" in refusal(path, columns=Columns(reference="qg", input="VIR"))


def test_the_measured_cycles_are_runs(shared_data: Path) -> None:
    for path in sorted((shared_data / "real" / "cranfield").glob("*.csv")):
        parts = read_parts(path, columns=CRANFIELD, where={"load": "20"}, by="run")
        assert [part.name for part in parts] == [f"{path.name}[run={run}]" for run in range(1, 11)]
        for part in parts:
            no_spikes(part)
            assert (part.samples, part.sample_rate) == (1620, 25.0)
            assert part.duration_s == pytest.approx(64.8)
            assert np.bincount(part.run).tolist() == [324] * 5


def test_measured_loops_with_swapped_columns_are_refused(shared_data: Path) -> None:
    real = shared_data / "real"
    swapped = Columns(reference="qg", input="qm", output="vir")
    assert "swap the two columns" in refusal(real / "emps" / "DATA_EMPS.mat", columns=swapped)
    swapped = EHA_PUMP.model_copy(update={"input": EHA_PUMP.output, "output": EHA_PUMP.input})
    assert "swap the two columns" in refusal(real / "eha_pump" / "exp_data_1_3.csv", columns=swapped)


def test_the_simulated_cases_are_read_as_numpy_reads_them(eha_cases: Path, loop: Loop) -> None:
    for path in sorted(eha_cases.glob("*healthy_*.csv")):
        table = np.genfromtxt(path, delimiter=",", names=True)
        recording = read(path, loop)
        assert recording.defects == ()
        for key in "truy":
            np.testing.assert_allclose(getattr(recording, key), table[key], rtol=0, atol=1e-15)


def test_a_bad_combination_is_an_error_of_the_loop(tmp_path: Path) -> None:
    with pytest.raises(LoopError):
        read(written(tmp_path, lines()), columns=Columns(input="sin(u)"))


@pytest.mark.parametrize("rows", [1, 3, 40])
def test_the_names_of_thousands_of_columns_are_read_whole(tmp_path: Path, rows: int) -> None:
    names = ["t", *(f"valve block {k} pressure" for k in range(3500))]  # 80 kB
    row = ",".join(["0.5"] * len(names))
    path = tmp_path / "wide.csv"
    path.write_text("\n".join([",".join(names), *[row] * rows]) + "\n", encoding="utf-8")
    assert open_file(path).columns == tuple(names)
