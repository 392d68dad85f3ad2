"""Time stamps rounded to a few digits: the uniform clock behind them is found; where there is none, none is made."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import RecordingError
from servoscope.signals import Recording, clean
from servoscope.signals.readers import read

ROWS = 6000


def logged(t: FloatArray, copies: int = 1) -> Recording:
    rng = np.random.default_rng(t.size)
    y = np.repeat(np.cumsum(rng.standard_normal(t.size // copies)), copies)
    return clean(t, y + 1.0, np.repeat(rng.standard_normal(y.size // copies), copies), y)


def rounded(t: FloatArray, digits: str) -> FloatArray:
    return np.array([float(format(x, digits)) for x in t])


@pytest.mark.parametrize("rate", [50.0, 128.0, 200.0, 300.0, 1000.0])
@pytest.mark.parametrize("start", [0.0, 97.0, 995.0, 9990.0])
@pytest.mark.parametrize("digits", [".6g", ".2f", ".3f"])
def test_all_rows_are_kept_on_the_clock_that_was_rounded(rate: float, start: float, digits: str) -> None:
    t = start + np.arange(ROWS) / rate
    recording = logged(rounded(t, digits))
    assert recording.samples == ROWS and not recording.defects
    assert recording.sample_rate == pytest.approx(rate, rel=1e-5)
    # what is rounded more finely than a tenth of a sample stays as it was logged
    assert np.abs(np.diff(recording.t) * rate - 1.0).max() < 0.1


@pytest.mark.parametrize("decimals", [1, 2])
def test_stamps_cut_off_are_as_good_as_rounded_ones(decimals: int) -> None:
    t = np.arange(ROWS) / 200.0
    recording = logged(np.floor(t * 10.0**decimals + 1e-9) / 10.0**decimals)
    assert recording.samples == ROWS and recording.sample_rate == 200.0


def test_single_precision_is_a_rounding() -> None:
    recording = logged((40_000.0 + np.arange(ROWS) / 500.0).astype(np.float32).astype(np.float64))
    assert recording.samples == ROWS and recording.sample_rate == 500.0


def test_missing_rows_stay_missing() -> None:
    kept = np.delete(np.arange(ROWS), np.arange(2000, 2300))
    recording = logged(rounded(2000.0 + kept / 300.0, ".6g"))
    assert recording.sample_rate == 300.0 and recording.samples == kept.size
    assert [round(d.to_s - d.from_s, 1) for d in recording.defects] == [1.0]


def test_a_clock_that_starts_again_keeps_its_runs() -> None:
    t = rounded(np.arange(ROWS) / 1000.0, ".2f")
    recording = logged(np.concatenate([t, t, t]))
    assert recording.samples == 3 * ROWS and int(recording.run[-1]) == 2


def test_rows_that_jitter_more_than_their_digits_say_are_not_put_on_a_grid() -> None:
    t = np.arange(ROWS) / 100.0
    t = t + np.random.default_rng(1).uniform(-2e-3, 2e-3, ROWS)
    recording = logged(np.sort(rounded(t, ".4f")))
    assert any(defect.kind == "jitter" for defect in recording.defects)


def test_rows_that_were_written_twice_are_no_faster_clock() -> None:
    with pytest.raises(RecordingError, match=r"too coarse.*--rate HZ"):
        logged(np.repeat(np.arange(ROWS // 2) / 100.0, 2), copies=2)


def test_a_file_with_six_digits_is_read_whole(tmp_path: Path) -> None:
    t = 998.0 + np.arange(ROWS) / 1000.0
    y = np.sin(5.0 * t)
    np.savetxt(tmp_path / "log.txt", np.column_stack([t, y, np.cos(5.0 * t), y]), "%.6g", header="t r u y")
    recording = read(tmp_path / "log.txt")
    assert recording.samples == ROWS and recording.sample_rate == 1000.0
