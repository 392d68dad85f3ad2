"""Naming a fault from a deviation: probabilities, sizes with intervals, ambiguity and "unknown"."""

from __future__ import annotations

from collections.abc import Callable

import naive
import numpy as np
import pytest
from scipy import integrate

from servoscope.core.errors import SimulationError
from servoscope.isolation.candidate import UNKNOWN, Candidate
from servoscope.isolation.isolate import SYSTEMATIC_ERROR_SHARE, isolate
from servoscope.isolation.signature import Signature, coefficient_signature, parameter_signature
from servoscope.models.plants import Fault

SCALE = np.array([1.0, 1e-2, 1e-5, 1e-7])  # coefficients have very different sizes
CORRELATION = np.array([[1.0, 0.3, 0.0, 0.1], [0.3, 1.0, -0.2, 0.0], [0.0, -0.2, 1.0, 0.5], [0.1, 0.0, 0.5, 1.0]])
SIGMA = 1e-4 * CORRELATION * np.outer(SCALE, SCALE)
PUMP, LEAK, RUB = (
    np.array([3.0, 2.0, 1.0, 1.0]), np.array([0.0, 2.0, -1.0, 1.0]), np.array([1.0, -1.0, 2.0, 1.0]),
)  # fmt: skip


def bent(direction: naive.Array) -> Callable[[float], naive.Array]:
    """Return a curve that leaves the healthy point along a direction and bends away from it."""
    return lambda ratio: SCALE * (direction * np.log(ratio) + 0.3 * np.roll(direction, 1) * np.log(ratio) ** 2)


def fault(name: str, low: float = 0.2, high: float = 5.0) -> Fault:
    return Fault(name, name[:1], (low, high), f"words for {name}")


def three() -> list[Signature]:
    return [parameter_signature(fault(name), bent(d)) for name, d in (("pump", PUMP), ("leak", LEAK), ("rub", RUB))]


def draw(mean: naive.Array, seed: int) -> naive.Array:
    return np.random.default_rng(seed).multivariate_normal(mean / SCALE, SIGMA / np.outer(SCALE, SCALE)) * SCALE


def check_form(candidates: tuple[Candidate, ...], count: int) -> None:
    shares = [candidate.probability for candidate in candidates]
    assert sum(shares) == pytest.approx(1.0, abs=1e-12)
    assert shares == sorted(shares, reverse=True)
    assert len(candidates) == count and [c.name for c in candidates].count(UNKNOWN) == 1
    assert all(c.faults == () for c in candidates if c.name == UNKNOWN)


@pytest.mark.parametrize("ratio", [0.3, 0.9, 1.2, 4.9])
@pytest.mark.parametrize("which", [0, 1, 2])
def test_names_and_sizes_a_fault(which: int, ratio: float) -> None:
    signature = three()[which]
    calls: list[int] = []
    candidates = isolate(three(), draw(signature.shift(np.log(ratio)), 1), SIGMA, lambda: calls.append(1))
    check_form(candidates, 4)
    best = candidates[0]
    assert best.name == signature.fault.name and best.probability > 0.95
    (found,) = best.faults
    assert found.parameter == signature.fault.parameter
    assert found.ratio == pytest.approx(ratio, rel=0.03)
    assert found.interval[0] <= found.ratio <= found.interval[1]
    assert len(calls) == 3


def test_intervals_hold_the_truth_19_times_of_20() -> None:
    hits = 0
    for seed in range(200):
        ratio = 1.1 + 0.004 * seed
        candidates = isolate(three()[1:2], draw(bent(LEAK)(ratio), seed), SIGMA)
        low, high = next(c for c in candidates if c.name == "leak").faults[0].interval
        hits += low <= ratio <= high
    assert 181 <= hits <= 198, hits


@pytest.mark.parametrize("ratio", [0.8, 1.1, 3.0])
def test_what_is_not_known_of_the_healthy_value_widens_a_size_as_far_as_it_has_changed(ratio: float) -> None:
    """The healthy value is off by 20 % (standard deviation), and what is seen is the change, not the ratio."""
    rng, inside, widths, std = np.random.default_rng(1), 0, [], 0.2
    line = parameter_signature(fault("pump"), lambda q: SCALE * PUMP * (q - 1.0), std)
    for seed in range(100):
        seen = SCALE * PUMP * (ratio - 1.0) * np.exp(std * rng.standard_normal())
        (found,) = isolate([line], draw(seen, seed), SIGMA, lambda: None)[0].faults
        inside += found.interval[0] <= ratio <= found.interval[1]
        widths.append(np.log(found.interval[1] / found.interval[0]))
    assert inside >= 90
    assert np.median(widths) < 1.5 * 2.0 * 1.96 * std * abs(ratio - 1.0)


def test_probabilities_are_the_integrals_over_the_prior() -> None:
    """Against adaptive quadrature, where two faults fit about equally well."""
    first, second = bent(PUMP), bent(PUMP + np.array([0.0, 0.0, 0.0, 0.15]))
    signatures = [parameter_signature(fault("first"), first), parameter_signature(fault("second", 0.5, 2.0), second)]
    d = draw(0.5 * (first(1.1) + second(1.1)), 3)
    size = np.sqrt(np.diag(SIGMA))

    def weight(x: float, shift: Callable[[float], naive.Array]) -> float:
        s = shift(float(np.exp(x)))
        S = (SIGMA + np.diag((SYSTEMATIC_ERROR_SHARE * s) ** 2)) / np.outer(size, size)
        miss = (d - s) / size
        return float(np.exp(-0.5 * miss @ np.linalg.inv(S) @ miss) / np.sqrt(np.linalg.det(S)))

    evidence = []
    for shift, signature in ((first, signatures[0]), (second, signatures[1])):
        near = np.log(1.1)
        area = integrate.quad(weight, near - 0.1, near + 0.1, args=(shift,), points=[near], limit=200)[0]
        evidence.append(area / (signature.high - signature.low))
    share = {c.name: c.probability for c in isolate(signatures, d, SIGMA)}
    known = share["first"] + share["second"]
    assert 0.02 < share["first"] / known < 0.98
    assert share["first"] / known == pytest.approx(evidence[0] / sum(evidence), abs=0.01)


def test_interval_is_as_sharp_where_the_grid_misses_the_truth() -> None:
    """The truth lies half-way between two points of its own grid, while a rival's grid happens to fit better."""
    along, aside = np.ones(4), np.array([1.0, -1.0, 1.0, -1.0])
    sigma, ratio = 1e-3, 5.0 ** (3.0 / 16.0)
    rival = 0.75 * along + 0.15 * aside
    pair = [
        parameter_signature(fault("true"), lambda q: along * np.log(q)),
        parameter_signature(fault("rival"), lambda q: rival * np.log(q)),
    ]
    widths = []
    for seed in range(10):
        d = along * np.log(ratio) + sigma * np.random.default_rng(seed).standard_normal(4)
        best = isolate(pair, d, sigma**2 * np.eye(4))[0]
        assert best.name == "true"
        widths.append(np.log(best.faults[0].interval[1] / best.faults[0].interval[0]))
    expected = 3.92 * np.hypot(sigma, SYSTEMATIC_ERROR_SHARE * np.log(ratio)) / np.linalg.norm(along)
    assert np.mean(widths) == pytest.approx(expected, rel=0.3)


def test_two_curves_that_coincide_are_ambiguous() -> None:
    twins = [parameter_signature(fault("one"), bent(RUB)), parameter_signature(fault("other"), bent(RUB)), three()[0]]
    candidates = isolate(twins, draw(bent(RUB)(1.5), 2), SIGMA)
    check_form(candidates, 4)
    assert {candidates[0].name, candidates[1].name} == {"one", "other"}
    assert candidates[0].probability == pytest.approx(candidates[1].probability, rel=1e-9)
    assert 0.4 < candidates[0].probability < 0.5


def test_unknown_when_no_curve_fits() -> None:
    aside = np.cross(PUMP[:3], LEAK[:3])
    candidates = isolate(three(), SCALE * np.append(aside, -3.0), SIGMA)
    check_form(candidates, 4)
    assert candidates[0].name == UNKNOWN and candidates[0].probability > 0.999


def test_unknown_seldom_wins_over_the_true_fault() -> None:
    wins = sum(isolate(three(), draw(bent(PUMP)(1.3), seed), SIGMA)[0].name == UNKNOWN for seed in range(200))
    assert wins <= 2


def test_no_signatures_at_all_is_unknown() -> None:
    assert isolate([], 0.1 * SCALE, SIGMA) == (Candidate(name=UNKNOWN, probability=1.0),)


def test_sizes_at_which_the_loop_is_unstable_are_impossible() -> None:
    def shift(ratio: float) -> naive.Array:
        if ratio > 2.0:
            raise SimulationError("unstable")
        return bent(PUMP)(ratio)

    half = [parameter_signature(fault("pump"), shift)]
    candidates = isolate(half, draw(bent(PUMP)(1.9), 1), SIGMA)
    assert candidates[0].name == "pump"
    assert candidates[0].faults[0].ratio == pytest.approx(1.9, rel=0.03)
    assert candidates[0].faults[0].interval[1] <= 2.0 + 1e-9
    never = [parameter_signature(fault("pump"), lambda _: shift(3.0)), *three()[1:]]
    assert {c.name for c in isolate(never, draw(bent(LEAK)(1.5), 1), SIGMA)} == {"leak", "rub", UNKNOWN}


@pytest.mark.parametrize("change", [-0.5, 0.25, 3.0])
def test_lines_measure_a_coefficient_in_its_own_size(change: float) -> None:
    theta = SCALE * [2.0, 3.0, 4.0, 5.0]
    lines = [
        coefficient_signature(fault(name, 0.1, 10.0), np.where(np.arange(4) == i, theta, 0.0))
        for i, name in enumerate("abcd")
    ]
    candidates = isolate(lines, draw(change * np.where(np.arange(4) == 2, theta, 0.0), 5), SIGMA)
    assert candidates[0].name == "c" and candidates[0].probability > 0.95
    (found,) = candidates[0].faults
    assert found.ratio == pytest.approx(1.0 + change, abs=0.02)
    assert found.interval[0] < 1.0 + change < found.interval[1]
