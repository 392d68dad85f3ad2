"""Sets of causes that explain a change of coefficients, with the sizes of each."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.sums.evidence import evidence
from servoscope.sums.healthy import CHANGE_STD, Healthy
from servoscope.sums.records import FaultDirection, Explanation, Ratio

MAX_CAUSES = 3  # causes at once
CAUSE_COST = 3.0  # nats that each cause has to gain
MIN_SINGULAR = 0.05  # smallest singular value over the largest, from which coefficients show all causes of a set
MAX_PROJECTION_DIFFERENCE = 0.02  # difference of projections, below which two sets of causes move the same coefficients
MIN_RATIO = 1e-3
MAX_DEGREES = 1e6


class _Set(NamedTuple):
    """Sets of causes that span the same coefficients, the simplest first."""

    projection: FloatArray  # on the coefficients that they move, shape (p, p)
    causes: list[tuple[FaultDirection, ...]]


def explanations(
    healthy: Healthy, reference: FloatArray, M: FloatArray, w: FloatArray, S: FloatArray, degrees: float
) -> tuple[Explanation, ...]:
    """Return sets of causes that explain a stretch, by their probability; they add up to 1.

    `reference` (p,): what the coefficients would be if healthy; M and w: information and score about it; S (p, p):
    the covariance of a healthy stretch, known with so many degrees of freedom.
    """
    none = float(evidence(M, w, S))
    weighed = []
    sets = _distinct_sets(healthy.equations.causes(reference), healthy.unit, healthy.equations.free)
    for causes_set in sets:
        D = CHANGE_STD * np.column_stack([cause.direction for cause in causes_set.causes[0]])
        odds = float(evidence(M, w, S + D @ D.T)) - none - CAUSE_COST * D.shape[1]
        weighed.append((odds, causes_set.causes))
    fixed = len(w) - len(healthy.equations.free)
    if all(
        np.linalg.matrix_rank(causes_set.projection) < fixed for causes_set in sets
    ):  # no set of causes explains everything
        weighed.append((float(evidence(M, w, S + healthy.wide)) - none - CAUSE_COST * MAX_CAUSES, []))
    weighed.sort(key=lambda entry: -entry[0])
    weights = np.exp([odds - weighed[0][0] for odds, _ in weighed])
    results = []
    for (odds, causes), probability in zip(weighed, (weights / weights.sum()).tolist(), strict=True):
        told = [_ratios(M, w, S, some, degrees) for some in causes]
        results.append(Explanation(told[0] if told else (), probability, odds, tuple(told[1:])))
    return tuple(results)


def _distinct_sets(causes: Sequence[FaultDirection], unit: FloatArray, free: Iterable[int]) -> list[_Set]:
    fixed = np.setdiff1d(np.arange(len(unit)), list(free))
    sets = list[_Set]()
    for some in (some for k in range(1, MAX_CAUSES + 1) for some in combinations(causes, k)):
        D = np.column_stack([cause.direction for cause in some])[fixed] / unit[fixed, None]
        U, values, _ = np.linalg.svd(D, full_matrices=False)
        if len(some) > len(fixed) or values[-1] < MIN_SINGULAR * values[0]:
            continue
        projection = U @ U.T
        same = (
            causes_set
            for causes_set in sets
            if len(causes_set.causes[0]) == len(some) and _alike(causes_set.projection, projection)
        )
        known = next(same, None)
        if known is None:
            sets.append(_Set(projection, [some]))
        else:
            known.causes.append(some)
    return sets


def _alike(projection: FloatArray, other: FloatArray) -> bool:
    return float(np.abs(projection - other).max()) < MAX_PROJECTION_DIFFERENCE


def _ratios(
    M: FloatArray, w: FloatArray, S: FloatArray, causes: Sequence[FaultDirection], degrees: float
) -> tuple[Ratio, ...]:
    """Return the generalised least-squares sizes of causes; the healthy scatter S counts as noise."""
    from scipy.stats import t as student

    D = np.column_stack([cause.direction for cause in causes])
    solved = np.linalg.solve(np.eye(len(w)) + M @ S, np.column_stack([M @ D, w]))  # (M^-1 + S)^-1 [D, deviation]
    covariance = np.linalg.inv(D.T @ solved[:, :-1] + 1e-9 * np.eye(len(causes)))
    size = covariance @ (D.T @ solved[:, -1])
    std = float(student.ppf(0.975, min(degrees, MAX_DEGREES))) * np.sqrt(np.diag(covariance).clip(0.0))
    gain = 1.0 + sum(float(v) for cause, v in zip(causes, size, strict=True) if cause.multiplies_all)
    ratios = []
    for cause, v, e in zip(causes, size.tolist(), std.tolist(), strict=True):
        over = 1.0 if cause.multiplies_all else max(gain, MIN_RATIO)
        ratios.append(Ratio(cause.name, *(max(1.0 + x / over, MIN_RATIO) for x in (v, v - e, v + e))))
    return tuple(ratios)
