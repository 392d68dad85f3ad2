"""An axis that stands still: static friction lets u be anything, so nothing may be concluded from it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servoscope.baseline.baseline import Baseline
from servoscope.core.errors import LoopError
from servoscope.diagnosis.diagnose import diagnose
from servoscope.learning.learn import learn_baseline
from servoscope.models.loop import Loop
from servoscope.signals import Recording

RATE = 500.0
AXIS = {
    "sample_rate": RATE,
    "plant": {"kind": "polynomial", "order": 2, "friction": "coulomb", "offset": True},
    "monitor": {"cutoff": 10.0},
}


def _record(seconds: float, seed: int, rest: bool = False) -> Recording:
    """u = 2 y'' + 5 y' + 3 sign(y') + 0.5 on a quiet sensor; at rest u is what friction lets it be, and noisy."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE)) / RATE
    y = sum(0.05 * np.sin(2.0 * np.pi * f * t) for f in (0.3, 1.1, 2.7)) * np.clip(seconds - t, 0.0, 1.0) ** 3
    v = np.gradient(y, t)  # it comes to rest in the last second
    u = 2.0 * np.gradient(v, t) + 5.0 * v + 3.0 * np.sign(v) + 0.5 + 0.01 * rng.standard_normal(len(t))
    if rest:
        y, u = np.zeros(len(t)), 1.5 + 0.3 * rng.standard_normal(len(t))
    y = y + 1e-6 * rng.standard_normal(len(t))
    first = np.arange(len(t)) == 0
    return Recording(t, y, u, y, first, name="axis", sample_rate=RATE, run=np.zeros(len(t), dtype=np.int32))


@pytest.fixture(scope="module")
def baseline() -> Baseline:
    return learn_baseline(Loop.from_dict(AXIS), [_record(60.0, 1)])


def test_a_still_log_is_undetermined(baseline: Baseline) -> None:
    diagnosis = diagnose(baseline, _record(30.0, 2, rest=True))
    assert diagnosis.verdict == "undetermined"
    assert "no change of any size" in diagnosis.summary


def test_rest_after_motion_keeps_the_verdict_and_is_told(baseline: Baseline) -> None:
    moving, still = _record(30.0, 3), _record(30.0, 4, rest=True)
    both = replace(
        moving,
        t=np.arange(moving.samples + still.samples) / RATE,
        r=np.append(moving.r, still.r + moving.y[-1]),
        u=np.append(moving.u, still.u),
        y=np.append(moving.y, still.y + moving.y[-1]),
        restart=np.append(moving.restart, np.zeros(still.samples, dtype=bool)),
        run=np.zeros(moving.samples + still.samples, dtype=np.int32),
    )
    diagnosis = diagnose(baseline, both)
    assert diagnosis.verdict == "healthy"
    assert "inertia" in diagnosis.summary  # says from which size on a change would have shown
    (rest,) = [warning for warning in diagnosis.warnings if warning.kind == "rest"]
    assert rest.from_s == pytest.approx(30.0, abs=1.0)


def test_a_reversal_is_no_rest(baseline: Baseline) -> None:
    used = baseline.pipeline().estimate(baseline.tuning, _record(30.0, 5)).updates[-1]
    held = learn_baseline(
        Loop.from_dict(AXIS | {"monitor": {"cutoff": 10.0, "update_when": "always"}}), [_record(60.0, 1)]
    )
    assert used == held.pipeline().estimate(held.tuning, _record(30.0, 5)).updates[-1]


def test_moving_needs_a_speed() -> None:
    with pytest.raises(LoopError, match="rest_speed"):
        Loop.from_dict(AXIS | {"monitor": {"cutoff": 10.0, "update_when": "moving"}})
