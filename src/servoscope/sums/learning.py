"""Healthy recordings to `Healthy`: coefficients by covariate, noise, scatter at three scales, and the limit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import NotEnoughError
from servoscope.core.verdict import FALSE_ALARMS, evidence_limit
from servoscope.sums.healthy import CHANGE_STD, STRETCH_S, Healthy
from servoscope.sums.records import Equations, Sums
from servoscope.sums.scatter import PRIOR_DOF, block_noise, floor_variance, random_effect
from servoscope.sums.verdict import sums_evidence

CHUNKS = 2, 4, 8  # blocks, over which errors may hang together
MAX_SQUARE = 25.0  # of a standardised score, for the inflation
MIN_UNIT_SHARE = 0.3  # of the typical share of u, which a coefficient near 0 is measured by
SLOPE = 0.3  # by how much a standard deviation of a covariate may move a coefficient, relative
MIN_LEFT_OUT = 3
MIN_NOISE_SHARE = 1e-10  # of the mean square of u: no log knows it better than to five digits


def learn(equations: Equations, sums: Sequence[Sums], false_alarms: float = FALSE_ALARMS) -> Healthy:
    """Learn what healthy recordings look like, given their sums; so large a share of them may be called suspect.

    Raises
    ------
    NotEnoughError
        If there is no recording with as many blocks as coefficients, or the motion excites a coefficient not at all.
    """
    if not any(len(recording.c) >= len(equations.names) for recording in sums):
        raise NotEnoughError("sums: no recording has as many blocks as there are coefficients, take longer ones")
    energy = np.sum([recording.A.sum(axis=0) for recording in sums], axis=0).diagonal()
    if not energy.all():
        name = equations.names[int(energy.argmin())]
        raise NotEnoughError(
            f"sums: the motion does not excite {name} below the cutoff, raise it or leave the term out"
        )
    healthy = _fitted(equations, sums)
    scores = []
    if len(sums) >= MIN_LEFT_OUT:
        for i, recording in enumerate(sums):
            others = _fitted(equations, [*sums[:i], *sums[i + 1 :]], healthy.unit)
            scores.append(sums_evidence(others, recording).nats)
    return replace(healthy, left_out=tuple(scores), limit=evidence_limit(scores, false_alarms))


def _fitted(equations: Equations, sums: Sequence[Sums], unit: FloatArray | None = None) -> Healthy:
    A, c = (np.sum([part.sum(axis=0) for part in parts], axis=0) for parts in zip(*(s[:2] for s in sums), strict=True))
    ridge = 1e-9 * np.diag(np.diag(A)) + np.finfo(np.float64).tiny * np.eye(len(c))
    theta = np.linalg.solve(A + ridge, c)
    unit = _unit(theta, sums) if unit is None else unit
    own = [np.linalg.solve(s.A.sum(axis=0) + ridge / len(sums), s.c.sum(axis=0)) for s in sums]
    scores = np.concatenate([s.c - s.A @ fit for s, fit in zip(sums, own, strict=True)])
    noise = block_noise(np.concatenate([s.A for s in sums]), scores, len(sums))
    kappa = max(noise, MIN_NOISE_SHARE * float(theta @ A @ theta) / sum(int(s.n.sum()) for s in sums))
    p, m = len(theta), len(sums[0].x)
    left = np.concatenate([s.unexplained for s in sums])
    unexplained = float(left.sum() / max(np.count_nonzero(left), 1)) + np.finfo(np.float64).tiny
    floor = np.diag(floor_variance(unit))
    theta, none = theta[:, None] * np.eye(1, m), np.zeros((m, m))
    healthy = Healthy(equations, theta, unit, kappa, floor, floor, 1.0, 1.0, unexplained, none)
    healthy = replace(healthy, inflation=_inflation(healthy, sums, own))
    healthy = _with_recordings(replace(healthy, within=_within(healthy, sums, own)), sums)
    free = np.isin(np.arange(p), equations.free)
    return replace(healthy, within=healthy.within + np.diag(free * (CHANGE_STD * unit) ** 2))


def _unit(theta: FloatArray, sums: Sequence[Sums]) -> FloatArray:
    """Return the size (p,) of each coefficient, or a share of what moves u as usual columns do."""
    rms = np.sqrt(np.sum([np.diagonal(s.A.sum(axis=0)) for s in sums], axis=0)).clip(1e-300)
    typical = np.sqrt(max(float(np.mean((theta * rms) ** 2)), 1e-300)) / rms
    return np.asarray(np.maximum(np.abs(theta), MIN_UNIT_SHARE * typical))


def _chunks(M: FloatArray, w: FloatArray, length: int) -> tuple[FloatArray, FloatArray]:
    """Return sums over so many blocks each; what is left over at the end is left out."""
    count = len(w) // length
    cut = slice(count * length)
    return (
        M[cut].reshape(count, length, *M.shape[1:]).sum(axis=1),
        w[cut].reshape(count, length, -1).sum(axis=1),
    )


def _inflation(healthy: Healthy, sums: Sequence[Sums], own: Sequence[FloatArray]) -> float:
    """Return the largest variance of the scores of a few neighbouring blocks, relative to independent ones."""
    blocks = [healthy.information(s, fit) for s, fit in zip(sums, own, strict=True)]
    p, ratios = len(own[0]), [1.0]
    for length in CHUNKS:
        parts = [_chunks(M, w, length) for M, w in blocks if len(w) >= 4 * length]
        if not parts:
            continue
        M, w = (np.concatenate(part) for part in zip(*parts, strict=True))
        lost = 1.0 - length / float(np.mean([len(w) for _, w in blocks]))  # each is about a fit of its own
        ridge = 1e-9 * np.diag(np.diag(M.mean(axis=0))) + np.finfo(np.float64).tiny * np.eye(p)
        squares = np.einsum("ki,ki->k", w, np.linalg.solve(M + ridge, w[..., None])[..., 0])
        ratios.append(float(np.mean(np.minimum(squares / p / lost, MAX_SQUARE))))
    return max(ratios)


def _within(healthy: Healthy, sums: Sequence[Sums], own: Sequence[FloatArray]) -> FloatArray:
    """Return the covariance of coefficients between stretches of one recording."""
    parts = []
    for s, fit in zip(sums, own, strict=True):
        M, w = healthy.information(s, fit)
        parts.append(_chunks(M, w, max(min(int(STRETCH_S / s.block_s), len(w) // 2), 1)))
    M, w = (np.concatenate(part) for part in zip(*parts, strict=True))
    return random_effect(M, w, floor_variance(healthy.unit), lost=len(sums))


def _with_recordings(healthy: Healthy, sums: Sequence[Sums]) -> Healthy:
    """Return coefficients by covariate, by generalised least squares, and their scatter between recordings, in turn."""
    X = np.array([s.x for s in sums])
    (n, m), p = X.shape, len(healthy.unit)
    slopes = np.r_[1e3, np.full(m - 1, SLOPE)]
    prior = np.kron(np.diag(healthy.unit**-2.0), np.diag(slopes**-2.0))
    base, S, I = healthy.theta[:, 0], healthy.between, np.eye(p)
    known = []
    for s in sums:
        M, w = (part.sum(axis=0) for part in healthy.information(s, base))
        M = M + 1e-12 * np.diag(np.diag(M)) + 1e-9 * np.diag(healthy.unit**-2.0)
        Q = np.linalg.solve(I + M @ healthy.within, np.column_stack([M, w]))  # (M^-1 + within)^-1 [I, estimate]
        known.append((0.5 * (Q[:, :-1] + Q[:, :-1].T), Q[:, -1]))
    M, w = (np.array(part) for part in zip(*known, strict=True))
    for _ in range(3):
        R = np.linalg.solve(I + M @ S, np.concatenate([M, w[..., None]], axis=-1))
        N = prior + sum(np.kron(r[:, :-1], np.outer(x, x)) for r, x in zip(R, X, strict=True))
        T = np.linalg.solve(N, sum(np.kron(r[:, -1], x) for r, x in zip(R, X, strict=True))).reshape(p, m)
        left = w - np.einsum("nij,nj->ni", M, X @ T.T)
        floor = floor_variance(healthy.unit)
        S = random_effect(M, left, floor, lost=min(m, n - 1)) if n > 1 else healthy.within
    moments = X.T @ X + np.diag(np.r_[0.0, np.full(m - 1, 0.1)]) + 1e-9 * np.eye(m)
    return replace(
        healthy,
        theta=np.column_stack([base + T[:, 0], T[:, 1:]]),
        between=S,
        degrees=float(max(n - m, 0)) + PRIOR_DOF,
        moments=np.linalg.inv(moments),
    )
