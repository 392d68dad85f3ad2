"""Recordings too long for memory: in pieces of any size they are read, cleaned and judged to the same bits."""

from __future__ import annotations

import functools
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pytest
from dirty import RATE, cleaned, signals
from logs import lines, written

from servoscope.baseline.baseline import Baseline
from servoscope.core import outofcore
from servoscope.core.errors import RecordingError
from servoscope.detection.trace import Trace
from servoscope.diagnosis.diagnose import diagnose, diagnose_with_trace
from servoscope.diagnosis.operating_points import learn
from servoscope.diagnosis.result import Diagnosis
from servoscope.evidence.examination import Examination
from servoscope.models.loop import Columns, Loop
from servoscope.signals import Recording
from servoscope.signals.readers import csv, parquet, read
from servoscope.signals.writers import write_recording
from servoscope.simulation import FaultEvent, reference, simulate


def cut(monkeypatch: pytest.MonkeyPatch, rows: int) -> None:
    """Work on so many rows at a time, and keep every column of more than a kilobyte in a file."""
    monkeypatch.setattr(outofcore, "CHUNK_ROWS", rows)
    monkeypatch.setattr(outofcore, "SPILL_BYTES", 1024)
    monkeypatch.setattr(parquet, "CHUNK_ROWS", rows)
    monkeypatch.setattr(csv, "CHUNK_BYTES", 10 * rows)


def bits(recording: Recording) -> list[Any]:
    return [*(column.tobytes() for column in recording.columns), recording.sample_rate, recording.defects]


@functools.cache
def rig() -> Loop:
    return Loop.load(Path(__file__).parents[2] / "src/servoscope/simulation/reference-rig.toml")


@functools.cache
def recorded(seconds: float, *faults: FaultEvent) -> Recording:
    r = np.tile(reference("multisine", 60.0, RATE), 10)[: round(seconds * RATE)]
    return simulate(rig(), r, faults=faults, seed=len(faults))[0]


@functools.cache
def learned() -> Baseline:
    return learn(rig(), [simulate(rig(), reference("multisine", 60.0, RATE), seed=9)[0]])


class TestColumns:
    def test_a_long_column_lies_in_a_file_and_keeps_its_values(self, monkeypatch: pytest.MonkeyPatch) -> None:
        cut(monkeypatch, 100)
        column, growing = outofcore.empty((1000,)), outofcore.GrowableArray()
        for rows in outofcore.iter_chunks(0, 1000, column):
            column[rows] = np.arange(rows.start, rows.stop)
            growing.append(column[rows].copy())
        assert not column.flags.owndata
        assert np.array_equal(column, np.arange(1000.0))
        assert np.array_equal(growing.to_array(), column)
        assert np.array_equal(
            outofcore.drop_rows(column, np.array([0, 99, 100, 999])), np.delete(column, [0, 99, 100, 999])
        )


class TestCleaning:
    @pytest.mark.parametrize("rows", [37, 64, 1000])
    def test_defects_across_the_cuts(self, rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
        """Every kind of defect, some of them where one piece ends: a hundred logs."""
        dirty = [spoilt(seed) for seed in range(100)]
        whole = [attempt(data) for data in dirty]
        cut(monkeypatch, rows)
        assert [attempt(data) for data in dirty] == whole
        assert len({len(str(each)) for each in whole}) > 50


def spoilt(seed: int) -> dict[str, Any]:
    """A log with defects of up to five kinds."""
    rng = np.random.default_rng(seed)
    data = signals(600, seed)
    t = data["t"]
    for kind in rng.integers(0, 9, rng.integers(0, 6)):
        k, width = int(rng.integers(1, 590)), int(rng.integers(1, 10))
        some = slice(k, k + width)
        if kind < 3:
            data["ruy"[kind]][some] = np.nan
        elif kind < 5:
            data["uy"[kind - 3]][some] += 50.0 * rng.standard_normal()
        elif kind == 5:
            t[some] = t[some][rng.permutation(len(t[some]))]
        elif kind == 6:
            t[k:] += 0.01 * rng.integers(1, 30)
        elif kind == 7:
            t[k:] -= t[k]
        else:
            t[some] = t[k]
    return data


def attempt(data: dict[str, Any]) -> object:
    try:
        return bits(cleaned(data))
    except RecordingError as error:
        return str(error)


class TestReading:
    @pytest.mark.parametrize("suffix", [".csv", ".parquet"])
    @pytest.mark.parametrize("rows", [7, 100])
    def test_files(self, suffix: str, rows: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        path = tmp_path / f"x{suffix}"
        write_recording(path, recorded(20.0))
        whole = read(path, rig())
        cut(monkeypatch, rows)
        assert bits(read(path, rig())) == bits(whole)

    def test_torn_rows_comments_and_runs(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        rows = lines(run=np.repeat([1, 2, 3], 100))
        rows[150:150] = ["# a comment", "1.5,torn"]
        path = written(tmp_path, rows)
        columns = Columns(segment=("run",))
        whole = read(path, columns=columns)
        assert [(d.kind, d.message) for d in whole.defects] == [("text", "row 152 is torn and dropped: '1.5,torn'")]
        cut(monkeypatch, 20)
        assert bits(read(path, columns=columns)) == bits(whole)

    def test_a_column_that_looks_like_numbers_at_first(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        path = written(tmp_path, lines(load=np.array(["1"] * 200 + ["1b"] * 100)))
        whole = read(path, where={"load": "1"})
        cut(monkeypatch, 20)
        assert bits(read(path, where={"load": "1"})) == bits(whole)
        assert whole.samples == 200


class TestExamination:
    @pytest.mark.parametrize("faults", [(), (FaultEvent("C_ie", 1.3, 30.0),)], ids=["healthy", "fault"])
    def test_a_diagnosis_and_its_trace(self, faults: tuple[FaultEvent, ...], monkeypatch: pytest.MonkeyPatch) -> None:
        whole = told(*diagnose_with_trace(learned(), recorded(60.0, *faults)))
        for rows in (999, 4000):
            cut(monkeypatch, rows)
            assert told(*diagnose_with_trace(learned(), recorded(60.0, *faults))) == whole

    def test_what_is_forgotten_does_not_count(self) -> None:
        """Ten minutes: the evaluation at the end is explained by the last four of them, to the same numbers."""
        x = Examination.from_recording(learned(), recorded(600.0, FaultEvent("C_ie", 1.3, 520.0)))
        ill, since = rig().plant.with_ratios({"C_ie": 1.3}), 52_000
        last = slice(x.evaluations - 1, x.evaluations)
        assert x.memory_start(last.start) > 35_000
        near, whole = x.expected_path(last, ill, since), x.expected_path(slice(0, last.stop), ill, since)[-1:]
        np.testing.assert_allclose(near, whole, rtol=1e-8)
        near, whole = x.covariance_under(last, ill), x.covariance_under(slice(0, last.stop), ill)[-1:]
        np.testing.assert_allclose(near, whole, rtol=1e-6)

    def test_a_fault_long_ago_is_found_as_one_just_now(self) -> None:
        """What was healthy long before it, or has been ill long since, changes neither its size nor its onset."""
        for seconds, at in ((120.0, 60.0), (600.0, 300.0)):
            said = diagnose(learned(), recorded(seconds, FaultEvent("C_ie", 1.3, at)))
            assert [(fault.name, round(fault.ratio, 2)) for fault in said.faults] == [("leakage", 1.3)]
            assert said.onset_s is not None
            assert said.onset_s[0] - 0.1 <= at <= said.onset_s[2] + 0.1


# the memory that a diagnosis takes beyond what it takes of a fifth of the log, in bytes per row
MEASURE = """
import resource, sys
from servoscope.core import outofcore
outofcore.SPILL_BYTES = 1 << 20
import servoscope as ss
for path in sys.argv[2:]:
    assert ss.diagnose(sys.argv[1], path).verdict == "healthy"
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
MAX_BYTES_PER_ROW = 40  # as columns in memory r, u, y and t alone would take 32


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the largest resident size has another unit")
def test_the_memory_of_60_mb_does_not_grow_with_the_rows(tmp_path: Path) -> None:
    learned().save(tmp_path / "baseline.json")
    r = np.tile(reference("multisine", 60.0, RATE), 50)
    repeated, paths, counts = simulate(rig(), r, seed=3)[0].rows(slice(6000, None)), [], (1, 5)
    for times in counts:
        paths.append(tmp_path / f"{times}.csv")
        with paths[-1].open("wb") as file:
            file.write(b"t,r,u,y\n")
            for begin in range(times):
                t = (np.arange(repeated.samples) + begin * repeated.samples) / RATE
                columns = {"t": t.round(4), **{name: getattr(repeated, name).round(7) for name in "ruy"}}
                pyarrow.csv.write_csv(pa.table(columns), file, pyarrow.csv.WriteOptions(include_header=False))
    assert paths[-1].stat().st_size > 50e6
    done = subprocess.run(
        [sys.executable, "-c", MEASURE, tmp_path / "baseline.json", *paths], capture_output=True, text=True, check=True
    )
    small, large = map(int, done.stdout.split())
    assert (large - small) * 1024 < MAX_BYTES_PER_ROW * (counts[1] - counts[0]) * repeated.samples


def told(diagnosis: Diagnosis, trace: Trace) -> list[object]:
    return [diagnosis.model_dump_json(), *(column.tobytes() for column in trace.table().values())]
