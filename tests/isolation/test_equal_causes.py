"""One cause before two: friction of every kind as one fault, and pairs that do the same to u and y as one fault."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import servoscope as ss
from servoscope.isolation.isolate import isolate
from servoscope.isolation.ml.search import onset_window
from servoscope.isolation.ml.window import RefitWindow
from servoscope.isolation.signature import parameter_signature
from servoscope.models.plants import Fault
from servoscope.models.plants.axis import AxisPlant
from servoscope.simulation import FaultEvent, simulate
from servoscope.simulation.tutorial import AXIS

COEFFICIENTS = {"inertia": 1.0, "viscous_friction": 10.0, "coulomb_friction": 2.0}
PLANT: dict[str, Any] = {"kind": "axis", "terms": ["viscous", "coulomb"], "coefficients": COEFFICIENTS}
RUBBED = "viscous_friction=2@12", "coulomb_friction=2@12"


@pytest.fixture(scope="module")
def baseline() -> ss.Baseline:
    loop = ss.Loop.from_dict({**AXIS, "plant": PLANT})
    return ss.learn(loop, [moved(loop, seed) for seed in range(2)])


def moved(loop: ss.Loop, seed: int, *faults: str) -> ss.Recording:
    t = np.arange(6000) / 200.0
    r = 0.1 * np.sin(3.0 * t) + 0.05 * np.sin(7.0 * t)
    events = [FaultEvent.parse(fault) for fault in faults]
    return simulate(loop, r, seed=seed, faults=events, noise_u_std=5e-3, noise_y_std=1e-5)[0]


def test_friction_of_every_kind_is_one_fault_and_what_does_the_same_is_listed(baseline: ss.Baseline) -> None:
    found = ss.diagnose(baseline, moved(baseline.loop, 7, *RUBBED))
    (fault,) = found.faults
    assert (fault.name, fault.ratio) == ("friction", pytest.approx(2.0, rel=0.01))
    (equal,) = [reason for reason in found.explanation if reason.startswith("The same u and y")]
    assert "inertia x 0.5" in equal and "input_gain x 2" in equal
    assert any("bearings" in str(check) for check in found.checks)


def test_two_frictions_that_differ_are_two_faults(baseline: ss.Baseline) -> None:
    found = ss.diagnose(baseline, moved(baseline.loop, 7, "viscous_friction=1.3@12", "coulomb_friction=1.2@12"))
    assert [(fault.name, round(fault.ratio, 2)) for fault in found.faults] == [
        ("lubrication", 1.3),
        ("dry_friction", 1.2),
    ]


def test_a_second_cause_below_what_the_terms_are_trusted_to_is_none(baseline: ss.Baseline) -> None:
    found = ss.diagnose(baseline, moved(baseline.loop, 7, "viscous_friction=2@12", "inertia=1.006@12"))
    assert [(fault.name, round(fault.ratio, 2)) for fault in found.faults] == [("lubrication", 2.0)]


def test_friction_is_one_fault_where_there_are_several_terms() -> None:
    def rays(**settings: Any) -> list[str]:
        return [ray.name for ray in AxisPlant.model_validate(settings).rays]

    assert rays() == ["friction"]
    assert rays(terms=("viscous_by_direction", "coulomb")) == ["friction"]
    assert rays(terms=("viscous_by_direction", "offset")) == []
    tables = {"friction": {"viscous_friction": 3.0, "coulomb_friction": 1.5}}
    own = ss.Loop.from_dict({**AXIS, "plant": PLANT, "faults": tables}).plant.rays
    assert [dict(ray.full) for ray in own] == [tables["friction"]]  # a loop file has the last word


def test_a_size_that_may_be_healthy_is_no_explanation() -> None:
    """A change across the only curve: the likeliest size is healthy."""
    fault = Fault("leakage", "C_ie", (0.2, 5.0), "")
    signature = parameter_signature(fault, lambda ratio: np.array([np.log(ratio), 0.0]))
    first, second = isolate([signature], np.array([0.1, 3.0]), np.eye(2))
    assert (first.name, first.probability) == ("unknown", 1.0)
    assert second.faults[0].may_be_healthy and second.probability == 0.0


def test_a_slow_loop_is_refitted_over_as_many_samples_as_a_fast_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RefitWindow, "from_recording", lambda _baseline, _recording, first, end: (first, end))
    linear: Any = SimpleNamespace(axis=None)
    for rate, span in ((0.1, (9400, 12400)), (10.0, (9400, 12400)), (100.0, (4000, 34000))):
        recording: Any = SimpleNamespace(sample_rate=rate)
        assert onset_window(linear, recording, 10_000, 100_000) == span
