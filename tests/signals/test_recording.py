"""Dirty data: what is dropped, what is told, what is refused, and what must be left alone."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from dirty import RATE, cleaned, only, refusal, signals, without
from hypothesis import given
from hypothesis import strategies as st

from servoscope.core.errors import NotEnoughError, RecordingError


def test_a_sound_log_stays_as_it_is() -> None:
    data = signals()
    recording = cleaned(data)
    assert recording.defects == ()
    assert recording.samples == 2000
    assert recording.duration_s == pytest.approx(20.0)
    assert recording.restart.nonzero()[0].tolist() == [0]
    assert recording.run.dtype == np.int32
    for key in "truy":
        np.testing.assert_array_equal(getattr(recording, key), data[key])


def test_the_dirty_recording_tells_each_of_its_defects(eha_cases: Path) -> None:
    table = np.genfromtxt(eha_cases / "dirty_healthy.csv", delimiter=",", names=True)
    recording = cleaned({key: table[key] for key in "truy"})
    told = [(d.kind, round(d.from_s, 6), round(d.to_s, 6), d.count) for d in recording.defects]
    assert told == [
        ("nan", 8.99, 8.99, 1),
        ("repeat", 14.98, 14.98, 1),
        ("gap", 14.99, 15.0, 1),
        ("gap", 20.0, 20.37, 37),
        ("order", 30.36, 30.37, 2),
        ("spike", 40.36, 40.36, 1),
    ]
    np.testing.assert_allclose(recording.t[recording.restart], [0.0, 9.0, 15.0, 20.37, 40.37])
    assert np.abs(recording.y).max() < 0.1


def test_the_simulated_recordings_have_no_defects(eha_cases: Path) -> None:
    files = [path for path in sorted(eha_cases.glob("*.csv")) if path.name != "dirty_healthy.csv"]
    assert len(files) > 10
    for path in files:
        table = np.genfromtxt(path, delimiter=",", names=True)
        assert cleaned({key: table[key] for key in "truy"}).defects == (), path.name


def test_a_row_with_a_nan_is_dropped_whole() -> None:
    data = signals()
    data["u"][500:503] = np.nan
    recording = cleaned(data)
    defect = only(recording, "nan")
    assert (defect.from_s, defect.to_s, defect.count) == (5.0, 5.02, 3)
    assert "u" in defect.message
    assert recording.samples == 1997
    assert recording.t[recording.restart].tolist() == [0.0, 5.03]


def test_infinity_is_no_number_either() -> None:
    data = signals()
    data["y"][500] = np.inf
    assert only(cleaned(data), "nan").count == 1


def test_one_missing_row_is_a_gap() -> None:
    recording = cleaned(without(signals(), 700))
    defect = only(recording, "gap")
    assert (defect.from_s, defect.to_s, defect.count) == (7.0, 7.01, 1)
    assert recording.t[recording.restart].tolist() == [0.0, 7.01]


def test_a_gap_beside_a_nan_counts_only_the_rows_that_the_file_lacks() -> None:
    data = signals()
    data["r"][700] = np.nan
    recording = cleaned(without(data, [701, 702]))
    assert [(d.kind, d.count) for d in recording.defects] == [("nan", 1), ("gap", 2)]
    assert recording.t[recording.restart].tolist() == [0.0, 7.03]


@pytest.mark.parametrize("channel", "uy")
def test_a_constant_channel_is_refused(channel: str) -> None:
    assert f"{channel} is constant: 0.5 in all 2000 rows" in refusal(signals() | {channel: np.full(2000, 0.5)})


def test_a_channel_constant_but_for_its_spike_is_refused() -> None:
    data = signals()
    data["y"][:] = 0.5
    data["y"][1000] = 9999.0
    assert "y is constant" in refusal(data)


def test_a_constant_reference_is_accepted() -> None:
    data = signals()
    data["r"][:] = 0.0
    assert cleaned(data).samples == 2000


@pytest.mark.parametrize("channel", "ruy")
def test_a_channel_of_nan_is_refused(channel: str) -> None:
    assert f"{channel} holds no numbers" in refusal(signals() | {channel: np.full(2000, np.nan)})


def test_no_rows_are_refused() -> None:
    assert "holds no rows" in refusal({key: x[:0] for key, x in signals().items()})


def test_too_few_rows_are_refused() -> None:
    with pytest.raises(NotEnoughError, match="19 usable rows are too few"):
        cleaned({key: x[:19] for key, x in signals().items()})


def test_runs_of_a_few_rows_are_refused() -> None:
    with pytest.raises(NotEnoughError, match="400 runs of about 5 rows"):
        cleaned(signals(), run=np.arange(2000) // 5)


def test_mostly_nan_is_refused() -> None:
    data = signals()
    data["y"][np.arange(2000) % 3 != 0] = np.nan
    assert "too little to use" in refusal(data)


def test_columns_of_unequal_length_are_refused() -> None:
    assert "equal length" in refusal(signals() | {"y": np.zeros(10)})


def test_u_and_y_swapped_are_refused() -> None:
    data = signals()
    data["u"], data["y"] = data["y"], data["u"]
    assert "swap the two columns" in refusal(data)


def test_errors_use_the_names_of_the_columns() -> None:
    text = refusal(signals() | {"y": np.zeros(2000)}, labels=("r", "u ('vir')", "y ('qm')"))
    assert "y ('qm') is constant" in text


def test_u_at_its_limits_is_kept_and_told() -> None:
    data = signals()
    data["u"] = np.clip(data["u"], -0.1, 0.1)
    recording = cleaned(data, limits=(-0.1, 0.1))
    assert recording.samples == 2000
    assert {defect.kind for defect in recording.defects} == {"saturation"}
    assert sum(defect.count for defect in recording.defects) == int((np.abs(data["u"]) >= 0.1).sum())


def test_many_events_are_summed_up() -> None:
    data = signals(20000)
    data["y"][10::40] = np.nan
    recording = cleaned(data)
    assert len(recording.defects) == 100
    assert sum(defect.count for defect in recording.defects) == 500
    assert "more like the one before" in recording.defects[-1].message


def test_a_part_restarts_and_keeps_its_own_defects() -> None:
    data = signals()
    data["y"][[500, 1500]] = np.nan
    part = cleaned(data).part(10.0, 20.0)
    assert part.samples == 999
    assert part.restart.nonzero()[0].tolist() == [0, 500]
    assert [defect.from_s for defect in part.defects] == [15.0]


def test_a_part_without_rows_is_refused() -> None:
    with pytest.raises(RecordingError, match=r"nothing from 30 to 40 s, it spans 0 to 19\.99 s"):
        cleaned(signals()).part(30.0, 40.0)


def test_recordings_are_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        cleaned(signals()).name = "y"  # type: ignore[misc]


@given(st.lists(st.integers(1, 398), max_size=40, unique=True), st.integers(0, 2**32 - 1))
def test_lost_rows_never_move_the_others(lost: list[int], seed: int) -> None:
    data = signals(400)
    rng = np.random.default_rng(seed)
    nan = [row for row in lost if rng.random() < 0.5]
    gone = sorted(set(lost) - set(nan))
    data["u"][nan] = np.nan
    recording = cleaned(without(data, gone))
    rows = np.round(recording.t * RATE).astype(int)
    assert rows.tolist() == sorted(set(range(400)) - set(lost))
    np.testing.assert_array_equal(recording.y, data["y"][rows])
    np.testing.assert_array_equal(recording.restart[1:], np.diff(rows) > 1)
    assert sum(defect.count for defect in recording.defects) == len(lost)
