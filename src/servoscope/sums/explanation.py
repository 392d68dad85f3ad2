"""Sets of causes that explain a change of coefficients, with the sizes of each."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.verdict import Explanation
from servoscope.sums.evidence import evidence
from servoscope.sums.healthy import CHANGE_STD, Healthy
from servoscope.sums.records import FaultDirection

MAX_CAUSES = 3  # causes at once
CAUSE_COST = 3.0  # nats that each cause has to gain
MIN_SINGULAR = 0.05  # smallest singular value over the largest, from which coefficients show all causes of a set
MAX_PROJECTION_DIFFERENCE = 0.02  # difference of projections, below which two sets of causes move the same coefficients
MIN_RATIO = 1e-3
MAX_BEHIND = 10.0  # nats behind the likeliest set, from which one is not told
MAX_DEGREES = 1e6
TAIL = 0.025  # of an interval, on each side


class _Set(NamedTuple):
    """Sets of causes that span the same coefficients, the simplest first."""

    projection: FloatArray  # on the coefficients that they move, shape (p, p)
    causes: list[tuple[FaultDirection, ...]]


def explanations(
    healthy: Healthy, reference: FloatArray, M: FloatArray, w: FloatArray, S: FloatArray, degrees: float
) -> tuple[Explanation, ...]:
    """Return the sets of causes that explain a stretch, the likeliest first.

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
    # where no set of causes explains everything
    if all(np.linalg.matrix_rank(causes_set.projection) < fixed for causes_set in sets):
        weighed.append((float(evidence(M, w, S + healthy.wide)) - none - CAUSE_COST * MAX_CAUSES, []))
    weighed.sort(key=lambda entry: -entry[0])
    nats = np.array([odds for odds, _ in weighed])
    results = []
    for i, (odds, causes) in enumerate(weighed):
        if odds < nats[0] - MAX_BEHIND:
            break
        log_odds = odds - float(np.logaddexp.reduce(np.delete(nats, i), initial=-np.inf)) if len(nats) > 1 else np.inf
        told = [_explanation(M, w, S, some, log_odds, degrees) for some in causes]
        unknown = Explanation((), log_odds, np.zeros(0), np.zeros((0, 0)))
        results.append(told[0]._replace(alike=tuple(told[1:])) if told else unknown)
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


def _explanation(
    M: FloatArray, w: FloatArray, S: FloatArray, causes: Sequence[FaultDirection], log_odds: float, degrees: float
) -> Explanation:
    """Return causes with their generalised least-squares sizes; the healthy scatter S counts as noise."""
    from scipy.stats import norm
    from scipy.stats import t as student

    D = np.column_stack([cause.direction for cause in causes])
    solved = np.linalg.solve(np.eye(len(w)) + M @ S, np.column_stack([M @ D, w]))  # (M^-1 + S)^-1 [D, deviation]
    covariance = np.linalg.inv(D.T @ solved[:, :-1] + 1e-9 * np.eye(len(causes)))
    size = covariance @ (D.T @ solved[:, -1])
    gains = np.array([cause.multiplies_all for cause in causes])
    over = np.where(gains, 1.0, max(1.0 + float(size[gains].sum()), MIN_RATIO))
    ratio = np.maximum(1.0 + size / over, MIN_RATIO)
    wider = student.ppf(TAIL, min(degrees, MAX_DEGREES)) / norm.ppf(TAIL)  # S is known from few recordings
    covariance = covariance * float(wider) ** 2 / np.outer(ratio * over, ratio * over)
    return Explanation(tuple(cause.name for cause in causes), log_odds, np.log(ratio), covariance)
