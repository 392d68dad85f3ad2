"""Which causes outside the list of faults explain a window, and since when the one that explains all of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from servoscope.core.arrays import FloatArray, IntArray
from servoscope.isolation.ml.hypothesis import MAX_EXCESS_SQUARES, HypothesisFit, refit_jointly
from servoscope.isolation.ml.onset import (
    ONSET_COST_QUANTILE,
    POSTERIOR_SHARE,
    OnsetEstimate,
    onset_interval,
    onset_posterior,
)
from servoscope.isolation.ml.other_causes import CauseWindow, OtherCause, causes_at, parameter_cause
from servoscope.isolation.ml.result import RefitResult
from servoscope.isolation.ml.search import MAX_LOOKS
from servoscope.isolation.ml.start_values import fit_further_parameters
from servoscope.isolation.ml.timeline import MAX_BRIDGE, bridge_height
from servoscope.isolation.ml.window import ChangeProfile, ChangeWindow

FIT_TOLERANCE = 6.0  # of the sum of squares; a likelihood 20 times smaller is not as good
MIN_EXPLAINED_SHARE = 0.95  # of what the healthy plant does not explain
MAX_WHITE_VARIANCE = 1.15  # variance of the innovations up to which nothing but noise is left
FIRST_ONSETS = 24  # onsets that are tried at first
STRIDES = 256, 64, 16, 4, 1  # samples by which an onset is moved then,
MAX_MOVES = 4  # and at most so many times
POINTS = 33  # of the likelihood of the onset on either side of the best


def find_other_causes(refined: RefitResult, since: ChangeProfile | None = None) -> list[OtherCause]:
    """Return the causes that explain the window, the likeliest first; `since`: when the one came that explains it.

    Where a fault or a pair is the best explanation, those that are as good. Where none is, the best of the others and
    those as good as it, if they explain nearly all that the healthy plant does not.
    """
    window, best, causes = refined.window, refined.best.fitted, CauseWindow(refined.window)
    others = _all_causes(refined, causes, since or best.profile)
    limit = best.cost
    if refined.is_unknown:
        if since is None:  # the onset of an explanation that is none may mean nothing
            earlier = _all_causes(refined, causes, ChangeProfile(refined.initial_onset))
            others = min(others, earlier, key=lambda causes: min(cause.cost for cause in causes))
        most = window.samples + (1.0 - MIN_EXPLAINED_SHARE) * (causes.healthy_cost - window.samples)
        enough = min(max(most, MAX_WHITE_VARIANCE * window.samples), best.cost)
        limit = min([cause.cost for cause in others if enough >= cause.cost], default=-np.inf)
    return sorted(
        (c for c in others if limit + FIT_TOLERANCE * refined.noise_variance >= c.cost),
        key=lambda cause: cause.cost,
    )


def find_outside_onset(refined: RefitResult) -> OnsetEstimate | None:
    """Return since when one cause outside the list of faults explains the whole window down to noise, all else healthy.

    None where none does, or a fault does nearly as well. The onset of an explanation that is none means nothing: every
    cause is tried at many.
    """
    window, causes = refined.window, CauseWindow(refined.window)
    starts = {min(refined.best.fitted.profile.onset, refined.latest), refined.initial_onset}
    everywhere = {*starts, *np.linspace(0, refined.latest, FIRST_ONSETS).astype(int).tolist()}
    tried = [(causes.fit(name, k), k) for name in causes.nonlinear for k in sorted(starts)]
    tried += [(causes.fit(name, k), k) for name in causes.disturbances for k in sorted(everywhere)]
    cause, onset = min(tried, key=lambda candidate: candidate[0].cost)
    parameter = min(refined.other_parameters, key=lambda fitted: fitted.cost, default=None)
    if parameter is not None and parameter.cost < cause.cost:
        estimate, cause = _parameter_onset(window, parameter, refined.latest)
    else:
        estimate, cause = _disturbance_onset(causes, cause, onset, refined.latest)
    variance = cause.cost / window.used
    e = cause.residual[: window.samples]
    quiet = variance <= MAX_WHITE_VARIANCE and bridge_height(e**2 / variance - 1.0) <= MAX_BRIDGE
    return estimate if quiet and cause.cost + MAX_EXCESS_SQUARES * variance < refined.best.fitted.cost else None


def _all_causes(refined: RefitResult, causes: CauseWindow, profile: ChangeProfile) -> list[OtherCause]:
    window, best = refined.window, refined.best.fitted
    parameters: Sequence[HypothesisFit] = refined.other_parameters
    if profile != best.profile:
        parameters = fit_further_parameters(window, profile, best, refined.noise_variance)
    return [*map(parameter_cause, parameters), *causes_at(causes, profile.onset + profile.duration // 2)]


def _parameter_onset(window: ChangeWindow, fitted: HypothesisFit, latest: int) -> tuple[OnsetEstimate, OtherCause]:
    """Find onset and size of a parameter in turns."""
    for _ in range(MAX_LOOKS):
        estimate = onset_posterior(window, fitted, latest, fitted.cost / window.used, drifts=False)
        if estimate.profile == fitted.profile:
            break
        fitted = refit_jointly(window, replace(fitted, profile=estimate.profile))
    return estimate, parameter_cause(fitted)


def _disturbance_onset(
    causes: CauseWindow, cause: OtherCause, onset: int, latest: int
) -> tuple[OnsetEstimate, OtherCause]:
    """Find onset and size in turns, then how far off the onset may be."""

    def cost(k: int) -> float:
        return causes.fit(cause.name, k, cause.value).cost

    for _ in range(MAX_LOOKS):
        before = onset
        for stride in STRIDES:
            moved = np.clip(onset + stride * np.arange(-MAX_MOVES, MAX_MOVES + 1), 0, latest)
            onset = int(min(np.unique(moved).tolist(), key=cost))
        cause = causes.fit(cause.name, onset)
        if onset == before:
            break
    variance = cause.cost / causes.window.used
    low, high = _onset_interval(cost, onset, latest, variance)
    return OnsetEstimate(ChangeProfile(onset), low, high, {}), cause


def _onset_interval(cost: Callable[[int], float], onset: int, latest: int, variance: float) -> tuple[int, int]:
    """Return the 95 % interval of an onset."""
    least, negligible = cost(onset), 2.0 * float(np.log(1.0 / POSTERIOR_SHARE)) * variance
    ends = []
    for way, edge in ((-1, 0), (1, latest)):
        step = 1
        while (onset + way * step - edge) * way < 0 and cost(onset + way * step) < least + negligible:
            step *= 2
        ends.append(int(np.clip(onset + way * step, 0, latest)))
    onsets: IntArray = np.unique(np.concatenate([np.linspace(end, onset, POINTS) for end in ends]).astype(np.int64))
    costs: FloatArray = np.array([cost(int(k)) for k in onsets]) - least
    # each stands for the samples half-way to its neighbours
    width = np.gradient(onsets.astype(np.float64)) if len(onsets) > 1 else np.ones(1)
    return onset_interval(onsets, np.exp(-0.5 * costs / variance) * width, costs <= ONSET_COST_QUANTILE * variance)
