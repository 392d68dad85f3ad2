"""Faults that move several parameters at once: tables [faults.NAME] of a loop file, named beside the plant's own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servoscope.core.errors import LoopError
from servoscope.diagnosis.diagnose import diagnose
from servoscope.learning.learn import learn_baseline
from servoscope.models.loop import Loop
from servoscope.simulation import FaultEvent, reference, simulate

WORN = {"b_p": 6.0, "C_ie": 3.0}
AXIS: dict[str, Any] = {
    "sample_rate": 100.0,
    "plant": {
        "kind": "polynomial",
        "order": 2,
        "stiffness": True,
        "coefficients": {"stiffness": 40.0, "viscous_friction": 8.0, "inertia": 0.5},
    },
    "controller": {"kind": "pi", "k_p": 60.0, "k_i": 60.0},
    "faults": {"low_pressure": {"inertia": 10.6, "viscous_friction": 4.9}},
}


@given(st.floats(0.2, 3.0))
def test_a_ray_is_straight_in_log_ratios(share: float) -> None:
    """At a share s of the full size every parameter has its ratio to the power of s."""
    plant = Loop.from_dict(AXIS).plant
    moved = plant.with_ratios({"low_pressure": 10.6**share})
    same = plant.with_ratios({"inertia": 10.6**share, "viscous_friction": 4.9**share})
    np.testing.assert_allclose(moved.theta(), same.theta(), rtol=1e-12)


def test_a_ray_has_one_side_and_goes_beyond_its_full_size() -> None:
    low, high = Loop.from_dict(AXIS).plant.all_faults[-1].ratio_range
    assert low == 1.0 and high > 10.6
    falling = Loop.from_dict(AXIS | {"faults": {"soft": {"stiffness": 0.5, "inertia": 0.9}}})
    low, high = falling.plant.all_faults[-1].ratio_range
    assert high == 1.0 and low < 0.5


def test_a_ray_survives_saving_and_is_no_healthy_parameter() -> None:
    loop = Loop.from_dict(AXIS)
    again = Loop.from_dict(loop.to_dict())
    assert again == loop and again.plant.rays == loop.plant.rays
    assert "low_pressure" not in loop.plant.parameters
    assert "faults" not in Loop.from_dict({k: v for k, v in AXIS.items() if k != "faults"}).to_dict()


@pytest.mark.parametrize(
    ("name", "ratios", "words"),
    [
        ("low_pressure", {"inertia": 2.0, "mass": 3.0}, r"\[faults.low_pressure\] mass: unknown, choose from"),
        ("low_pressure", {"inertia": 2.0, "viscous_friction": 1.0}, "changes nothing"),
        ("low_pressure", {"inertia": 2.0}, "two or more"),
        ("low_pressure", {"inertia": 2.0, "viscous_friction": -1.0}, r"low_pressure.viscous_friction.*greater than 0"),
        ("inertia", {"inertia": 2.0, "viscous_friction": 3.0}, "taken"),
        ("unknown", {"inertia": 2.0, "viscous_friction": 3.0}, "taken"),
    ],
)
def test_a_wrong_table_is_refused_in_one_line(name: str, ratios: dict[str, float], words: str) -> None:
    with pytest.raises(LoopError, match=words) as caught:
        Loop.from_dict(AXIS | {"faults": {name: ratios}})
    assert "\n" not in str(caught.value)


def _record(loop: Loop, seed: int, *faults: FaultEvent, seconds: float = 60.0) -> Any:
    noise = {} if loop.plant.kind == "eha" else {"noise_u_std": 1e-3, "noise_y_std": 2e-6}
    r = reference("multisine", seconds, loop.sample_rate)
    return simulate(loop, r, faults=faults, seed=seed, **noise)[0]


@pytest.mark.slow
def test_rays_and_single_faults_of_an_axis_are_told_apart() -> None:
    loop = Loop.from_dict(AXIS)
    baseline = learn_baseline(loop, [_record(loop, 1)])
    half = float(np.sqrt(10.6))
    for event in (FaultEvent("low_pressure", half, 30.0), FaultEvent("inertia", 1.5, 30.0)):
        found = diagnose(baseline, _record(loop, 2, event))
        (fault,) = found.intervals[0].faults
        assert fault.name == event.parameter
        assert fault.ratio == pytest.approx(event.ratio, rel=0.05)


@pytest.mark.slow
def test_a_ray_of_the_rig_is_named_beside_its_own_faults(rig: dict[str, Any]) -> None:
    loop = Loop.from_dict(rig | {"faults": {"worn_seal": WORN}})
    baseline = learn_baseline(loop, [_record(loop, 1)])
    for event in (FaultEvent("worn_seal", 2.0, 30.0), FaultEvent("C_ie", 1.5, 30.0), FaultEvent("beta", 0.5, 30.0)):
        found = diagnose(baseline, _record(loop, 3, event))
        (fault,) = found.intervals[0].faults
        assert fault.parameter == event.parameter
        assert fault.interval[0] <= event.ratio <= fault.interval[1]
        assert found.intervals[0].probability > 0.95
