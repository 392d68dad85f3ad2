"""The rule of time stamps gives one answer in a file, in a stream, for data quality and for a fleet's days."""

from __future__ import annotations

import lakes
import numpy as np
import pytest

from servoscope.core.arrays import FloatArray
from servoscope.fleet.day_monitor import DayMonitor, RowHistory
from servoscope.fleet.rows import Rows
from servoscope.learning.learn import nominal_baseline
from servoscope.signals import clean, quality
from servoscope.signals.quality import QualitySettings
from servoscope.signals.timebase import Timebase

PERIOD = 0.01


@pytest.fixture(scope="module")
def exchanged() -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """200 rows at 100 Hz, of which rows 100 and 102 are exchanged; the rate of the lakes' loop."""
    order = np.arange(200)
    order[[100, 102]] = [102, 100]
    x = lakes.recorded(1, 0, 5.0)
    t, r, u, y = (column[order] for column in (np.arange(200) * PERIOD, x.r[:200], x.u[:200], x.y[:200]))
    return t, r, u, y


def test_a_file_sorts_them(exchanged: tuple[FloatArray, ...]) -> None:
    recording = clean(*exchanged, sample_rate=100.0)  # type: ignore[misc]
    assert (recording.samples, recording.restart.sum()) == (200, 1)


def test_a_stream_sorts_them_within_a_block(exchanged: tuple[FloatArray, ...]) -> None:
    t = exchanged[0]
    found = Timebase(PERIOD).order_block(t, np.nan)
    assert (found.rows.size, found.restart.sum(), found.t) == (200, 1, t[-1])
    assert np.array_equal(t[found.rows], np.sort(t)) and np.array_equal(found.order, found.rows)


def test_a_row_that_comes_in_a_later_block_is_left_out(exchanged: tuple[FloatArray, ...]) -> None:
    t, timebase = exchanged[0], Timebase(PERIOD)
    first = timebase.order_block(t[:102], np.nan)
    second = timebase.order_block(t[102:], first.t)
    assert (first.rows.size, second.rows.size) == (102, 97)
    assert first.restart.tolist() == [True, *[False] * 99, True, False]  # row 100 is missing there
    assert not second.restart.any()


def test_data_quality_sees_them_in_order(exchanged: tuple[FloatArray, ...]) -> None:
    limits, order = QualitySettings().limits(100.0), Timebase(PERIOD).order_block(exchanged[0], np.nan).order
    assert {f.kind for f in quality.check_block(limits, quality.init_state(), *exchanged)[1]} == {"clock"}  # type: ignore[arg-type]
    assert not quality.check_block(limits, quality.init_state(), *(x[order] for x in exchanged))[1]  # type: ignore[arg-type]


def test_a_fleet_sorts_them(exchanged: tuple[FloatArray, ...]) -> None:
    t, r, u, y = exchanged
    day = DayMonitor(nominal_baseline(lakes.loop()))
    rows = Rows(np.round(1e6 * t).astype(np.int64), r, u, y).sort_by_time()
    state, _ = day.advance(day.start(), rows, RowHistory([rows]))
    assert (state.samples, state.gaps, state.repeats) == (200, 0, 0)


@pytest.mark.parametrize(
    ("t", "rows", "restart"),
    [
        ([1.0, 1.01, 1.02], [0, 1, 2], [0, 0, 0]),
        ([1.0, 1.01, 1.05], [0, 1, 2], [0, 0, 1]),  # a gap
        ([1.0, 1.0, 1.01], [0, 2], [0, 0]),  # a repeat
        ([1.0, 1.02, 1.01], [0, 2, 1], [0, 0, 0]),  # exchanged
        ([1.0, 0.98, 1.01], [0, 2], [0, 0]),  # earlier than what has been processed
        ([1.0, 1.01, 0.5, 0.51], [0, 1, 2, 3], [0, 0, 1, 0]),  # the clock was set back
        ([1.0, 9.0, 1.01, 1.02], [0, 2, 3], [0, 0, 0]),  # one absurd stamp
        ([np.nan, 1.0, np.inf], [1], [0]),
        ([0.98, 0.99], [], []),
    ],
)
def test_what_of_a_block_is_used(t: list[float], rows: list[int], restart: list[int]) -> None:
    found = Timebase(PERIOD).order_block(np.array(t), 0.99)
    assert found.rows.tolist() == rows
    assert found.restart.tolist() == [bool(x) for x in restart]
    assert found.t == (t[rows[-1]] if rows else 0.99)
