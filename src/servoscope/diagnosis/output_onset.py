"""Since when, where u is clean: the output that a healthy plant makes of it, and from the onset on the changed one."""

from __future__ import annotations

import contextlib

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import NotEnoughError
from servoscope.detection.onset import Onset
from servoscope.diagnosis.batch_estimate import estimate_batch_deviation
from servoscope.estimation.instrument import InstrumentTuning, instrument_model
from servoscope.estimation.noise_model import long_run_inflation
from servoscope.evidence.examination import Examination
from servoscope.models.lti import LinearSystem

MAX_MEMORIES_BEFORE_ALARM = 6.0  # memories before the alarm, among which the onset is looked for
TRANSIENT_TOLERANCE = 1e-3  # share of the state at the change that the output has forgotten after the transient
MAX_TRANSIENT_SAMPLES = 2000  # samples of a transient
AT_ONCE = 512  # switches whose transients are compared together
LAGS = 50  # samples, over which the output's error may be coloured
EDGE = 0.01  # probability at the beginning of the search, from which the onset may lie before it


def refine_onset(exam: Examination, onset: Onset, sample: int, last: int) -> Onset:
    """Return the onset by the error of the simulated output; the one of the recursion where that cannot be told.

    The regression's own residual grows by the noise of y in phi once the coefficients have grown, so that the
    likelihood of its change is late. In the error of the output the noise is the same before and after (maximum
    likelihood for white noise of y and a switch that keeps the state).

    `sample` is that of the alarm, `last` the last one that the changed coefficients speak for.
    """
    baseline, recording = exam.baseline, exam.recording
    tuning = baseline.recursion.instrument
    if tuning is None or tuning.source != "input" or baseline.loop.plant.powers[0]:
        return onset
    begin = max(sample - round(MAX_MEMORIES_BEFORE_ALARM * exam.pipeline.memory * exam.pipeline.stride), 0)
    begin = max(begin, int(np.flatnonzero(recording.restart[: sample + 1])[-1]))
    with contextlib.suppress(NotEnoughError, np.linalg.LinAlgError):
        from_s, to_s = onset.likely_s, float(recording.t[last]) + 0.5 / recording.sample_rate
        deviation, _ = estimate_batch_deviation(exam, from_s, to_s)
        powers = len(baseline.loop.plant.powers)
        healthy, changed = (
            instrument_model(baseline.loop, InstrumentTuning("input", tuple(theta[:powers].tolist()))).system
            for theta in (np.array(baseline.theta), np.array(baseline.theta) + deviation)
        )
        return _onset_by_output(exam, healthy, changed, begin, sample) or onset
    return onset


def _onset_by_output(
    exam: Examination, healthy: LinearSystem, changed: LinearSystem, begin: int, sample: int
) -> Onset | None:
    """Return the most likely switch between two models from `begin` to `sample`, None where it may lie before."""
    recording = exam.recording
    near = recording.rows(slice(begin, min(sample + MAX_TRANSIENT_SAMPLES, recording.samples)))
    broken = np.flatnonzero(near.restart[1:])
    end = int(broken[0]) + 1 if len(broken) else near.samples
    u, y = near.u[:end], near.y[:end]
    x = [_states(model, u) for model in (healthy, changed)]
    models = zip((healthy, changed), x, strict=True)
    before, after = (y - state @ model.C[0] - model.D[0, 0] * u for model, state in models)
    cost = _switch_costs(before, after, x[0] - x[1], changed)[: sample - begin + 1]
    settling = min(_transient(healthy), len(cost) - 1)
    variance = float(np.mean(before[settling : max(len(cost) // 2, settling + LAGS)] ** 2))
    cost = cost[settling:]
    weight = np.exp(-(cost - cost.min()) / (2.0 * variance * long_run_inflation(after[-MAX_TRANSIENT_SAMPLES:], LAGS)))
    share = np.cumsum(weight) / weight.sum()
    if begin + settling > 0 and share[min(LAGS, len(share) - 1)] > EDGE:
        return None
    first = begin + settling
    low, high = (first + int(k) for k in np.searchsorted(share, [0.025, 0.975]))
    likely, t = first + int(np.argmin(cost)), recording.t
    return Onset(float(t[low]), float(t[likely]), float(t[min(high, sample)]), likely)


def _states(model: LinearSystem, u: FloatArray) -> FloatArray:
    """Return the states of a model before each sample, shape (N, n), from the steady state at the first."""
    x, driven, states = model.steady[:, 0] * u[0], u[:, None] * model.B[:, 0], np.empty((len(u), len(model.A)))
    for k, entering in enumerate(driven):
        states[k] = x
        x = model.A @ x + entering
    return states


def _transient(model: LinearSystem) -> int:
    """Return the samples in which a model forgets its state, at most `MAX_TRANSIENT_SAMPLES`."""
    slowest = float(np.abs(np.linalg.eigvals(model.A)).max(initial=0.0))
    return min(
        int(np.ceil(np.log(TRANSIENT_TOLERANCE) / np.log(slowest))) if 0.0 < slowest < 1.0 else 1, MAX_TRANSIENT_SAMPLES
    )


def _switch_costs(before: FloatArray, after: FloatArray, apart: FloatArray, changed: LinearSystem) -> FloatArray:
    """Return the sum of squared output errors for a switch at each sample, shape (N,).

    `before`, `after`: errors of both models, (N,); `apart`: how far their states are apart, (N, n), which after the
    switch the changed model forgets.
    """
    N, W = len(before), _transient(changed)
    decay, row = np.empty((W, len(changed.A))), changed.C[0]
    for j in range(W):
        decay[j], row = row, row @ changed.A
    sums = [np.concatenate([[0.0], np.cumsum(residual**2)]) for residual in (before, after)]
    padded, cost = np.concatenate([after, np.zeros(W)]), np.empty(N)
    windows = np.lib.stride_tricks.sliding_window_view(padded, W)
    for first in range(0, N, AT_ONCE):
        k = np.arange(first, min(first + AT_ONCE, N))
        inside = k[:, None] + np.arange(W) < N
        error = np.where(inside, windows[k] - apart[k] @ decay.T, 0.0)
        cost[k] = sums[0][k] + (error**2).sum(axis=1) + sums[1][N] - sums[1][np.minimum(k + W, N)]
    return cost
