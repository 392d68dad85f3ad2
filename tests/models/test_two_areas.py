"""An EHA with a rod: two areas from its data sheet, in simulation, sequential test, refit and study."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import servoscope as ss
from servoscope.core.errors import BaselineError, LoopError, SimulationError
from servoscope.export import export_c
from servoscope.models.plants.eha import EHA
from servoscope.simulation import FaultEvent, reference, simulate

SYMMETRIC = {
    "kind": "eha", "m_p": 4.0, "b_p": 200.0, "k_p": 26687.41, "A_p": 4e-4, "V_o": 1e-4, "beta": 1e9, "C_ie": 6e-12,
    "p_s": 14e6, "rho": 850.0, "C_d": 0.6, "W": 0.02, "K_m": 1e-3,
}  # fmt: skip
RATE = 100.0


def loop(**plant: Any) -> ss.Loop:
    settings = {
        "sample_rate": RATE,
        "plant": {**SYMMETRIC, **plant},
        "controller": {"kind": "pi", "k_p": 20.0, "k_i": 5.0, "k_v": 0.1},
        "input_limits": [-2.0, 2.0],
    }
    return ss.Loop.from_dict(settings)


TWO_AREAS = loop(A_b=2.6e-4, K_c=3e-11)  # the valve damps the oil, whose 119 Hz would alias else


def test_a_symmetric_file_means_what_it_meant() -> None:
    plant = loop().plant
    np.testing.assert_allclose(
        plant.theta(),
        [0.25993327926361637, 0.2638453357913749, 5.519288867524022e-05, 3.2466405103082483e-07],
        rtol=1e-12,
    )
    A, B, _ = plant.state_space()
    np.testing.assert_allclose(A, [[0, 1, 0], [-6671.8525, -50, 1e-4], [0, -8e9, -120]], rtol=1e-12)
    np.testing.assert_allclose(B[2, 0], 30801069500.1479, rtol=1e-12)
    plain = {"sample_rate": RATE, "plant": SYMMETRIC, "controller": {"kind": "pi", "k_p": 20.0, "k_i": 5.0}}
    old = ss.Loop.from_dict({**plain, "monitor": {"structure": "tustin"}})
    assert old.hash() == "3fc36e175ed96311"
    log, _ = simulate(old, reference("profile", 20.0, RATE), faults=[FaultEvent.parse("C_ie=1.5@10")], seed=3)
    at = [500, 1500, 1999]
    np.testing.assert_allclose(log.u[at], [0.7325939477587333, 0.7396537567623583, 0.011238007028564739], rtol=1e-12)
    np.testing.assert_allclose(
        log.y[at], [-0.006508600624688141, -0.006762435343057065, 0.029924529058143644], rtol=1e-12
    )


def test_the_simulation_follows_the_equations() -> None:
    """Two chambers, edges that share the pressure, both loads, by an integrator that knows nothing of p_L."""
    plant = EHA(**{**SYMMETRIC, "k_p": 0.0, "valve_law": "square-root", "A_b": 2.6e-4, "C_ie": 1e-16})
    a, K = 0.65, plant.K_m * plant.C_d * plant.W * np.sqrt(2.0 / plant.rho)

    def slope(_: float, x: np.ndarray, u: float) -> list[float]:
        v, p_a, p_b = x
        edges = (plant.p_s - p_a, p_b) if u > 0.0 else (p_a, plant.p_s - p_b)
        q_a, q_b = (K * u * np.sqrt(max(drop, 0.0)) for drop in edges)
        leak, stiff = plant.C_ie * (p_a - p_b), plant.beta / plant.V_o
        force = plant.A_p * (p_a - a * p_b) - plant.b_p * v
        return [
            force / plant.m_p,
            stiff * (q_a - plant.A_p * v - leak),
            stiff * (-q_b + a * plant.A_p * v + leak),
        ]

    for u in (0.05, -0.05):
        steady = solve_ivp(slope, (0.0, 2.0), [0.0, 3e6, 3e6], args=(u,), method="LSODA", rtol=1e-9, atol=1e-6).y[0, -1]
        gain = plant.flow_gain * (1.0 if u > 0.0 else plant.retraction_gain)
        assert gain * u / plant.A_p == pytest.approx(steady, rel=0.02)  # the load of friction takes the rest


def test_both_laws_agree_at_small_loads_and_sharp_in_direction() -> None:
    r = 0.01 * np.sin(2.0 * np.pi * 0.5 * np.arange(1000) / RATE)
    linear, _ = simulate(loop(A_b=2.6e-4, k_p=0.0), r, noise_u_std=0.0, noise_y_std=0.0)
    root, _ = simulate(loop(A_b=2.6e-4, k_p=0.0, valve_law="square-root"), r, noise_u_std=0.0, noise_y_std=0.0)
    np.testing.assert_allclose(linear.u, root.u, atol=0.03 * np.abs(linear.u).max())
    forward, backward = linear.u[500:].max(), -linear.u[500:].min()
    assert backward / forward == pytest.approx(0.65**-0.5, rel=0.1)
    mirrored, _ = simulate(loop(A_b=2.6e-4, k_p=0.0, input_gain=1.0), r, noise_u_std=0.0, noise_y_std=0.0)
    np.testing.assert_array_equal(mirrored.u, linear.u)


def test_a_fault_is_named_with_its_size_and_studied() -> None:
    days = [simulate(TWO_AREAS, reference("profile", 60.0, RATE), seed=seed)[0] for seed in range(3)]
    baseline = ss.learn(TWO_AREAS, days)
    assert baseline.thresholds.hypotheses
    assert baseline.exact is not None
    assert baseline.exact.misfit <= 1.0
    healthy, _ = simulate(TWO_AREAS, reference("profile", 60.0, RATE), seed=20)
    assert ss.diagnose(baseline, healthy).verdict == "healthy"
    faults = [FaultEvent.parse("C_ie=1.3@30")]
    leaking, _ = simulate(TWO_AREAS, reference("profile", 60.0, RATE), faults=faults, seed=21)
    diagnosis = ss.diagnose(baseline, leaking)
    assert [fault.name for fault in diagnosis.faults] == ["leakage"]
    assert diagnosis.faults[0].interval[0] < 1.3 < diagnosis.faults[0].interval[1]
    assert diagnosis.intervals[0].refit is not None
    study = ss.design_study(TWO_AREAS, days)
    assert 1.0 < study.faults["leakage"].up.detectable < 1.3
    with pytest.raises(BaselineError, match="A_b"):
        export_c(baseline)


def test_areas_of_diameters_and_what_does_not_fit() -> None:
    sheet = {key: value for key, value in SYMMETRIC.items() if key != "A_p"}
    plant = ss.Loop.from_dict({"sample_rate": RATE, "plant": {**sheet, "bore": 0.05, "rod": 0.028}}).plant
    assert isinstance(plant, EHA)
    assert plant.A_p == pytest.approx(1.963e-3, rel=1e-3)
    assert plant.area_ratio == pytest.approx(1.0 - 0.56**2)
    assert plant.scaled({"A_p": 1.1}).area_ratio == pytest.approx(plant.area_ratio)
    for wrong in ({"bore": 0.05}, {"bore": 0.02, "rod": 0.03}, {"A_p": 1e-3, "bore": 0.05, "rod": 0.02}):
        with pytest.raises(LoopError, match="bore, rod"):
            ss.Loop.from_dict({"sample_rate": RATE, "plant": {**sheet, **wrong}})
    with pytest.raises(LoopError, match="A_b"):
        loop(A_b=5e-4)
    with pytest.raises(SimulationError, match="two areas"):
        simulate(ss.Loop.from_dict({**loop(A_b=2.6e-4).to_dict(), "hold": "foh"}), np.zeros(100))
