"""Since when: the onset of a change, by a change point of the residual of the regression."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.estimation.noise_model import long_run_inflation
from servoscope.estimation.pipeline import Pipeline
from servoscope.signals import Recording

MEMORIES_BEFORE_ALARM = 40.0  # in which the onset is looked for first
MIN_PROBABILITY = 1e-9  # of an onset before them, from which on the search goes further back
MAX_LOG_RATIO = 1.92  # of two onsets that 95 % intervals both hold: half of what chi-square exceeds in 5 % of cases


@dataclass(frozen=True)
class Onset:
    """Since when: the 95 % interval and the most likely time [s], and the sample of the latter."""

    low_s: float
    likely_s: float
    high_s: float
    sample: int


def estimate_onset(
    pipeline: Pipeline, recording: Recording, healthy: FloatArray, faulty: FloatArray, until: int, last: int
) -> Onset:
    """Find when the regression stopped following `healthy` and went towards `faulty`.

    Change point by least squares on the residual of the regression, the size of the change at its best for each time,
    with a flat prior over the samples before the alarm (Basseville and Nikiforov, 1993, section 2.6). While the filters
    settle, the share of the change that they have let through counts. The residual is coloured, and where friction or
    elasticity are not the model's it is no noise at all; so the likelihood is tempered by the long-run variance of the
    scores (Newey and West, 1987) instead of whitened, which would raise what the model misses above the change.

    `healthy, faulty`: coefficients before, and on the way of the change, shape (n,); `until`: sample of the alarm: the
    onset is not later; `last`: last sample that `faulty` speaks for.
    """
    reach = round(MEMORIES_BEFORE_ALARM * pipeline.memory * pipeline.stride)
    while True:
        begin = max(until - reach, 0) // pipeline.stride * pipeline.stride
        near = recording.rows(slice(begin, min(last, until + reach) + 1))
        likelihood, resting = _log_likelihood(pipeline, near, healthy, faulty, until - begin)
        weight = np.exp(likelihood - likelihood.max())
        share = np.cumsum(weight) / weight.sum()
        # a change while nothing is learned shows when the motion begins: what may have come at rest came at rest
        at_rest = resting & (likelihood >= likelihood.max() - MAX_LOG_RATIO)
        likely = int(np.argmax(at_rest if at_rest.any() else likelihood))
        if not begin or share[(until - begin) // 2] < MIN_PROBABILITY:
            break
        reach *= 2  # the change may have come earlier
    low, high = (begin + int(k) for k in np.searchsorted(share, [0.025, 0.975]))
    likely += begin
    # what the filters leave of a step is known only about, so neither end is surer than half their settling time
    blur = pipeline.bank.wait // 2
    low, high = max(min(low, likely - blur), 0), min(max(high, likely + blur), until)
    t = recording.t
    return Onset(float(t[low]), float(t[likely]), float(t[high]), likely)


def _log_likelihood(
    pipeline: Pipeline, recording: Recording, healthy: FloatArray, faulty: FloatArray, until: int
) -> tuple[FloatArray, BoolArray]:
    """Return the log likelihood of a change at each sample up to `until`, and which samples are left out."""
    # u itself changes at once, where u_a of stage 1 has to learn the change first
    single = replace(pipeline, stage_one=None)
    g = single.regression(recording.r, recording.u, recording.y, recording.restart)
    # rows that are left out say nothing, but the filters go on: by their end they have let all of a change through
    rows = slice(pipeline.stride - 1, None, pipeline.stride)
    phi, ok, ramp = g.phi[rows], g.ok[rows], _onset_of_filters(pipeline)
    v, changed = np.where(ok, g.eta[rows] - phi @ healthy, 0.0), np.where(ok, phi @ (faulty - healthy), 0.0)
    score = _sums_after(v * changed, ramp)
    information = np.maximum(_sums_after(changed**2, ramp**2), np.finfo(np.float64).tiny)
    size = np.maximum(score, 0.0) / information
    # a change between two updates shows at the later one
    at_update = np.minimum(np.arange(until + 1) // pipeline.stride, len(v) - 1)
    gained = size * score
    best = at_update[int(np.argmax(gained[at_update]))]
    e = v - size[best] * changed * np.concatenate([np.zeros(best), ramp, np.ones(len(v))])[: len(v)]
    variance = float(e @ e) / max(int(ok.sum()), 1) * long_run_inflation((e * changed)[ok], len(ramp))
    return np.asarray(gained[at_update] / (2.0 * variance)), ~ok[at_update]


def _onset_of_filters(pipeline: Pipeline) -> FloatArray:
    """Return how much of a sudden change the filters have let through, update by update: 0 to 1, shape (W,)."""
    bank = pipeline.bank
    w = np.zeros((bank.wait + 1, bank.system.B.shape[1]))
    w[1:, 1] = 1.0  # u steps
    response = bank.system.simulate(w)[1:, 0] / bank.gain
    share = response[pipeline.stride - 1 :: pipeline.stride] / max(float(response[-1]), 1e-12)
    return np.asarray(np.clip(share, 0.0, 1.0))


def _sums_after(x: FloatArray, ramp: FloatArray) -> FloatArray:
    """Return for each update i the sum of x(k) ramp(k - i) over k >= i, shape (N,); behind its end the ramp is 1."""
    N, W = len(x), len(ramp)
    after = np.concatenate([np.cumsum(x[::-1])[::-1], np.zeros(W + 1)])[W : W + N]
    return np.asarray(np.correlate(np.concatenate([x, np.zeros(W - 1)]), ramp, "valid") + after)
