"""The cylinder rig: its compiled loop against an integrator that knows its equations, and what each part does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from servoscope.core.errors import SimulationError
from servoscope.simulation import CylinderRig, CylinderTruth, FaultEvent, cylinder_motion, simulate_cylinder

RIG = CylinderRig()
QUIET = replace(RIG, noise_y=0.0, process_scatter=0.0, warming=0.0)
RATE = RIG.sample_rate


def oracle(rig: CylinderRig, truth: CylinderTruth, samples: slice) -> np.ndarray:
    """Integrate the equations of the docstring with a stiff solver, sample by sample, from a state of the rig."""

    def flow(drop: float) -> float:
        return drop / np.sqrt(abs(drop) + 1e4)

    def slope(x: np.ndarray, law: np.ndarray, drive: float) -> list[float]:
        y, v, p_a, p_b, spool, spool_speed, z, p_s = x
        p_0, g_out, g_back, overlap, zero, valve_hz, leakage, share, coulomb, viscous, mass, force = law
        w, air, mobility = 2.0 * np.pi * valve_hz, share * 1e5 / 1.4, 1.0 / mass
        out, back = max(spool + zero - overlap, 0.0) * g_out, max(-spool - zero - overlap, 0.0) * g_back
        null = rig.null_opening * g_out
        q_a = (out + null) * flow(p_s - p_a) - (back + null) * flow(p_a - rig.tank)
        q_b = (back + null) * flow(p_s - p_b) - (out + null) * flow(p_b - rig.tank)
        q_s = (out + null) * flow(p_s - p_a) + (back + null) * flow(p_s - p_b)
        beta = [1.0 / (1.0 / rig.bulk_modulus + air / max(p, 1e4) ** 2) for p in (p_a, p_b)]
        volume = [rig.dead_volume + A * (0.5 * rig.stroke + s * y) for A, s in ((rig.area_a, 1), (rig.area_b, -1))]
        leak = leakage * (p_a - p_b)
        level = coulomb + rig.seal * (p_a + p_b)
        level *= 1.0 + (rig.static_ratio - 1.0) * np.exp(-((v / rig.stribeck_speed) ** 2))
        slip = v - rig.bristle * abs(v) / level * z
        friction = rig.bristle * z + rig.bristle_damping * slip + viscous * v
        pressed = force * min(max((y - rig.contact) / 0.005, 0.0), 1.0)
        total = rig.area_a * p_a - rig.area_b * p_b - friction - rig.spring * y - rig.weight - pressed
        return [
            v,
            total * mobility,
            beta[0] / volume[0] * (q_a - rig.area_a * v - leak),
            beta[1] / volume[1] * (q_b + rig.area_b * v + leak),
            spool_speed,
            w * (w * (drive - spool) - 2.0 * rig.valve_damping * spool_speed),
            slip,
            ((p_0 - p_s) / rig.supply_resistance - q_s) / rig.supply_capacity,
        ]

    x, rows = truth.states[samples.start], []
    for k in range(samples.start, samples.stop):
        rows.append(x)
        law, drive = truth.laws[k], truth.drive[k]
        solved = solve_ivp(
            lambda _, x, law=law, drive=drive: slope(x, law, drive),
            (0.0, 1.0 / RATE),
            x,
            method="LSODA",
            rtol=1e-8,
            atol=1e-12,
        )
        x = solved.y[:, -1]
    return np.array(rows)


@pytest.mark.parametrize("faults", [(), (FaultEvent("pump_pressure", 0.8, 0.0), FaultEvent("leakage", 30.0, 0.0))])
def test_it_follows_the_equations(faults: tuple[FaultEvent, ...]) -> None:
    _, truth = simulate_cylinder(cylinder_motion("production", 4.0, RATE, 3), QUIET, faults=faults)
    where = slice(150, 450)
    exact = oracle(QUIET, truth, where)
    off = np.abs(truth.states[where] - exact).max(axis=0) / np.abs(exact).max(axis=0)
    assert off[[0, 2, 3, 4, 7]].max() < 1e-4


def test_each_step_is_short_enough() -> None:
    r = cylinder_motion("production", 5.0, RATE, 1)
    coarse, fine = (simulate_cylinder(r, replace(QUIET, substeps=n))[0].y for n in (40, 160))
    assert np.abs(coarse - fine).max() < 2.0 * RIG.stroke / 2.0**16


def test_two_areas_and_a_lower_supply_ask_for_more_u() -> None:
    r = cylinder_motion("teach", 20.0, RATE, 1)
    healthy, truth = simulate_cylinder(r, QUIET)
    weak, _ = simulate_cylinder(r, QUIET, faults=[FaultEvent("pump_pressure", 0.8, 0.0)])
    speed = truth.states[:, 1]
    out, back = speed > 0.03, speed < -0.03
    gains = [float(np.mean(healthy.u[rows] / speed[rows])) for rows in (out, back)]
    assert abs(gains[0] / gains[1] - 1.0) > 0.03
    ratio = np.sum(weak.u[out] * healthy.u[out]) / np.sum(healthy.u[out] ** 2)
    assert 0.8**-0.5 < ratio < 0.8**-1.0  # the load takes its share of what pressure is left
    assert truth.states[:, 7].min() < 0.99 * RIG.pump_pressure


def test_what_is_logged_repeats_and_is_quantised() -> None:
    r = cylinder_motion("sweep", 5.0, RATE, 2)
    one, other = (simulate_cylinder(r, seed=4)[0] for _ in range(2))
    np.testing.assert_array_equal(one.u, other.u)
    np.testing.assert_allclose(one.u * 4096.0 / 20.0, np.rint(one.u * 4096.0 / 20.0), atol=1e-9)
    assert set(one.channels) == {"p_A", "p_B", "p_S", "T_oil"}


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(SimulationError, match="within half the stroke"):
        simulate_cylinder(np.full(100, 0.2))
    with pytest.raises(SimulationError, match="pump_pressure"):
        simulate_cylinder(np.zeros(100), faults=[FaultEvent("C_ie", 2.0, 0.0)])
    with pytest.raises(SimulationError, match="choose production"):
        cylinder_motion("dance", 1.0, RATE)
    with pytest.raises(SimulationError, match="mass"):
        CylinderRig(mass=0.0)
