"""A drive that answers late: delay and lag are found with the axis, and a payload is weighed by a known one."""

from __future__ import annotations

import numpy as np
import pytest

import servoscope as ss
from servoscope.baseline.plant_fit import saturated_share
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import LoopError
from servoscope.estimation.axis_filter import NO_LAG, DriveLag
from servoscope.learning.axis_fit import fit_axis
from servoscope.signals import clean

RATE, SUBSTEPS = 100.0, 20
INERTIA, VISCOUS, COULOMB, WEIGHT = 0.02, 0.1, 0.05, 1.0
COEFFICIENTS = {"inertia": INERTIA, "viscous_friction": VISCOUS, "coulomb_friction": COULOMB, "gravity": WEIGHT}
AXIS = {"kind": "axis", "terms": ["viscous", "coulomb", "gravity"]}


def loop(**plant: object) -> ss.Loop:
    return ss.Loop.from_dict({"sample_rate": RATE, "plant": AXIS | plant})


def swung(seed: int, drive: DriveLag = NO_LAG, seconds: float = 20.0) -> ss.Recording:
    """Return a pendulum that u swings in open loop, by Euler's rule and a friction that stops it."""
    rng, t = np.random.default_rng(seed), np.arange(round(seconds * RATE)) / RATE
    f, phase = rng.uniform(0.2, 1.2, 6), rng.uniform(0.0, 6.28, 6)
    u: FloatArray = 0.35 * np.sin(2.0 * np.pi * f * t[:, None] + phase).sum(axis=1)
    h, y, v, force, x = 1.0 / (RATE * SUBSTEPS), 0.0, 0.0, u[0], np.zeros(len(t))
    late, kept = round(drive.delay_s / h), np.exp(-h / drive.lag_s) if drive.lag_s else 0.0
    for k in range(len(t)):
        x[k] = y
        for i in range(SUBSTEPS):
            acting = u[max(k * SUBSTEPS + i - late, 0) // SUBSTEPS]
            force = kept * force + (1.0 - kept) * acting
            free = v + h * (force - VISCOUS * v - WEIGHT * np.sin(y)) / INERTIA
            stop = h * COULOMB / INERTIA
            v = free - stop if free > stop else free + stop if free < -stop else 0.0
            y += h * v
    return clean(t, x, u, x + 1e-4 * rng.standard_normal(len(t)), name=f"swung {seed}", sample_rate=RATE)


def test_delay_and_lag_are_found_with_the_coefficients() -> None:
    drive = DriveLag(0.035, 0.03)
    model, _ = fit_axis(loop(), [swung(seed, drive) for seed in range(3)])
    assert model is not None
    assert sum(model.drive) == pytest.approx(sum(drive), abs=0.01)  # one imitates the other
    for name, value in COEFFICIENTS.items():
        assert model.coefficients[name] == pytest.approx(value, rel=0.05), name
    assert type(model).model_validate_json(model.model_dump_json()).drive == model.drive


def test_a_drive_that_answers_at_once_has_no_lag() -> None:
    model, _ = fit_axis(loop(), [swung(seed) for seed in range(2)])
    assert model is not None and model.drive == NO_LAG and "drive" not in model.model_dump()


@pytest.mark.parametrize("drive", [DriveLag(0.025, 0.0), DriveLag(0.0, 0.04)])
def test_the_force_is_the_mean_of_a_late_u(drive: DriveLag) -> None:
    """Against the same at 100 times the rate; the second run does not know of the first."""
    u, fine = np.random.default_rng(0).standard_normal(40), 100
    restart = np.arange(40) == 20
    restart[0] = True
    for run in (slice(0, 20), slice(20, 40)):
        held = np.repeat(u[run], fine)
        late = np.concatenate([np.full(round(drive.delay_s * RATE * fine), held[0]), held])[: len(held)]
        force, state = np.empty(len(late)), late[0]
        kept = np.exp(-1.0 / (drive.lag_s * RATE * fine)) if drive.lag_s else 0.0
        for k, value in enumerate(late):
            state = kept * state + (1.0 - kept) * value
            force[k] = state
        expected = force.reshape(-1, fine).mean(axis=1)
        assert drive.of_input(u, restart, RATE)[run] == pytest.approx(expected, abs=0.01)


def test_a_u_that_runs_in_straight_lines_is_half_a_sample_early() -> None:
    u, restart = np.array([0.0, 2.0, 6.0, 1.0, 3.0]), np.array([True, False, False, True, False])
    early = DriveLag(delay_s=-0.5 / RATE).of_input(u, restart, RATE)
    assert early.tolist() == [1.0, 4.0, 6.0, 2.0, 3.0]  # the last sample of a run knows no next one


def test_a_known_mass_tells_the_scale_of_u() -> None:
    coefficients = {name: 7.0 * value for name, value in COEFFICIENTS.items()}  # u in some unit
    plant = loop(payload_arm=0.1, payload_mass=0.5, coefficients=coefficients).plant
    assert plant.added_mass("moved_mass", 1.8) == pytest.approx(0.4)  # type: ignore[attr-defined]
    loaded = plant.scaled({"moved_mass": 2.0}).coefficients  # type: ignore[attr-defined]
    assert loaded["gravity"] == pytest.approx(2.0 * 7.0 * WEIGHT)
    assert loaded["inertia"] == pytest.approx(7.0 * (INERTIA + WEIGHT * 0.1 / 9.81))
    with pytest.raises(LoopError, match="payload_mass: needs payload_arm"):
        loop(payload_mass=0.5)


def test_an_axis_at_its_limit_is_no_obstacle() -> None:
    limited = ss.Loop.from_dict({"sample_rate": RATE, "plant": AXIS, "input_limits": [-0.1, 0.1]})
    assert saturated_share(limited, swung(0)) == 0.0


def test_an_axis_of_a_sample_in_ten_seconds_is_learned() -> None:
    """What correlates within one sample has no upper bound in seconds: a slow log must not leave the search none."""
    rate, n, rng = 0.1, 2000, np.random.default_rng(0)
    t = np.arange(n) / rate
    r = np.sin(2.0 * np.pi * t / 2000.0) + 0.5 * np.sin(2.0 * np.pi * t / 740.0 + 1.0)
    speed = np.gradient(r, 1.0 / rate)
    force = 2e3 * np.gradient(speed, 1.0 / rate) + 50.0 * speed + 0.05 * np.sign(speed)
    logs = [
        clean(t, r, force + 0.002 * rng.standard_normal(n), r + 1e-5 * rng.standard_normal(n), sample_rate=rate)
        for _ in range(2)
    ]
    loop = ss.Loop.from_dict({"name": "slow", "sample_rate": rate, "plant": {"kind": "axis"}})
    assert ss.learn(loop, logs).axis is not None
