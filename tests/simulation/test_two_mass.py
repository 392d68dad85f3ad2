"""The simulated axis of two masses against a general solver of its differential equation, and its table of faults."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

from public.simple_detectors import FeatureT2, judge
from studies import two_mass as benchmark
from tools import two_mass

import servoscope as ss
from servoscope.core.arrays import FloatArray

SAMPLES = 300  # the first move and the rest after it


def _solve(parameters: two_mass.Parameters, r: FloatArray, temperature: float) -> tuple[FloatArray, FloatArray]:
    """Return u and y of the loop; the motion between samples by an implicit solver with small tolerances."""
    p, dt = np.array(parameters), 1.0 / two_mass.RATE
    x, state = np.zeros(5), np.zeros(3)
    u, y = np.zeros(len(r)), np.zeros(len(r))
    for k in range(len(r)):
        y[k] = two_mass.measure(x[0], p, 0.0, 0.0)
        ahead = (r[min(k + 1, len(r) - 1)] - r[k]) / dt
        u[k] = two_mass.control(p, state, r[k], ahead, y[k], dt)
        solved = solve_ivp(
            lambda _, x, held=u[k]: two_mass.derivative(x, held, p, temperature),
            (0.0, dt),
            x,
            method="LSODA",
            rtol=1e-8,
            atol=1e-12,
        )
        x = solved.y[:, -1]
    return u, y


@pytest.mark.parametrize(
    "change", [None, two_mass.Change("backlash", 20.0), two_mass.Change("coupling stiffness", 0.25)]
)
def test_fixed_steps_agree_with_a_general_solver(change: two_mass.Change | None) -> None:
    r = two_mass.production()[:SAMPLES]
    parameters = two_mass.HEALTHY if change is None else change.apply(two_mass.HEALTHY)
    temperature, quiet = np.full(SAMPLES, 30.0), np.zeros((2, SAMPLES))
    u, y = two_mass.simulate_axis(parameters, r, temperature, quiet, resolution=0.0)
    u_solved, y_solved = _solve(parameters, r, 30.0)
    assert np.abs(u - u_solved).max() < 5e-3 * np.abs(u).max()
    assert np.abs(y - y_solved).max() < 1e-6


def test_a_fault_begins_at_its_time() -> None:
    change = two_mass.Change("friction", 1.5, two_mass.MIDDLE_S)
    healthy, faulty = two_mass.record_day(3), two_mass.record_day(3, change)
    at = round(two_mass.MIDDLE_S * two_mass.RATE)
    assert np.array_equal(healthy.u[:at], faulty.u[:at])
    assert np.abs(healthy.u[at:] - faulty.u[at:]).max() > 0.1


def test_the_table_of_faults_is_as_hard_as_it_was() -> None:
    """T^2 of nine features finds about half of the faults, in recordings of one cycle's window, without an alarm."""
    assert len(two_mass.FAULTS) == 42
    learned, healthy = two_mass.learned_days(), two_mass.healthy_days(8)
    scores = judge(FeatureT2(two_mass.CYCLE_S), learned, [*healthy, *two_mass.faulty_days()])
    above = [score > scores.limit for score in scores.largest]
    assert sum(above[:8]) == 0
    assert 20 <= sum(above[8:]) <= 26


@pytest.fixture(scope="module")
def baseline() -> ss.Baseline:
    return ss.learn(ss.Loop.from_dict(benchmark.LOOP | benchmark.COVARIATES), two_mass.learned_days())


def test_half_the_speed_is_no_fault_and_hides_none(baseline: ss.Baseline) -> None:
    """The change limit of an axis was learned under the healthy motion; at half its speed all days changed."""
    for seed in (901, 904):  # days within the learned temperatures
        judged = ss.diagnose(baseline, two_mass.record_day(seed, speed=0.5))
        assert judged.verdict in ("healthy", "undetermined")
        assert {"motion", "power", "features"} & {warning.kind for warning in judged.warnings}
    worn = ss.diagnose(baseline, two_mass.record_day(950, two_mass.Change("friction", 2.0), speed=0.5))
    assert worn.verdict == "fault"


def test_severities_are_ordered_by_size(baseline: ss.Baseline) -> None:
    factors = (1.3, 1.5, 1.8, 2.2, 2.8)
    changes = [two_mass.Change("friction", factor, two_mass.MIDDLE_S) for factor in factors]
    judged = [ss.diagnose(baseline, two_mass.record_day(240, change, start_c=25.0)) for change in changes]
    sizes = [diagnosis.faults[0].ratio for diagnosis in judged]
    assert sizes == sorted(sizes)
    for diagnosis, factor in zip(judged, factors, strict=True):
        assert [fault.name for fault in diagnosis.faults] == ["dry_friction"]
        low, high = diagnosis.faults[0].interval
        assert low <= factor <= high


def test_what_is_a_little_beyond_the_learned_temperatures_is_judged(baseline: ss.Baseline) -> None:
    """Up to a fifth of the learned range outside of it, where limits are wider."""
    cold = {"start_c": two_mass.COLD_C - 1.0}
    assert ss.diagnose(baseline, two_mass.record_day(260, **cold)).verdict == "healthy"
    worn = ss.diagnose(baseline, two_mass.record_day(260, two_mass.Change("payload", 1.4), **cold))
    assert worn.verdict == "suspect", worn.headline
    colder = two_mass.record_day(260, start_c=two_mass.COLD_C - 8.0)
    assert ss.diagnose(baseline, colder).verdict == "undetermined"
