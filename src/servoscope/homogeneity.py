"""Whether healthy recordings show one and the same plant, and what their scatter adds to the covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servoscope.detection import statistic
from servoscope.plants import FloatArray

BY_CHANCE = 1e-3  # probability with which recordings of one plant may be called different
SCATTER_BY_CHANCE = 0.01  # probability of such scatter by noise alone, below which few recordings are believed
ENOUGH = 4  # recordings whose scatter is believed in any case


@dataclass(frozen=True)
class Odd:
    """A recording that differs from the others.

    Parameters
    ----------
    recording
        Its number.
    statistic, limit
        T^2 of its distance to the mean of the others, and what chance reaches in one of a thousand baselines.
    coefficient, deviations
        Number of the coefficient that differs most, and by how many standard deviations.
    """

    recording: int
    statistic: float
    limit: float
    coefficient: int
    deviations: float


def odd_ones(apart: FloatArray, covariances: FloatArray) -> list[Odd]:
    """Return the recordings that differ from the others, the most different first.

    Each is compared with the mean of the others, weighted by what each of them knows: T^2 is then chi-square with n
    degrees of freedom. The most different one is put aside and the rest compared again, or it would speak for them.

    Parameters
    ----------
    apart
        Coefficients recording by recording, less what their references make of them, shape (m, n).
    covariances
        Of their noise, shape (m, n, n).
    """
    from scipy import special

    m, n = apart.shape
    limit = float(special.chdtri(n, BY_CHANCE / m))
    x, C, W = _scaled(apart, covariances)
    left, found = list(range(m)), []
    while len(left) > 1:
        compared = [_compare(k, [j for j in left if j != k], x, C, W, limit) for k in left]
        worst = max(compared, key=lambda odd: odd.statistic)
        if worst.statistic <= limit:
            break
        found.append(worst)
        left.remove(worst.recording)
    return found


def _scaled(apart: FloatArray, covariances: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return coefficients and covariances in standard deviations, and the inverses of the latter."""
    size = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2).mean(axis=0))
    C = covariances / np.outer(size, size)
    return apart / size, C, np.asarray(np.linalg.inv(C), dtype=np.float64)


def _compare(k: int, others: list[int], x: FloatArray, C: FloatArray, W: FloatArray, limit: float) -> Odd:
    known = np.linalg.inv(W[others].sum(axis=0))
    mean = known @ np.einsum("jab,jb->a", W[others], x[others])
    covariance = C[k] + known
    T2 = float(statistic(x[k][None], mean[None], covariance[None])[0])
    deviations = (x[k] - mean) / np.sqrt(np.diag(covariance))
    most = int(np.argmax(np.abs(deviations)))
    return Odd(k, T2, limit, most, float(deviations[most]))


def told(odd: Sequence[Odd], recordings: Sequence[str], coefficients: Sequence[str]) -> list[str]:
    """Say in one sentence, or none, which recordings differ and what to do about it."""
    if not odd:
        return []
    first, m = odd[0], len(recordings)
    by = f"T² = {first.statistic:.3g}, limit {first.limit:.3g}"
    most = f"most in {coefficients[first.coefficient]}, by {abs(first.deviations):.2g} standard deviations"
    name, them = recordings[first.recording], "it as an operating point of its own"
    if m == 2:
        who, them = f"{recordings[0]} and {recordings[1]} differ ({by}), {most}", "them as two operating points"
    elif len(odd) == 1:
        who = f"{name} differs from the other healthy recordings ({by}), {most}"
    else:
        who = f"{len(odd)} of {m} healthy recordings differ from the others, first {name} ({by}), {most}"
        them = "them as operating points of their own"
    return [f"{who}: another load or temperature? learn {them}; until then their scatter hides small changes"]


def scatter(apart: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return the covariance between recordings beyond their noise; it is diagonal, few recordings give no more.

    A further recording scatters like Student's t around the mean of m, with the variance (m - 1)/(m - 3); fewer than
    four recordings get the factor of four. A variance of two or three values is mostly chance, opens directions that
    noise leaves narrow, and would let two recordings of one plant promise less than one of them. It counts only where
    noise does not explain it: Cochran's (1954) Q, the weighted squares of the distances to the weighted mean, is
    chi-square with (m - 1) n degrees of freedom then. Four and more always count: real machines scatter.

    The arguments are those of `odd_ones`.
    """
    from scipy import special

    m, n = apart.shape
    x, C, W = _scaled(apart, covariances)
    mean = np.linalg.solve(W.sum(axis=0), np.einsum("jab,jb->a", W, x))
    Q = float(statistic(x, np.broadcast_to(mean, x.shape), C).sum())
    if m < 2 or (m < ENOUGH and special.chdtrc((m - 1) * n, Q) > SCATTER_BY_CHANCE):
        return np.zeros((n, n))
    own = np.mean([np.diag(c) for c in covariances], axis=0)
    beyond = np.maximum(apart.var(axis=0, ddof=1) - own, 0.0)
    students = (m - 1.0) / (m - 3.0) if m >= ENOUGH else 3.0
    return np.diag(beyond * students * (1.0 + 1.0 / m))
