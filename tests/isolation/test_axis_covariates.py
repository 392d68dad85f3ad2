"""A motor axis whose friction follows a logged temperature, also within a recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import servoscope as ss
from servoscope.core.arrays import FloatArray
from servoscope.isolation.axis_change import find_axis_change
from servoscope.signals import clean

RATE, SECONDS = 200.0, 40.0
LOOP = ss.Loop.from_dict(
    {
        "name": "axis",
        "sample_rate": RATE,
        "hold": "zoh",  # with "foh", which learn would take, the scan of the blind baseline stays below its limit
        "columns": {"covariates": {"oil": "oil"}},
        "plant": {"kind": "axis", "terms": ["viscous", "coulomb", "offset"]},
        "monitor": {"cutoff": 5.0, "memory": 4.0, "frequencies": [1.0]},
    }
)
INERTIA, VISCOUS, COULOMB, PER_KELVIN = 2.0, 8.0, 3.0, 0.03
COLD, WARM = 20.0, 40.0  # degC


def warm_axis(seed: int, oil: FloatArray, coulomb: float = 1.0, at_s: float = 0.0) -> ss.Recording:
    """Return an axis that goes to and fro; its friction falls by 3 % per kelvin, and grows by a factor from a time."""
    rng, t = np.random.default_rng(seed), np.arange(round(SECONDS * RATE)) / RATE
    phase = rng.uniform(0.0, 2.0 * np.pi, 3)
    waves = [(0.05, 0.4), (0.03, 0.9), (0.01, 2.3)]
    r = sum((a * np.sin(2.0 * np.pi * f * t + p) for (a, f), p in zip(waves, phase, strict=True)), np.zeros(len(t)))
    v = np.gradient(r) * RATE
    a = np.gradient(v) * RATE
    thinner = np.exp(-PER_KELVIN * (oil - 30.0))
    worn = np.where(t >= at_s, coulomb, 1.0)
    u = INERTIA * a + VISCOUS * thinner * v + COULOMB * thinner * worn * np.sign(v) + 0.5
    u += 0.02 * rng.standard_normal(len(t))
    made = clean(t, r, u, r + 2e-7 * rng.standard_normal(len(t)), name=f"axis-{seed}", sample_rate=RATE)
    return replace(made, channels={"oil": oil})


def warming(begin: float, end: float) -> FloatArray:
    """Return a temperature that rises along a recording."""
    return np.linspace(begin, end, round(SECONDS * RATE))


@pytest.fixture(scope="module")
def baseline() -> ss.Baseline:
    ends = [(20, 24), (36, 40), (27, 32), (22, 28), (33, 37), (25, 30)]
    return ss.learn(LOOP, [warm_axis(k, warming(*each)) for k, each in enumerate(ends)])


def test_a_warm_up_within_a_recording_is_no_change(baseline: ss.Baseline) -> None:
    """Without the covariates, half of the friction is lost within it, which is found."""
    healthy = warm_axis(50, warming(COLD, WARM))
    assert baseline.axis is not None and baseline.axis.moves is not None
    assert find_axis_change(baseline, healthy) is None
    blind = baseline.model_copy(update={"axis": baseline.axis.model_copy(update={"moves": None})})
    assert find_axis_change(blind, healthy) is not None
    assert ss.diagnose(baseline, healthy).verdict == "healthy"


def test_a_fault_in_a_warm_up_has_its_name_and_size(baseline: ss.Baseline) -> None:
    found = ss.diagnose(baseline, warm_axis(51, warming(COLD, WARM), coulomb=1.3, at_s=20.0))
    likeliest = found.candidates[0]
    assert likeliest.name == "dry_friction" and likeliest.probability > 0.9
    assert likeliest.faults[0].ratio == pytest.approx(1.3, rel=0.03)
    low, _, high = found.intervals[0].onset_s or (0.0, 0.0, 0.0)
    assert low - 0.5 <= 20.0 <= high + 0.5


def test_a_baseline_at_one_temperature_has_its_axis(baseline: ss.Baseline) -> None:
    assert baseline.axis is not None
    cold = baseline.at({"oil": 22.0}).axis
    assert cold is not None and cold.moves is None
    ratio = cold.coefficients["coulomb_friction"] / baseline.axis.coefficients["coulomb_friction"]
    middle = 0.5 * (baseline.covariates.low[0] + baseline.covariates.high[0])  # type: ignore[union-attr]
    assert ratio == pytest.approx(np.exp(-PER_KELVIN * (22.0 - middle)), rel=0.02)
