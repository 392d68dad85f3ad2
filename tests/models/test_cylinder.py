"""A cylinder as a list of terms: its columns, what its faults move, and a supply drop from log to name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pydantic
import pytest

import servoscope as ss
from servoscope.core.errors import LoopError
from servoscope.learning.plant_choice import choose_plant
from servoscope.models.plants import parse_plant
from servoscope.models.plants.cylinder import CylinderPlant
from servoscope.simulation import CylinderRig, FaultEvent, cylinder_motion, simulate_cylinder

RATE = 250.0
COEFFICIENTS = {
    "acceleration": 0.5,
    "velocity_forward": 40.0,
    "velocity_backward": 50.0,
    "spring": 60.0,
    "overlap": 0.1,
    "offset": -0.2,
}


def day(seed: int, *faults: FaultEvent) -> ss.Recording:
    rig = CylinderRig(temperature=40.0 + 3.0 * (seed % 4))
    return simulate_cylinder(cylinder_motion("production", 40.0, RATE, seed), rig, faults=faults, seed=seed)[0]


@pytest.fixture(scope="module")
def healthy() -> list[ss.Recording]:
    return [replace(day(seed), name=f"day {seed}") for seed in range(3)]


class TestPlant:
    def test_columns(self) -> None:
        plant = parse_plant({"kind": "cylinder", "terms": ["offset", "spring", "jerk", "process"], "contact": 0.1})
        assert plant.names == (
            "acceleration",
            "jerk",
            "velocity_forward",
            "velocity_backward",
            "spring",
            "process",
            "offset",
        )
        assert plant.powers == (2, 3)
        assert len(plant.coefficient_units) == len(plant.names)
        assert not plant.has_physics

    def test_what_faults_move(self) -> None:
        plant = CylinderPlant(coefficients=COEFFICIENTS)
        weak = plant.with_ratios({"supply_pressure": 0.81}).theta() / plant.theta()
        share = 0.5 / 0.85  # of the pressure that the load leaves
        np.testing.assert_allclose(weak, 0.81 ** -np.array([0.5, share, share, 1.0 + share, 0.0, 0.0]))
        worn = plant.with_ratios({"gain_forward": 0.8}).theta() / plant.theta()
        np.testing.assert_allclose(worn, [0.8**-0.5, 1.25, 1.0, 0.8**-0.5, 1.0, 1.0])
        assert {fault.name for fault in plant.faults} >= {"supply", "valve_forward", "overlap", "lag", "friction"}
        assert not plant.exponents("leakage")  # no term shows it

    def test_friction_weighs_more_on_the_smaller_area(self) -> None:
        powers = CylinderPlant().exponents("load", COEFFICIENTS)
        assert powers["velocity_backward"] / powers["velocity_forward"] == pytest.approx((50.0 / 40.0) ** 2)

    def test_it_is_not_simulated_from_its_coefficients(self) -> None:
        with pytest.raises(LoopError, match="simulate_cylinder"):
            CylinderPlant(coefficients=COEFFICIENTS).state_space()

    @pytest.mark.parametrize(
        ("settings", "words"),
        [
            ({"terms": ("process",)}, "contact"),
            ({"contact": 0.1}, "contact"),
            ({"terms": ("spring", "spring")}, "twice"),
            ({"coefficients": {"velocity_forward": 1.0}}, "velocity_backward"),
        ],
    )
    def test_what_does_not_fit_is_refused(self, settings: dict[str, object], words: str) -> None:
        with pytest.raises(pydantic.ValidationError, match=words):
            CylinderPlant.model_validate(settings)


def test_a_supply_drop_is_named_with_its_size(healthy: list[ss.Recording]) -> None:
    plants = choose_plant(healthy, 2.0, False, 0.003)
    assert plants[0].settings["kind"] == "cylinder"
    assert plants[0].explained > 0.995
    loop = ss.Loop.from_dict({"sample_rate": RATE, "plant": plants[0].settings, "monitor": {"cutoff": 5.0}})
    baseline = ss.learn(loop, healthy)
    promised = {change.name: change.change for change in baseline.detectability.changes}
    assert promised["leakage"] is promised["air"] is None  # no term shows them, which is said beforehand
    assert promised["supply"] is not None
    assert ss.diagnose(baseline, day(11)).verdict == "healthy"
    told = ss.diagnose(baseline, day(12, FaultEvent("pump_pressure", 0.8, 20.0)))
    assert [fault.name for fault in told.faults] == ["supply"]
    assert told.faults[0].ratio == pytest.approx(0.8, abs=0.05)
    assert told.onset_s is not None
    assert told.onset_s[1] == pytest.approx(20.0, abs=2.0)


def test_columns_are_the_same_per_sample_and_per_array(healthy: list[ss.Recording]) -> None:
    """Least squares on filtered columns of all samples finds what the compiled recursion finds."""
    from scipy.signal import butter, lfilter

    recording = healthy[0]
    plant = {"kind": "cylinder", "terms": ["spring", "process", "droop", "offset"], "contact": 0.06}
    loop = ss.Loop.from_dict({"sample_rate": RATE, "plant": plant, "monitor": {"cutoff": 5.0}})
    theta = dict(zip(*((b := ss.learn(loop, healthy)).names, b.theta), strict=True))
    v = np.gradient(recording.y) * RATE
    columns = [
        np.gradient(v) * RATE,
        np.maximum(v, 0),
        np.minimum(v, 0),
        np.abs(v) * recording.y,
        np.abs(v) * (recording.y > 0.06),
        v * np.abs(v),
    ]
    b, a = butter(2, 2.0 * 5.0 / RATE)
    filtered = lfilter(b, a, np.vstack([*columns, np.ones_like(v), recording.u]))[:, 500:]
    found = np.linalg.lstsq(filtered[:-1].T, filtered[-1], rcond=None)[0]
    names = "velocity_forward", "velocity_backward", "spring", "process"
    np.testing.assert_allclose([theta[name] for name in names], found[1:5], rtol=0.1)
