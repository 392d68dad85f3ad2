"""Measurement files, MDF and TDMS: the same recording as from a table, piece by piece; broken ones are refused."""

from __future__ import annotations

import gc
import json
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from commands import run
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from servoscope.core.errors import RecordingError
from servoscope.models.loop import Columns
from servoscope.signals import readers
from servoscope.signals.readers import mdf_tdms
from servoscope.signals.readers.formats import open_file
from servoscope.signals.readers.guess_columns import guess_columns, guess_mapping

N, RATE = 5000, 100.0
T = np.arange(N) / RATE
SIGNALS = {name: np.random.default_rng(k).normal(size=N) for k, name in enumerate(("SetPoint", "ValveCurrent", "Pos"))}
COLUMNS = Columns(time="time", reference="SetPoint", input="0.5 * ValveCurrent", output="Pos")


def write_mdf(path: Path, times: int = 1) -> None:
    from asammdf import MDF, Signal

    t = np.arange(N * times) / RATE
    with MDF(version="4.10") as file:
        file.append([Signal(np.tile(x, times), t, name=name) for name, x in SIGNALS.items()])
        file.append([Signal(np.arange(9.0), np.arange(9.0), name="Temperature")])
        file.save(path, overwrite=True)


def write_tdms(path: Path, times: int = 1) -> None:
    from nptdms import ChannelObject, TdmsWriter

    clock = {"wf_increment": 1.0 / RATE, "wf_start_offset": 0.0}
    with TdmsWriter(path) as file:
        for rows in times * (slice(0, 3000), slice(3000, N)):
            file.write_segment([ChannelObject("rig", name, x[rows], clock) for name, x in SIGNALS.items()])
        file.write_segment([ChannelObject("slow", "Temperature", np.arange(9.0), {"wf_increment": 1.0})])


# asammdf and npTDMS warn about NumPy and pandas, and leave files open, and objects half made, after an error
pytestmark = [
    pytest.mark.filterwarnings(f"ignore::{name}")
    for name in ("DeprecationWarning", "FutureWarning", "ResourceWarning", "pytest.PytestUnraisableExceptionWarning")
]
KINDS = pytest.mark.parametrize(("suffix", "write"), [(".mf4", write_mdf), (".tdms", write_tdms)])


@KINDS
def test_a_recording_is_read_piece_by_piece(
    tmp_path: Path, suffix: str, write: Callable[[Path], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"log{suffix}"
    write(path)
    monkeypatch.setattr(mdf_tdms, "CHUNK_ROWS", 700)
    found = readers.read(path, columns=COLUMNS)
    assert found.sample_rate == pytest.approx(RATE) and np.allclose(found.t, T, atol=1e-9)
    for letter, name, factor in (("r", "SetPoint", 1.0), ("u", "ValveCurrent", 0.5), ("y", "Pos", 1.0)):
        assert np.array_equal(getattr(found, letter), factor * SIGNALS[name])
    with pytest.raises(RecordingError, match="'Temperature' was not sampled together with"):
        readers.read(path, columns=COLUMNS.model_copy(update={"output": "Temperature"}))


@KINDS
def test_memory_does_not_grow_with_the_file(
    tmp_path: Path, suffix: str, write: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"log{suffix}"
    write(path, 200)  # a million rows, 24 MB and more
    monkeypatch.setattr(mdf_tdms, "CHUNK_ROWS", 10_000)
    opened = open_file(path)
    tracemalloc.start()
    rows = sum(table.rows for table in opened.iter_chunks([*SIGNALS, "time"]))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert rows == 200 * N and peak < 10e6


def test_a_count_of_rows_that_is_damaged_is_not_believed(tmp_path: Path) -> None:
    """Broken input once named 2^63 rows, and was read without end."""
    path = tmp_path / "log.mf4"
    write_mdf(path)
    data = bytearray(path.read_bytes())
    count = data.index(struct.pack("<Q", N), data.index(b"##CG"))
    data[count : count + 8] = struct.pack("<Q", 2**63 + N)
    path.write_bytes(data)
    with pytest.raises(RecordingError, match="damaged MDF file"):
        readers.list_channels(path)


def test_a_file_that_was_never_finished_says_so(tmp_path: Path) -> None:
    path = tmp_path / "log.mf4"
    write_mdf(path)
    path.write_bytes(b"UnFinMF " + path.read_bytes()[8:])
    with pytest.raises(RecordingError, match="MDF file that its recorder never finished: finalize it"):
        readers.read(path, columns=COLUMNS)


@KINDS
def test_inspect_lists_channels_and_proposes(tmp_path: Path, suffix: str, write: Callable[[Path], None]) -> None:
    path = tmp_path / f"log{suffix}"
    write(path)
    told = json.loads(run("inspect", path, "--json").out)
    assert {one["name"] for one in told["channels"]} == {"time", "SetPoint", "ValveCurrent", "Pos", "Temperature"}
    (one,) = [one for one in told["channels"] if one["name"] == "Temperature"]
    assert (one["min"], one["max"]) == (0.0, 8.0)
    assert told["proposed"] == {"t": "time", "r": "SetPoint", "u": "ValveCurrent", "y": "Pos"}


@pytest.mark.parametrize(
    ("names", "proposed"),
    [
        (["t", "r", "u", "y"], {"t": "t", "r": "r", "u": "u", "y": "y"}),
        (["Zeit", "Soll", "Stell", "Ist"], {"t": "Zeit", "r": "Soll", "u": "Stell", "y": "Ist"}),
        (["a", "pos_ref", "motor torque", "pos"], {"r": "pos_ref", "u": "motor torque", "y": "pos"}),
        (["Time", "Target", "Command", "Position"], {"t": "Time", "r": "Target", "u": "Command", "y": "Position"}),
        (["Time", "Command", "Current", "Position"], {"t": "Time", "r": "Command", "u": "Current", "y": "Position"}),
        (["time", "qg", "vir", "qm"], {"t": "time", "r": "qg", "u": "vir", "y": "qm"}),
        (["timestamp", "ref_speed", "cmd", "speed"], {"t": "timestamp", "r": "ref_speed", "u": "cmd", "y": "speed"}),
        (["pos_cmd", "torque", "pos"], {"r": "pos_cmd", "u": "torque", "y": "pos"}),
        (["a", "b"], {}),
    ],
)  # fmt: skip
def test_columns_are_guessed_by_their_names_on_the_command_line_and_on_the_page(
    names: list[str], proposed: dict[str, str]
) -> None:
    assert guess_columns(names) == proposed
    mapping = guess_mapping(names)
    fields = {"t": "time", "r": "reference", "u": "input", "y": "output"}
    assert {letter: mapping[field] for letter, field in fields.items() if mapping[field] is not None} == proposed


@KINDS
def test_broken_files_are_refused(tmp_path: Path, suffix: str, write: Callable[[Path], None]) -> None:
    """Whatever is cut off or overwritten: a recording, or the project's own error in one line."""
    good = tmp_path / f"good{suffix}"
    write(good)
    whole = good.read_bytes()
    path = tmp_path / f"bad{suffix}"

    @given(st.integers(0, len(whole)), st.lists(st.tuples(st.integers(0, 4000), st.integers(0, 255)), max_size=6))
    @settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
    def broken(cut: int, changes: list[tuple[int, int]]) -> None:
        data = bytearray(whole[:cut] if not changes else whole)
        for at, byte in changes:
            data[at] = byte
        path.write_bytes(data)
        try:
            readers.read(path, columns=COLUMNS)
        except RecordingError as error:
            assert "\n" not in str(error)

    broken()
    gc.collect()
