"""Two baselines compared: which parameters moved, and which changes each of them can detect."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.core.errors import BaselineError

MIN_MOVE_STDS = 2.0  # standard deviations of a difference: below, nothing is said to have moved


class ParameterMove(NamedTuple):
    """A healthy parameter of two baselines; `change` is relative, None where the first is zero."""

    name: str
    before: float
    after: float
    change: float | None
    certain: bool  # whether the difference is at least `MIN_MOVE_STDS` standard deviations


class DetectableSizes(NamedTuple):
    """Smallest detectable change of a fault in two baselines, relative; None: none is detected."""

    name: str
    parameter: str
    before: float | None
    after: float | None


class BaselineDifference(NamedTuple):
    """What differs between two baselines at one operating point, the most certain move first."""

    point: str
    moves: tuple[ParameterMove, ...]
    detectable: tuple[DetectableSizes, ...]

    def to_dict(self) -> dict[str, object]:
        """Return it as plain values."""
        moves, sizes = [row._asdict() for row in self.moves], [row._asdict() for row in self.detectable]
        return {"point": self.point, "moves": moves, "detectable": sizes}


def compare_baselines(before: Baseline, after: Baseline) -> tuple[BaselineDifference, ...]:
    """Return the differences of two baselines by operating point.

    Parameters of the plant are compared where both know them, else the coefficients.

    Raises BaselineError if they are of different plants, or have no operating point in common.
    """
    later = {baseline.point: baseline for baseline in after.per_point}
    pairs = [(baseline, later[baseline.point]) for baseline in before.per_point if baseline.point in later]
    if not pairs or any(a.names != b.names for a, b in pairs):
        raise BaselineError("the baselines are of different plants or operating points, there is nothing to compare")
    return tuple(BaselineDifference(a.point, _moves(a, b), _detectable_sizes(a, b)) for a, b in pairs)


def _moves(a: Baseline, b: Baseline) -> tuple[ParameterMove, ...]:
    if a.healthy.ratios and a.healthy.ratios.keys() == b.healthy.ratios.keys():
        before, after = a.healthy, b.healthy
        std = {name: math.hypot(before.std.get(name, 0.0), after.std.get(name, 0.0)) for name in before.ratios}
        rows = [(name, x, after.ratios[name], after.ratios[name] * std[name]) for name, x in before.ratios.items()]
    else:
        variances = np.diag(a.covariance_array()) + np.diag(b.covariance_array())
        rows = list(zip(a.names, a.theta, b.theta, np.sqrt(variances).tolist(), strict=True))
    sizes = [(abs(y - x) / s if s else math.inf * (y != x), name, x, y) for name, x, y, s in rows]
    return tuple(
        ParameterMove(name, x, y, (y - x) / abs(x) if x else None, certain=size >= MIN_MOVE_STDS)
        for size, name, x, y in sorted(sizes, key=lambda row: -row[0])
    )


def _detectable_sizes(a: Baseline, b: Baseline) -> tuple[DetectableSizes, ...]:
    later = {(change.name, change.parameter): change.change for change in b.detectability.changes}
    return tuple(
        DetectableSizes(change.name, change.parameter, change.change, later.get((change.name, change.parameter)))
        for change in a.detectability.changes
    )
