"""Slow, obvious oracles for the compiled chain: textbook matrices, dense sub-steps, loops; nothing is shared."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import linalg, signal

Array = npt.NDArray[np.float64]
Update = Callable[..., tuple[Array, Array, Array]]


def between_samples(w: Array, rate: float, hold: str, steps: int, delay: float = 0.0) -> tuple[Array, Array]:
    """Return a fine clock and w on it: held or in straight lines, late by `delay` [s], w[0] before the start."""
    t = np.arange((len(w) - 1) * steps + 1) / (rate * steps)
    at = np.round((t - delay) * rate * steps).astype(int)
    if hold == "zoh":
        return t, w[np.clip(at // steps, 0, None)]
    return t, np.interp(at / steps, np.arange(len(w)), w)


def continuous(
    numerator: npt.ArrayLike,
    denominator: npt.ArrayLike,
    w: Array,
    rate: float,
    hold: str,
    delay: float = 0.0,
    steps: int = 1,
) -> Array:
    """Pass samples through a continuous transfer function (highest power first), from its steady state at w[0]."""
    t, fine = between_samples(w - w[0], rate, hold, steps, delay)
    num, den = np.atleast_1d(numerator), np.atleast_1d(denominator)
    out = signal.lsim((num, den), fine, t, interp=hold == "foh")[1]
    return np.asarray(np.atleast_1d(out)[::steps] + w[0] * num[-1] / den[-1])


def svf(
    w: Array, power: int, cutoff: float, order: int, rate: float, hold: str, delay: float = 0.0, steps: int = 1
) -> Array:
    """Return ``s^power w`` behind ``(1 + s/lambda)^-order`` at the sample times."""
    lam = 2.0 * math.pi * cutoff
    denominator = np.poly(np.full(order, -lam))
    numerator = lam**order * np.concatenate([[1.0], np.zeros(power)])
    return continuous(numerator, denominator, w, rate, hold, delay, steps)


def tustin(u: Array, y: Array, held: bool = False) -> tuple[Array, Array]:
    """Return eta and phi of eq. (4) for order 3, with u or (u(k) + u(k-1))/2; signals rest before the start."""

    def past(x: Array, lag: int) -> Array:
        return np.concatenate([np.full(lag, x[0]), x[: len(x) - lag]])

    a = (u + past(u, 1)) / 2.0 if held else u
    eta = a + 3.0 * past(a, 1) + 3.0 * past(a, 2) + past(a, 3)
    return eta, np.column_stack([past(y, lag) for lag in range(4)])


def akf(
    theta: Array, P: Array, P_d: Array, R: float, eta: float, phi: Array, z: Array, memory: float, past: list[Any]
) -> tuple[Array, Array, Array]:
    """Take one step of eqs. (7) to (9) and (11); `z`, `memory` and `past`, what an estimator keeps, are not used."""
    K = P @ phi / (R + phi @ P @ phi)
    new = P - P @ np.outer(phi, phi) @ P / (R + phi @ P @ phi) + P_d @ np.outer(phi, phi) @ P_d / (R + phi @ P_d @ phi)
    return theta + K * (eta - phi @ theta), new, K


def iv_akf(
    theta: Array, P: Array, P_d: Array, R: float, eta: float, phi: Array, z: Array, memory: float, past: list[Any]
) -> tuple[Array, Array, Array]:
    """Take one step of the instrumental-variable AKF: the AKF's gain and covariance with z, its residual with phi."""
    _, new, K = akf(theta, P, P_d, R, eta, z, z, memory, past)
    return theta + K * (eta - phi @ theta), new, K


def kf(
    theta: Array, P: Array, P_d: Array, R: float, eta: float, phi: Array, z: Array, memory: float, past: list[Any]
) -> tuple[Array, Array, Array]:
    """Take one step of the Kalman filter of a random walk, in Joseph's form."""
    K = P @ phi / (R + phi @ P @ phi)
    keep = np.eye(len(theta)) - np.outer(K, phi)
    return theta + K * (eta - phi @ theta), keep @ P @ keep.T + R * np.outer(K, K) + P_d / memory, K


def rls(
    theta: Array, P: Array, P_d: Array, R: float, eta: float, phi: Array, z: Array, memory: float, past: list[Any]
) -> tuple[Array, Array, Array]:
    """Take one step of weighted least squares: the information is forgotten, then that of the sample is added."""
    new = np.linalg.inv((1.0 - 1.0 / memory) * np.linalg.inv(P) + np.outer(phi, phi) / R)
    return theta + new @ phi / R * (eta - phi @ theta), new, new @ phi / R


def dfrls(
    theta: Array, P: Array, P_d: Array, R: float, eta: float, phi: Array, z: Array, memory: float, past: list[Any]
) -> tuple[Array, Array, Array]:
    """Take one step of Kulhavy and Karny for unit residual variance, that is for p = P/R, on the information."""
    p = P / R
    s, l = phi @ p @ phi, memory / (memory + len(theta))
    eps = l - (1.0 - l) / s
    K = p @ phi / (1.0 + s)
    return theta + K * (eta - phi @ theta), R * np.linalg.inv(np.linalg.inv(p) + eps * np.outer(phi, phi)), K


def rls_reset(
    theta: Array, P: Array, P_d: Array, R: float, eta: float, phi: Array, z: Array, memory: float, past: list[Any]
) -> tuple[Array, Array, Array]:
    """Take one step of least squares without forgetting, on the information; reset after `memory` steps."""
    past.append(phi)
    new = np.linalg.inv(np.linalg.inv(P) + np.outer(phi, phi) / R)
    K = new @ phi / R
    return theta + K * (eta - phi @ theta), (math.e - 1.0) * P_d if len(past) % round(memory) == 0 else new, K


def nlms(
    theta: Array, P: Array, P_d: Array, R: float, eta: float, phi: Array, z: Array, memory: float, past: list[Any]
) -> tuple[Array, Array, Array]:
    """Take one step of normalised least mean squares."""
    K = phi / (memory + phi @ phi)
    return theta + K * (eta - phi @ theta), P, K


def sliding_window(
    theta: Array, P: Array, P_d: Array, R: float, eta: float, phi: Array, z: Array, memory: float, past: list[Any]
) -> tuple[Array, Array, Array]:
    """Solve the window from its samples; the baseline counts as samples that leave one by one."""
    if not past:
        root = math.sqrt(R) * np.linalg.inv(np.linalg.cholesky(P))
        past.append((root, root @ theta))
    past.append((phi[None, :], np.array([eta])))
    N = round(memory)
    share = math.sqrt(max(0.0, 1.0 - (len(past) - 1) / N))
    rows = [(share * past[0][0], share * past[0][1]), *past[1:][-N:]]
    X, y = np.vstack([row[0] for row in rows]), np.concatenate([row[1] for row in rows])
    G = np.linalg.inv(X.T @ X)
    # RLS of the window's information halved, which stands for the exponential window of half the memory
    K = np.linalg.inv((X.T @ X) / 2.0 + np.outer(phi, phi)) @ phi
    return np.linalg.lstsq(X, y, rcond=None)[0], R * G, K


UPDATES: dict[str, Update] = {
    "akf": akf,
    "dfrls": dfrls,
    "iv-akf": iv_akf,
    "kf": kf,
    "nlms": nlms,
    "rls": rls,
    "rls-reset": rls_reset,
    "sliding-window": sliding_window,
}


class Spread:
    """Joint covariance of [error of the estimate, last p values of v, last q of e], one explicit augmented matrix.

    The noise is v(k) = a' v_past + e(k) + b' e_past, e white.
    """

    def __init__(self, n: int, a: Array, b: Array, variance: float) -> None:
        p, q = len(a), len(b)
        self.n, self.variance = n, variance
        self.weights = np.concatenate([a, b])
        self.A = np.zeros((p + q, p + q))  # [v_past e_past] from one update to the next
        self.A[0] = self.weights
        for i in range(1, p + q):
            if i != p:
                self.A[i, i - 1] = 1.0
        self.B = np.zeros(p + q)  # where e(k) enters
        self.B[0] = 1.0
        if q:
            self.A[p] = 0.0
            self.B[p] = 1.0
        self.stationary = linalg.solve_discrete_lyapunov(self.A, variance * np.outer(self.B, self.B))
        self.joint = np.zeros((n + p + q, n + p + q))
        self.Psi = np.eye(n)
        self.forget()

    def forget(self) -> None:
        """Start with fresh noise, independent of the estimate."""
        n = self.n
        self.joint[:n, n:] = 0.0
        self.joint[n:, :n] = 0.0
        self.joint[n:, n:] = self.stationary

    def update(self, K: Array, phi: Array) -> None:
        """Advance by error(k+1) = (I - K phi') error + K v(k)."""
        n = self.n
        keep = np.eye(n) - np.outer(K, phi)
        F = np.zeros_like(self.joint)
        F[:n, :n], F[:n, n:] = keep, np.outer(K, self.weights)
        F[n:, n:] = self.A
        G = np.concatenate([K, self.B])
        self.joint = F @ self.joint @ F.T + self.variance * np.outer(G, G)
        self.joint[n:, n:] = self.stationary  # as it is already, but for rounding, which would grow
        self.Psi = keep @ self.Psi


@dataclass
class Chain:
    """What `chain` returns, one row per sample: theta, S and Psi (scaled), updates so far, mean square residual."""

    theta: Array
    S: Array
    Psi: Array
    updates: Array
    power: Array


def stretches(r: Array, u: Array, y: Array, restart: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return [begin, end) of the stretches of whole samples that follow each other."""
    whole = np.isfinite(r + u + y)
    edges = [k for k in range(len(r)) if whole[k] and (k == 0 or restart[k] or not whole[k - 1])]
    ends = []
    for begin in edges:
        end = begin + 1
        while end < len(r) and whole[end] and not restart[end]:
            end += 1
        ends.append((begin, end))
    return ends


def usable(
    r: Array,
    u: Array,
    y: Array,
    restart: npt.NDArray[np.bool_],
    wait: int,
    resting: npt.NDArray[np.bool_] | None = None,
) -> npt.NDArray[np.bool_]:
    """Return which samples come `wait` after the start of their stretch and after the last sample at rest in it."""
    ok = np.zeros(len(r), dtype=bool)
    for begin, end in stretches(r, u, y, restart):
        for k in range(begin + wait, end):
            ok[k] = resting is None or not resting[max(k - wait, begin) : k + 1].any()
    return ok


def chain(
    update: Update,
    eta: Array,
    phi: Array,
    z: Array,
    used: list[bool],
    between: list[bool],
    theta: Array,
    P: Array,
    P_d: Array,
    R: float,
    a: Array,
    b: Array,
    variance: float,
    memory: float,
) -> Chain:
    """Follow estimator, covariance and residual power over given regressors; the noise is new where nothing is used."""
    N, n = phi.shape
    spread = Spread(n, a, b, variance)
    updates, power = 0, spread.stationary[0, 0]
    rows: list[tuple[Array, Array, Array, int, float]] = []
    past: list[Any] = []
    for k in range(N):
        if used[k]:
            e = eta[k] - phi[k] @ theta
            theta, P, K = update(theta, P, P_d, R, eta[k], phi[k], z[k], memory, past)
            if np.any(K):
                updates += 1
                power += (e**2 - power) / memory
            spread.update(K, phi[k])
        elif not between[k]:
            spread.forget()
        rows.append((theta, spread.joint[:n, :n].copy(), spread.Psi.copy(), updates, power))
    columns = [np.array(column, dtype=np.float64) for column in zip(*rows, strict=True)]
    return Chain(*columns)


def t_squared(theta: Array, expected: Array, covariance: Array) -> Array:
    """Return (theta - mu)' Cov^-1 (theta - mu) row by row."""
    return np.array([(t - m) @ np.linalg.inv(C) @ (t - m) for t, m, C in zip(theta, expected, covariance, strict=True)])


def change_point(v: Array, changed: Array, ramp: Array, lags: int, ok: npt.NDArray[np.bool_]) -> Array:
    """Return the log-likelihood of a change at every update i: v - size ramp(k - i) changed is noise, size at its best.

    Samples that are not `ok` are zero, and no noise.
    Divided by the long-run variance over the variance of the scores under the best change.
    """
    N = len(v)
    found, left = [], []
    for i in range(N):
        column = changed * np.array([0.0 if k < i else ramp[k - i] if k - i < len(ramp) else 1.0 for k in range(N)])
        size = max(float(np.linalg.lstsq(column[:, None], v, rcond=None)[0][0]), 0.0) if column.any() else 0.0
        left.append(v - size * column)
        found.append(-sum(left[-1] ** 2))
    e, changed = left[int(np.argmax(found))][ok], changed[ok]
    d, N = e * changed - np.mean(e * changed), len(e)
    gamma = [sum(d[lag:] * d[: N - lag]) / N for lag in range(lags + 1)]
    longer = 1.0 + 2.0 * sum((1.0 - lag / (lags + 1.0)) * gamma[lag] / gamma[0] for lag in range(1, lags + 1))
    return np.array(found) / (2.0 * np.mean(e**2) * max(1.0, longer))


def inside(points: Array, polygon: Array) -> npt.NDArray[np.bool_]:
    """Return which points (N, 2) lie within a convex closed polygon (M, 2)."""
    edge = np.diff(polygon, axis=0)
    to_point = points[:, None, :] - polygon[None, :-1, :]
    side = edge[None, :, 0] * to_point[:, :, 1] - edge[None, :, 1] * to_point[:, :, 0]
    return np.asarray(np.all(side >= 0.0, axis=1) | np.all(side <= 0.0, axis=1))


def cusums(
    e: Array, psi: Array, counts: npt.NDArray[np.bool_], changes: Array, limits: Array, every: int, steps: int,
    by_evaluation: bool = False,
) -> tuple[Array, Array]:  # fmt: skip
    """Add up log-likelihood ratios of "shifted by psi' change" against "white"; return level and crossed row by row.

    `e` (steps,) and `psi` (steps, m) are whitened, `counts` says where a sample speaks. `level` is the largest CUSUM
    relative to its limit since the evaluation before, `crossed` the sample (from 1) at which one rose to its limit.
    With `by_evaluation` the CUSUMs step at the last sample of an evaluation, by all that came since the one before.
    """
    g = np.zeros(len(limits))
    now, peak, since, gain = 0.0, 0.0, 0, np.zeros(len(limits))
    rows = []
    for k in range(steps):
        if k % every == 0:
            peak = now
            since = since if now >= 1.0 else 0
        if counts[k]:
            m = changes @ psi[k]
            gain = gain + m * (np.clip(e[k], -4.0, 4.0) - m / 2.0)
        if (k + 1) % every == 0 if by_evaluation else counts[k]:
            g, gain = np.clip(g + gain, 0.0, 2.0 * limits), np.zeros(len(limits))
            now = float((g / limits).max())
            peak = max(peak, now)
            if now >= 1.0 and not since:
                since = k + 1
        if (k + 1) % every == 0:
            rows.append((peak, since))
    level, crossed = np.array(rows, dtype=np.float64).T
    return level, crossed
