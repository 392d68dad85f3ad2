"""Facts on logs of which the truth is known: grids, planted defects, measured loops."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from servoscope.assessment.assess import MEASURED_LOOPS, RIGHT_LOOPS, WRONG_ALARMS, assess
from servoscope.signals.quantisation import find_quantum
from servoscope.signals.samples import Samples

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(autouse=True)
def _programs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    sys.modules.pop("assessment", None)


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_a_grid_is_found_and_none_where_there_is_none(bits: int) -> None:
    rng, step = np.random.default_rng(bits), 2.5 / 2.0**bits
    x = np.sin(0.01 * np.arange(1500)) + 0.003 * rng.standard_normal(1500)
    assert find_quantum(np.round(x / step) * step) == pytest.approx(step, rel=0.01)
    odd = np.r_[np.round(x / step) * step, 0.3 * step]  # one value off the grid does not make a finer one
    assert find_quantum(odd) == pytest.approx(step, rel=0.01)
    for plain in (x, x.astype(np.float32).astype(float), np.round(x, 7), rng.standard_normal(1500)):
        assert find_quantum(plain) is None


def test_planted_defects_are_found_and_nothing_else() -> None:
    from assessment.planted import DEFECTS
    from assessment.score import planted_table

    rows = planted_table(8).rows
    assert len(rows) == len(DEFECTS)
    assert all(found == "-" or int(found) >= 6 for _, _, found, _ in rows)
    assert sum(int(wrong) for *_, wrong in rows) <= 2
    assert rows[0][-1] == "0"


def test_friction_and_dead_band_of_an_axis_are_those_that_made_the_log() -> None:
    t = np.arange(0.0, 20.0, 0.01)
    r = np.sin(1.5 * t)
    speed = np.gradient(r, t)
    u = 0.5 * speed + 0.8 * np.gradient(speed, t) + 0.3 * np.sign(speed)
    log = assess({"t": t, "r": r, "u": u, "y": r})
    (friction,) = (fact for fact in log.facts if fact.name == "friction at reversals")
    assert friction.evidence["[u]"] == pytest.approx(0.3, rel=0.15)
    play = assess({"t": t, "r": r, "u": u, "y": r - 0.01 * np.sign(speed)})
    assert play.value("dead band at reversals") == pytest.approx(0.02, rel=0.1)


@pytest.mark.slow
def test_process_loops_are_judged_as_the_sentence_says(shared_data: Path) -> None:
    from assessment.score import assess_loops, loop_table

    loops = assess_loops(shared_data / "real" / "process_loops")
    (_, sticking, found, shipped, *_), (_, others, wrong, shipped_wrong, *_) = loop_table(loops).rows
    assert int(sticking) + int(others) == MEASURED_LOOPS
    assert int(found) + int(others) - int(wrong) == RIGHT_LOOPS
    assert int(wrong) == WRONG_ALARMS
    assert (shipped, shipped_wrong) == (found, "0")


@pytest.mark.slow
def test_healthy_servo_recordings_get_no_judgement(shared_data: Path) -> None:
    from assessment.score import servo_table

    rows = servo_table(shared_data / "real", 60).rows
    assert len(rows) == 8
    assert all(row[2] == row[3] == "0" for row in rows)
    assert all(row[-1].split(" of ")[0] == row[-1].split(" of ")[-1] for row in rows)


def test_a_log_of_equal_rows_or_of_rest_alone_cannot_be_judged() -> None:
    t = np.arange(300.0)
    quiet = assess(Samples.from_columns(t, 0.0 * t, np.r_[1.0, 0.0 * t[1:]], np.r_[1.0, 0.0 * t[1:]]))
    assert quiet.verdict == "cannot tell"
    assert "nothing moves" in str(quiet.reason)
