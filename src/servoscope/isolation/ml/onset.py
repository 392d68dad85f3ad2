"""Since when, exactly: the posterior of onset and duration of a change, its sizes following."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.isolation.ml.hypothesis import HypothesisFit
from servoscope.isolation.ml.window import ChangeProfile, ChangeWindow
from servoscope.isolation.posterior import INTERVAL

STEP = 1e-3  # of the logarithm of a parameter, for derivatives
MIN_DRIFT_S = 0.2  # of a drift that is not called a step
STEP_PRIOR = 0.5  # probability of a step, before anything is known
MAX_STEP_ONSETS = 400  # onsets of a step that are tried at first, at most
DURATION_RATIO = 1.6  # of one duration to the next, at first
ONSETS_PER_DURATION = 4  # onsets that are tried within the duration of a drift
REFINEMENT_FACTOR = 3  # times closer together they are in each further look
LOOKS = 5
POSTERIOR_SHARE = 1e-4  # of the largest posterior, that a further look may leave out
ONSET_COST_QUANTILE = 7.35  # of the cost: what the true onset reaches in 95 % of the cases (Hansen, 2000, table 1)


@dataclass(frozen=True)
class OnsetEstimate:
    """Onset of a change within a window."""

    profile: ChangeProfile  # the most likely one
    low: int  # low, high: 95 % interval of the first changed sample, whatever the duration
    high: int
    # standard deviations of the sizes' logarithms that come from not knowing when, by parameter
    size_std: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class _ChangeGrid:
    """Changes that were tried: onsets and durations [samples], their cost and their share of the prior, (M,).

    `moved` (M, k) is how far each takes the sizes.
    """

    onsets: IntArray
    durations: IntArray
    cost: FloatArray
    prior: FloatArray
    size_shifts: FloatArray


def onset_posterior(
    window: ChangeWindow, fit: HypothesisFit, latest: int, noise_variance: float, drifts: bool = True
) -> OnsetEstimate:
    """Find when a change began, as a step or as a drift.

    The likelihood of each onset and duration has the sizes and the healthy parameters at their best, by one step of
    Gauss and Newton from where they are.
    """
    table = ChangeCosts(window, fit, noise_variance)
    grids = [_step_grid(table, latest, noise_variance)]
    drifting = _ramp_grid(table, latest, noise_variance) if drifts else None
    if drifting is not None:
        grids.append(drifting)
    onsets, overs, cost, prior, moved = (np.concatenate([getattr(t, name) for t in grids]) for name in vars(grids[0]))
    likelihood = np.exp(-0.5 * (cost - cost.min()) / noise_variance)
    weight = likelihood * prior
    low, high = onset_interval(onsets, weight, cost <= cost.min() + ONSET_COST_QUANTILE * noise_variance)
    # the best of so many drifts beats the best step easily: all of them together are compared
    steps = overs == 0
    kind = steps if weight[steps].sum() >= weight[~steps].sum() else ~steps
    best = int(np.argmax(np.where(kind, likelihood, 0.0)))
    spread = np.sqrt(np.average((moved - moved[best]) ** 2, axis=0, weights=weight))
    return OnsetEstimate(
        ChangeProfile(int(onsets[best]), int(overs[best])),
        low,
        high,
        dict(zip(fit.names, spread.tolist(), strict=True)),
    )


def onset_interval(onsets: IntArray, weight: FloatArray, alike: BoolArray) -> tuple[int, int]:
    """Return the 95 % interval of an onset: of some (M,), how likely each is, and which are nearly as good as the best.

    At rest no onset is better than another: what is nearly as likely as the best belongs to it, its edge too.
    """
    order = np.argsort(onsets, kind="stable")
    share = np.cumsum(weight[order])
    low, high = (int(onsets[order][np.searchsorted(share, q * share[-1])]) for q in INTERVAL)
    return min(low, int(onsets[alike].min())), max(high, int(onsets[alike].max()))


def _step_grid(table: ChangeCosts, latest: int, noise_variance: float) -> _ChangeGrid:
    """Try steps everywhere, and at every sample where they are likely."""
    apart = max(1, latest // MAX_STEP_ONSETS)
    onsets = np.arange(0, latest + 1, apart)
    cost, moved = table.costs(onsets, np.zeros_like(onsets))
    if apart > 1:
        best = int(np.argmin(cost))  # between two tries it may fall as deep as it rises beside the best one
        beside = float(cost[max(best - 1, 0) : best + 2].max() - cost[best])
        near = onsets[cost <= cost[best] + max(_negligible_cost(noise_variance), beside)]
        onsets = np.unique((near[:, None] + np.arange(1 - apart, apart)).ravel())
        onsets = onsets[(onsets >= 0) & (onsets <= latest)]
        cost, moved = table.costs(onsets, np.zeros_like(onsets))
    return _ChangeGrid(onsets, np.zeros_like(onsets), cost, np.full(len(onsets), STEP_PRIOR), moved)


def _ramp_grid(table: ChangeCosts, latest: int, noise_variance: float) -> _ChangeGrid | None:
    """Try drifts of all durations, then ever closer to what is likely; None where the window is too short for one.

    The middle of a drift is known better than its ends, so looks are laid out by middle and duration.
    """
    shortest, longest = MIN_DRIFT_S * table.window.sample_rate, table.window.samples - 1
    if longest <= 2.0 * shortest:
        return None
    count = int(np.ceil(np.log(longest / shortest) / np.log(DURATION_RATIO))) + 1
    durations = np.geomspace(shortest, longest, count)
    ratio, share = float(durations[1] / durations[0]), 1.0 / ONSETS_PER_DURATION
    points = np.concatenate([_row(d, latest, share) for d in durations])
    for look in range(LOOKS):
        onsets, overs = _round_to_samples(points)
        inside = (onsets >= 0) & (onsets <= latest) & (overs > 0) & (overs <= longest)
        points, onsets, overs = points[inside], onsets[inside], overs[inside]
        if not len(points):
            return None
        cost, moved = table.costs(onsets, overs)
        width = np.maximum(points[:, 1] * share, 1.0) * np.log(ratio)
        prior = (1.0 - STEP_PRIOR) * width / np.log(longest / shortest)
        grids = _ChangeGrid(onsets, overs, cost, prior, moved)
        worth = cost <= cost.min() + _negligible_cost(noise_variance)
        if look == LOOKS - 1 or worth.sum() > 40 or points[worth, 1].max() * share <= 1.0:
            break
        ranked = np.argsort(cost)[: max(int(worth.sum()), 12)]
        points = np.unique(np.concatenate([_ramps_around(points[i], ratio, share) for i in ranked]), axis=0)
        ratio, share = ratio ** (1.0 / REFINEMENT_FACTOR), share / REFINEMENT_FACTOR
    return grids


def _row(duration: float, latest: int, share: float) -> FloatArray:
    """Return drifts of one duration, as middle and duration [samples], shape (M, 2)."""
    onsets = np.arange(0.0, latest + 1.0, max(duration * share, 1.0))
    return np.column_stack([onsets + duration / 2.0, np.full(len(onsets), duration)])


def _ramps_around(point: FloatArray, ratio: float, share: float) -> FloatArray:
    """Return drifts around one, in the cell that it stands for and those beside it; the grid is common to all."""
    k = np.arange(-REFINEMENT_FACTOR + 1, REFINEMENT_FACTOR)
    middles = point[0] + point[1] * share * k / REFINEMENT_FACTOR
    durations = point[1] * ratio ** (k / REFINEMENT_FACTOR)
    both = np.stack(np.meshgrid(middles, durations), axis=-1).reshape(-1, 2)
    return np.asarray(np.round(both, 3))


def _round_to_samples(points: FloatArray) -> tuple[IntArray, IntArray]:
    onsets = np.round(points[:, 0] - points[:, 1] / 2.0).astype(np.int64)
    return onsets, np.round(points[:, 1]).astype(np.int64)


def _negligible_cost(noise_variance: float) -> float:
    """Return the cost above the smallest from which a change is negligible."""
    return 2.0 * float(np.log(1.0 / POSTERIOR_SHARE)) * noise_variance


class ChangeCosts:
    """Smallest sums of squares by onset and duration."""

    def __init__(self, window: ChangeWindow, fit: HypothesisFit, noise_variance: float) -> None:
        self.window, self.noise_variance = window, noise_variance
        # the healthy parameters' share of everything, prior included, is taken out once and for all
        z = np.concatenate([fit.d, fit.x])
        Q, _ = np.linalg.qr(window.jacobian(z, fit.names, fit.profile, slice(window.nuisance_count)))
        prior = window.prior @ fit.d
        self.Q, self.outside, self.inside = (
            np.ascontiguousarray(Q[: window.samples]),
            prior @ prior,
            prior @ Q[window.samples :],
        )
        self.sums = window.change_sums(fit.d, fit.names, fit.x, STEP, self.Q)

    def costs(self, onsets: IntArray, overs: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the smallest cost of each change, (M,), and by how much it moves the sizes, (M, k).

        All changes are steps, or all are drifts.
        """
        sums, volume = self.sums(onsets, overs)
        V = sums.shape[1]
        in_e = sums[:, 0, V:] + self.inside
        in_J = sums[:, 1:V, V:]
        g = sums[:, 0, 1:V] - np.einsum("ikm,im->ik", in_J, in_e)
        H = sums[:, 1:V, 1:V] - np.einsum("ikm,ilm->ikl", in_J, in_J)
        # regularised as lightly as rounding asks: an onset at the very end leaves sizes open
        ridge = 1e-9 * np.einsum("ikk->ik", H) + 1e-12
        step = np.linalg.solve(H + ridge[:, :, None] * np.eye(V - 1), g[..., None])[..., 0]
        gained = (in_e**2).sum(axis=1) + (step * g).sum(axis=1)
        return np.asarray(sums[:, 0, 0] + self.outside - gained + self.noise_variance * volume), np.asarray(-step)
