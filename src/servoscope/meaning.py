"""What the estimates of an examination mean: their biases taken out, and the trace that is told of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servoscope import ifrf, spool
from servoscope.correction import explain
from servoscope.detection import Onset
from servoscope.diagnosis import UNKNOWN, Candidate, Trace
from servoscope.examination import Examination
from servoscope.ifrf import Response
from servoscope.inverse import nominal_theta
from servoscope.plants import FloatArray, Plant

AT_ONCE = 4096  # evaluations whose responses are computed together


@dataclass(frozen=True, eq=False)
class Meaning:
    """How estimates become those of the actuator itself.

    After a change the past that theta_hat has not forgotten yet counts as a bias too. The covariance becomes that of
    the estimate alone: the noise in the coefficients under the actuator that was found, and what is left of the start.
    The actuator was found from one evaluation: its noise is in the bias, and so in the evaluations after the change.

    Parameters
    ----------
    gain
        How an error of theta_hat at evaluation `at` reaches the coefficients that are corrected there, shape (n, n).
    at
        Evaluation from which the actuator was found.
    ill
        The actuator that was found; None where nothing changed.
    since
        Sample of the change.
    """

    gain: FloatArray
    at: int
    ill: Plant | None = None
    since: int = 0


def meaning(x: Examination, candidates: Sequence[Candidate], since: Onset | None, at: int) -> Meaning | None:
    """Find out what estimates mean, as far as the loop can be simulated; None where it cannot.

    Parameters
    ----------
    candidates, since
        What explains the change, and since when; none where there was no change.
    at
        Evaluation that is explained.
    """
    e, baseline = x.estimates, x.baseline
    if x.noise is None or not x.evaluations or not e.updates[at] > 0 or baseline.loop.monitor.structure != "svf":
        return None
    if since is None:
        return Meaning(np.eye(x.pipeline.bank.n), at)
    likely = next((c for c in candidates if c.name != UNKNOWN), None)
    guess = {fault.parameter: fault.ratio for fault in likely.faults} if likely else {}
    first, start = x.recalled(at), np.array(baseline.model_theta)
    recalled = x.expectation(first, int(e.index[at]) + 1)
    ill_since = max(since.sample - first, 0)
    found = explain(recalled, baseline.plant, start, e.theta[at], x.covariance(at), ill_since, guess)
    return Meaning(found.gain, at, found.plant, since.sample)


def trace(x: Examination, meant: Meaning | None, at: slice | None = None) -> Trace:
    """Return the trace of an examination, all of it or some evaluations: estimates without bias, and responses."""
    at = slice(0, x.evaluations) if at is None else at
    e, baseline, K = x.estimates, x.baseline, at.stop - at.start
    n, f = x.pipeline.bank.n, np.asarray(baseline.loop.monitor.frequencies, dtype=np.float64)
    F, shape = len(f), spool.empty
    theta, covariance, expected = shape((K, n)), shape((K, n, n)), shape((K, n))
    seen, healthy = (Response(f, shape((K, F), np.complex128), shape((K, F, 2, 2))) for _ in range(2))
    ill = _ill(x, meant, at)
    for rows in spool.pieces(0, K, e.S, e.Psi, e.theta, x.expected, at_once=AT_ONCE):
        part = slice(at.start + rows.start, at.start + rows.stop)
        told = _unbiased(x, meant, part, *(None if each is None else each[rows] for each in ill))
        theta[rows], covariance[rows], expected[rows] = told
        of_healthy = np.broadcast_to(baseline.cov(), told[1].shape)
        for whole, found in (
            (seen, ifrf.response(x.pipeline.bank, f, *told[:2])),
            (healthy, ifrf.response(x.pipeline.bank, f, told[2], of_healthy)),
        ):
            whole.H[rows], whole.covariance[rows] = found.H, found.covariance
        spool.release(theta, covariance, expected, seen.H, seen.covariance, healthy.H, healthy.covariance)
    ready, crossed = x.ready[at], e.crossed[at].astype(np.int64)
    passed = np.full(K, np.nan)
    passed[crossed > 0] = x.recording.t[crossed[crossed > 0] - 1]
    return Trace(
        t=x.t(at),
        names=x.pipeline.bank.names,
        theta=theta,
        covariance=covariance,
        expected=expected,
        statistic=np.where(ready, x.statistic[at], 0.0),
        threshold=baseline.limit,
        level=e.level[at],
        crossed=passed,
        ifrf=seen,
        ifrf_expected=healthy,
        ready=ready,
    )


def _ill(x: Examination, meant: Meaning | None, at: slice) -> tuple[FloatArray | None, FloatArray | None]:
    """Return the path of the ill actuator and the covariance under its noise; None where there is no such thing."""
    if meant is None or meant.ill is None or at.start == at.stop:
        return None, None
    spread = x.spread(at, meant.ill) if x.baseline.loudest is not None else None
    return x.path(at, meant.ill, meant.since), spread


def _unbiased(
    x: Examination, meant: Meaning | None, at: slice, path: FloatArray | None, spread: FloatArray | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return theta, its covariance and what a healthy loop would show, without biases as far as they are known."""
    e, C, expected = x.estimates, x.baseline.cov(), x.expected[at]
    if meant is None:
        return e.theta[at], x.covariance(at), expected
    plant, start = x.baseline.plant, np.array(x.baseline.model_theta)
    true = nominal_theta(x.pipeline.loop, plant)
    # the healthy path: what was expected, without what the model leaves unexplained
    bias = shift = expected - (x.tuning.theta - start) - true
    S, late = x.growth * e.S[at], np.zeros(len(e.index[at]), dtype=np.bool_)
    if meant.ill is not None and path is not None:
        late = e.index[at] >= meant.since
        bias = path - np.where(late[:, None], nominal_theta(x.pipeline.loop, meant.ill), true)
        S = S if spread is None else np.where(late[:, None, None], spread, S)
    covariance = S + e.Psi[at] @ C @ np.swapaxes(e.Psi[at], -1, -2)
    if late.any():
        covariance[late] = _with_bias(x, meant, covariance[late], e.updates[at][late])
    return e.theta[at] - bias, covariance, expected - shift


def _with_bias(x: Examination, meant: Meaning, covariance: FloatArray, updates: FloatArray) -> FloatArray:
    """Return the covariance of theta_hat less a bias that comes from one evaluation, shape (K, n, n).

    With e the error of an evaluation, e_0 that of the one, G the gain: e + (G - 1) e_0. Both errors share the noise
    that theta_hat has not forgotten between them, exp(-lag / memory) of it.
    """
    lag = np.abs(updates - x.estimates.updates[meant.at])
    shared = np.exp(-lag / x.pipeline.memory)[:, None, None]
    G, M = meant.gain, meant.gain - np.eye(len(meant.gain))
    found: FloatArray = shared * (G @ covariance @ G.T) + (1.0 - shared) * (covariance + M @ covariance @ M.T)
    return found
