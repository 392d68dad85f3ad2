"""Whether healthy recordings show one and the same plant, and what their scatter adds to the covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.messages import Message, message
from servoscope.detection.statistic import t2_statistic

DIFFERENCE_BY_CHANCE = 1e-3  # probability with which recordings of one plant may be called different
SCATTER_BY_CHANCE = 0.01  # probability of such scatter by noise alone, below which few recordings are believed
WIDENING_FACTOR = 1.25  # factor by which the scatter's variance is raised at a time
MAX_WIDENING = 1e3  # and at most in all; what this does not help is left
MIN_RECORDINGS = 4  # recordings whose scatter is believed in any case


@dataclass(frozen=True)
class RecordingOutlier:
    """A recording that differs from the others."""

    recording: int
    # statistic, limit: T^2 of its distance to the mean of the others, and what chance reaches in one of a thousand
    # baselines
    statistic: float
    limit: float
    # coefficient, deviations: number of the coefficient that differs most, and by how many standard deviations
    coefficient: int
    deviations: float


def find_outliers(apart: FloatArray, covariances: FloatArray) -> list[RecordingOutlier]:
    """Return the recordings that differ from the others, the most different first.

    Each is compared with the mean of the others, weighted by what each of them knows: T^2 is then chi-square with n
    degrees of freedom. The most different one is put aside and the rest compared again, or it would speak for them.

    The coefficients (m, n) are those of each recording less what its reference explains, with covariances (m, n, n).
    """
    from scipy import special

    m, n = apart.shape
    limit = float(special.chdtri(n, DIFFERENCE_BY_CHANCE / m))
    x, C, W = _standardise(apart, covariances)
    remaining, outliers_found = list(range(m)), []
    while len(remaining) > 1:
        compared = [_compare(k, [j for j in remaining if j != k], x, C, W, limit) for k in remaining]
        worst = max(compared, key=lambda outliers: outliers.statistic)
        if worst.statistic <= limit:
            break
        outliers_found.append(worst)
        remaining.remove(worst.recording)
    return outliers_found


def _standardise(apart: FloatArray, covariances: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return coefficients and covariances in standard deviations, and the inverses of the latter."""
    size = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2).mean(axis=0))
    C = covariances / np.outer(size, size)
    return apart / size, C, np.asarray(np.linalg.inv(C), dtype=np.float64)


def _compare(k: int, others: list[int], x: FloatArray, C: FloatArray, W: FloatArray, limit: float) -> RecordingOutlier:
    known = np.linalg.inv(W[others].sum(axis=0))
    mean = known @ np.einsum("jab,jb->a", W[others], x[others])
    covariance = C[k] + known
    T2 = float(t2_statistic(x[k][None], mean[None], covariance[None])[0])
    deviations = (x[k] - mean) / np.sqrt(np.diag(covariance))
    most = int(np.argmax(np.abs(deviations)))
    return RecordingOutlier(k, T2, limit, most, float(deviations[most]))


def describe_outliers(
    outliers: Sequence[RecordingOutlier], recordings: Sequence[str], coefficients: Sequence[str]
) -> list[Message]:
    """Return one message, or none: which recordings differ, and what to do about it."""
    if not outliers:
        return []
    first, name = outliers[0], recordings[outliers[0].recording]
    t2 = {"statistic": first.statistic, "limit": first.limit}
    if len(recordings) == 2:
        outlier = message("learning.outlier_pair", first=recordings[0], second=recordings[1], **t2)
        remedy = message("learning.learn_two_points")
    elif len(outliers) == 1:
        outlier = message("learning.outlier_one", recording=name, **t2)
        remedy = message("learning.learn_one_point")
    else:
        counts = {"count": len(outliers), "recordings": len(recordings)}
        outlier = message("learning.outlier_several", recording=name, **counts, **t2)
        remedy = message("learning.learn_several_points")
    most = {"coefficient": coefficients[first.coefficient], "deviations": abs(first.deviations)}
    return [message("learning.outlier", outlier=outlier, remedy=remedy, **most)]


def scatter(apart: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return the covariance between recordings beyond their noise; it is diagonal, few recordings give no more.

    A further recording scatters like Student's t around the mean of m, with the variance (m - 1)/(m - 3); fewer than
    four recordings get the factor of four. A variance of two or three values is mostly chance, opens directions that
    noise leaves narrow, and would let two recordings of one plant promise less than one of them. It counts only where
    noise does not explain it (`scatter_probability`). Four and more always count: real machines scatter.

    The arguments are those of `find_outliers`.
    """
    m, n = apart.shape
    if m < 2 or (m < MIN_RECORDINGS and scatter_probability(apart, covariances) > SCATTER_BY_CHANCE):
        return np.zeros((n, n))
    own = np.mean([np.diag(c) for c in covariances], axis=0)
    beyond = np.maximum(apart.var(axis=0, ddof=1) - own, 0.0)
    return np.diag(beyond * prediction_factor(m))


def scatter_probability(apart: FloatArray, covariances: FloatArray) -> float:
    """Return the probability with which noise alone makes recordings differ by as much as these do; 1 of one.

    Cochran's (1954) Q, the weighted squares of the distances to the weighted mean, is chi-square with (m - 1) n degrees
    of freedom then. The arguments are those of `find_outliers`.
    """
    from scipy import special

    m, n = apart.shape
    x, C, W = _standardise(apart, covariances)
    mean = np.linalg.solve(W.sum(axis=0), np.einsum("jab,jb->a", W, x))
    Q = float(t2_statistic(x, np.broadcast_to(mean, x.shape), C).sum())
    return float(special.chdtrc((m - 1) * n, Q)) if m > 1 else 1.0


def between_covariance(apart: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return the covariance (n, n) between m recordings less that of their noise; 0 of one recording.

    It has no bias, and so it may be negative in some directions: it is there to be averaged over machines. The
    arguments are those of `find_outliers`.
    """
    if len(apart) < 2:
        return np.zeros_like(covariances[0])
    return np.asarray(np.cov(apart.T, ddof=1).reshape(covariances[0].shape) - covariances.mean(axis=0))


def cover_transients(between: FloatArray, shares: Sequence[FloatArray]) -> FloatArray:
    """Return a scatter (n, n) that also covers what it does while the recursion has not yet forgotten its start.

    With Psi of the start left, an actuator that is off by d moves the estimate by (I - Psi) d, and what is known badly
    then moves by far more than d. `shares`: Psi of each recording, shape (K, n, n).
    """
    most = np.diag(between).copy()
    for Psi in shares if between.any() else ():
        taken = np.eye(len(between)) - Psi
        most = np.maximum(most, np.einsum("kij,jl,kil->ki", taken, between, taken).max(axis=0, initial=0.0))
    return between + np.diag(most - np.diag(between))


def scatter_of_others(apart: FloatArray, covariances: FloatArray, shares: Sequence[FloatArray]) -> list[FloatArray]:
    """Return for each recording the scatter (n, n) that the others tell, as `scatter` and `cover_transients` do."""
    others = [[j for j in range(len(apart)) if j != i] for i in range(len(apart))]
    return [cover_transients(scatter(apart[j], covariances[j]), [shares[k] for k in j]) for j in others]


def prediction_factor(m: int) -> float:
    """Return by how much the deviation of a further recording from the mean of m exceeds their own variance."""
    return ((m - 1.0) / (m - 3.0) if m >= MIN_RECORDINGS else 3.0) * (1.0 + 1.0 / m)


def leave_one_out(
    paths: Sequence[tuple[FloatArray, FloatArray]],
    apart: FloatArray,
    spreads: Sequence[FloatArray],
    common: FloatArray,
    limit: float,
) -> tuple[float, FloatArray]:
    """Judge each of m >= 4 healthy recordings by what the others teach; return the scatter's factor, and the ratios.

    The factor, at least 1, is by how much the scatter between recordings has to be larger so that none of them would
    have been called faulty; the ratios, shape (m,), are their largest T^2 over its limit before that. More recordings
    can so only raise the covariance that their own scatter has contradicted. Where the others do not scatter in the
    direction in which one differs, no factor helps, and the scatter of all of them, that one included, stays as it is.

    `paths`: theta_hat less what is expected of a healthy loop, shape (K, n), and its covariance (K, n, n), of each
    recording; `apart`: as in `find_outliers`; `spreads`: covariance of the scatter (n, n) that the others of each tell;
    `common`: what theta is known to without scatter, (n, n).
    """
    m = len(apart)
    if m < MIN_RECORDINGS:
        return 1.0, np.zeros(0)
    shifts = [np.delete(apart, i, axis=0).mean(axis=0) - apart.mean(axis=0) for i in range(m)]
    ratios = np.zeros(m)
    factors = np.ones(m)
    for i, (d, S) in enumerate(paths):
        if not len(d):
            continue

        def worst(
            factor: float, d: FloatArray = d - shifts[i], S: FloatArray = S + common, B: FloatArray = spreads[i]
        ) -> float:
            return float(t2_statistic(d, np.zeros_like(d), S + factor * B).max()) / limit

        ratios[i] = worst(1.0)
        while worst(factors[i]) > 1.0 and factors[i] < MAX_WIDENING:
            factors[i] *= WIDENING_FACTOR
        if worst(factors[i]) > 1.0:  # the others agree where this one differs: widened, their scatter hides all faults
            factors[i] = 1.0
    return float(factors.max()), ratios
