"""The nonlinear rig: switched off it is the linear actuator, switched on each part does what its law says."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run

from servoscope.core.errors import SimulationError
from servoscope.models.loop import Loop
from servoscope.signals import Recording
from servoscope.simulation import FaultEvent, Rig, RigTruth, reference, simulate, simulate_rig

IDEAL = Rig.ideal()
SILENT = {"noise_u_std": 0.0, "noise_y_std": 0.0}
AFTER = 0.4  # s, after which a ramp has settled


@pytest.fixture
def loop(rig: dict[str, Any]) -> Loop:
    return Loop.from_dict(rig | {"controller": {"kind": "pi", "k_p": 10.0, "k_i": 5.0}})


def ramp(loop: Loop, rig: Rig, speed: float = 0.1) -> tuple[Recording, RigTruth]:
    """Move at an even speed for a second, without noise."""
    return simulate_rig(loop, speed * np.arange(100) / 100.0 - 0.05, rig, **SILENT)


def off_by(loop: Loop, substeps: int) -> float:
    r = reference("profile", 10.0, 100.0)
    faults = [FaultEvent("C_ie", 1.3, 2.0), FaultEvent("b_p", 10.0, 6.0, ramp_s=2.0)]
    exact, _ = simulate(loop, r, faults=faults, seed=3)
    integrated, _ = simulate_rig(loop, r, replace(IDEAL, substeps=substeps), faults=faults, seed=3)
    return float(np.abs(integrated.y - exact.y).max())


@pytest.mark.parametrize("delay", [0.0, 0.004, 0.01])
def test_with_everything_off_it_is_the_linear_actuator_to_fourth_order(loop: Loop, delay: float) -> None:
    """The oracle is the exact discretisation; halving the step of an order-four method leaves a sixteenth."""
    late = loop.model_copy(update={"delay": delay})
    coarse, fine = off_by(late, 60), off_by(late, 120)
    assert fine < 5e-8
    assert 11.0 < coarse / fine < 22.0


def test_the_chosen_step_is_finer_than_the_noise(loop: Loop) -> None:
    r = reference("multisine", 20.0, 100.0)
    chosen, fine = (simulate_rig(loop, r, replace(Rig(), substeps=n, sensor_bits=None))[0].y for n in (None, 400))
    assert np.abs(chosen - fine).max() < 0.05 * np.sqrt(1e-7)


def test_the_valve_holds_a_load_with_the_square_root_of_what_pressure_is_left(loop: Loop) -> None:
    rig = replace(IDEAL, load_pressure_flow=True)
    recording, truth = simulate_rig(loop, np.full(6000, 0.06), rig, **SILENT)
    plant = loop.plant
    p_L = plant.k_p * 0.06 / plant.A_p
    assert truth.load_pressure[-1] == pytest.approx(p_L, rel=1e-3)
    leaking = plant.C_ie * p_L / (plant.flow_gain * math.sqrt(1.0 - p_L / plant.p_s))
    assert recording.u[-1] == pytest.approx(leaking, rel=1e-3)


def test_friction_is_coulomb_in_motion_and_more_below_the_speed_of_stribeck(loop: Loop) -> None:
    def friction(speed: float) -> float:
        rig = replace(IDEAL, coulomb=60.0, static=90.0)
        (_, rough), (_, smooth) = ramp(loop, rig, speed), ramp(loop, IDEAL, speed)
        assert rough.y_true[-1] == pytest.approx(smooth.y_true[-1], abs=2e-3)
        forces = [loop.plant.A_p * t.load_pressure - loop.plant.k_p * t.y_true for t in (rough, smooth)]
        return float(np.mean((forces[0] - forces[1])[int(100 * AFTER) :]))

    assert friction(0.3) == pytest.approx(60.0, rel=0.02)
    assert friction(-0.3) == pytest.approx(-60.0, rel=0.02)
    assert 70.0 < friction(0.02) < 90.0


@pytest.mark.parametrize("law", ["linear", "square-root"])
def test_what_the_loop_file_knows_of_it_is_simulated_alike(loop: Loop, law: str) -> None:
    r = reference("profile", 3.0, 100.0)
    plant = loop.plant.model_copy(update={"valve_law": law, "coulomb": 60.0})
    _, known = simulate(loop.model_copy(update={"plant": plant}), r, seed=4)
    rig = replace(IDEAL, load_pressure_flow=law == "square-root", coulomb=60.0, static=60.0)
    _, truth = simulate_rig(loop, r, rig, seed=4)
    assert np.array_equal(known.y_true, truth.y_true)
    assert np.abs(known.y_true - simulate(loop, r, seed=4)[1].y_true).max() > 4e-5


def test_the_spool_follows_as_a_damped_mass_and_not_before_the_delay(loop: Loop) -> None:
    r = np.full(6, 0.01)
    w, zeta = 2.0 * math.pi * 80.0, 0.7
    for delay in (0.0, 2.0):
        _, truth = simulate_rig(loop, r, replace(IDEAL, valve_hz=80.0, delay_samples=delay), **SILENT)
        first = 1 + int(delay)
        damped = w * math.sqrt(1.0 - zeta**2)
        step = 1.0 - math.exp(-zeta * w * 0.01) * (
            math.cos(0.01 * damped) + zeta * w / damped * math.sin(0.01 * damped)
        )
        assert np.all(truth.y_true[:first] == 0.0)
        assert truth.spool[first] == pytest.approx(step * truth.u_true[0], rel=1e-3)


def test_limits_of_current_stroke_and_sensor(loop: Loop) -> None:
    rig = replace(IDEAL, current_limit=0.2, stroke=0.05, sensor_bits=8)
    r = np.where(np.arange(300) % 100 < 50, 0.04, -0.01)
    recording, truth = simulate_rig(loop, r, rig, seed=2)
    assert np.abs(recording.u).max() == 0.2
    assert truth.y_true.max() == 0.025
    steps = recording.y / (0.05 / 2**8)
    assert steps == pytest.approx(np.rint(steps), abs=1e-9)
    free, _ = simulate_rig(loop, r, replace(rig, stroke=None), seed=2)
    assert free.y.max() > 0.03


def test_warm_oil_leaks_more_rubs_less_and_is_softer(loop: Loop) -> None:
    rig = replace(IDEAL, temperature=45.0, warming=5.0, warming_time=2.0)
    faults = [FaultEvent("leakage", 2.0, 5.0)]
    _, truth = simulate_rig(loop, np.zeros(1000), rig, faults=faults)
    assert truth.temperature[[0, -1]] == pytest.approx([45.0, 50.0], abs=0.05)
    plant, found = loop.plant, truth.parameters
    assert found["C_ie"][[0, -1]] == pytest.approx(
        [plant.C_ie * math.exp(0.2), 2.0 * plant.C_ie * math.exp(0.4)], rel=0.01
    )
    assert found["b_p"][-1] == pytest.approx(plant.b_p * math.exp(-0.4), rel=0.01)
    assert found["beta"][0] == pytest.approx(0.975 * plant.beta)
    assert np.all(found["p_s"] == plant.p_s)
    assert truth.ratios["C_ie"][-1] == 2.0
    assert truth.theta[-1] == pytest.approx(plant.with_ratios({"C_ie": 2.0}).theta())


def test_what_cannot_be_simulated_is_refused(loop: Loop, rig: dict[str, Any]) -> None:
    axis = {"kind": "polynomial", "order": 2, "coefficients": {"inertia": 1.0, "viscous_friction": 1.0}}
    r = np.zeros(9)
    for other, words in (
        (Loop.from_dict(rig | {"plant": axis}), "kind 'eha'"),
        (loop.model_copy(update={"hold": "foh"}), "zoh"),
        (Loop.from_dict(rig | {"controller": {"kind": "pi", "k_p": 60.0, "k_i": 5.0}}), "unstable with its nominal"),
    ):
        with pytest.raises(SimulationError, match=words):
            simulate_rig(other, r)
    for wrong, words in (
        ({"coulomb": 10.0, "static": 5.0}, "static"),
        ({"valve_hz": 0.0}, "valve_hz"),
        ({"temperature": 300.0}, "bulk modulus"),
        ({"delay_samples": -1.0}, "delay_samples"),
    ):
        with pytest.raises(SimulationError, match=words):
            Rig(**wrong)  # type: ignore[arg-type]


def test_on_the_command_line(tmp_path: Path, project: Path) -> None:
    file = project / "src" / "servoscope" / "simulation" / "reference-rig.toml"
    said = run("simulate", file, "-o", tmp_path / "x.csv", "--rig", "nonlinear", "--duration", 2, "--json")
    assert said.code == 0, said.err
    assert json.loads(said.out)["rig"] == "nonlinear"
    y = np.loadtxt(tmp_path / "x.csv", delimiter=",", skiprows=1)[:, 3]
    assert np.allclose(y / (0.2 / 2**16), np.rint(y / (0.2 / 2**16)), atol=1e-6)
