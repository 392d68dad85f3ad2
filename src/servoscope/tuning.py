"""Healthy regressors -> theta, noise model, P_d and R: the numbers that a baseline gives to the recursion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servoscope.errors import NotEnoughError
from servoscope.pipeline import Regression, Tuning
from servoscope.plants import FloatArray
from servoscope.signatures import solve_scaled

AR_ORDER = 10
WEAKEST = 1e-14  # smallest eigenvalue of the scaled R_phi, relative to the largest, that still counts as excited


@dataclass(frozen=True, eq=False)
class Fit:
    """Least squares over healthy regressors.

    Parameters
    ----------
    tuning
        For the recursion.
    covariance
        Of theta under coloured noise, shape (n, n).
    each
        Coefficients recording by recording, shape (m, n), and their covariances (m, n, n).
    explained
        Share of eta's variance that the model explains, 0 to 1.
    dof
        Effective number of independent residuals.
    strength
        Of the instrument: smallest real part of the eigenvalues of E[phi phi']^-1 E[z phi'], 1 where z is phi. The
        recursion diverges where it is negative (THEORY section 5).
    rms_eta
        Root mean square of eta.
    """

    tuning: Tuning
    covariance: FloatArray
    each: FloatArray
    each_covariance: FloatArray
    explained: float
    dof: float
    strength: float
    rms_eta: float


def autocovariance(runs: Sequence[FloatArray], lags: int) -> FloatArray:
    """Return the autocovariance of a zero-mean signal at lags 0 ... lags, over several runs, shape (lags + 1,)."""
    total = sum(len(run) for run in runs)
    products = [sum(float(run[lag:] @ run[: len(run) - lag]) for run in runs) for lag in range(lags + 1)]
    return np.array(products) / total


def autoregression(runs: Sequence[FloatArray], order: int = AR_ORDER) -> tuple[FloatArray, FloatArray]:
    """Fit v(k) = sum a_j v(k-j) + w(k) by Yule and Walker; return a (p,) and the autocovariance (p,).

    A small white floor keeps strongly oversampled noise solvable.
    """
    from scipy.linalg import solve_toeplitz

    gamma = autocovariance(runs, order)
    row = gamma[:order].copy()
    row[0] *= 1.0 + 1e-9
    return np.asarray(solve_toeplitz(row, gamma[1:])), gamma[:order]


def least_squares(g: Regression) -> FloatArray:
    """Return (sum z phi')^-1 sum z eta over the usable samples, shape (n,)."""
    return solve_scaled(g.z[g.ok].T @ g.phi[g.ok], g.z[g.ok].T @ g.eta[g.ok])


def coloured_covariance(g: Regression, tuning: Tuning) -> FloatArray:
    """Return the covariance of `least_squares` under autoregressive noise, shape (n, n).

    sum z v has the covariance of z passed through the noise's shaping filter, summed: the spectrum of z decides how
    much of the noise's spectrum reaches theta.
    """
    from scipy.signal import lfilter

    phi, z = g.phi[g.ok], g.z[g.ok]
    size = np.sqrt((z**2).mean(axis=0))
    shaped = lfilter([1.0], np.concatenate([[1.0], -tuning.noise_a]), z / size, axis=0)
    X = tuning.innovation * shaped.T @ shaped
    G = np.linalg.inv((z / size).T @ (phi / size))
    return np.asarray(G @ X @ G.T / np.outer(size, size))


def fit(regressions: Sequence[Regression], memory: float, names: Sequence[str]) -> Fit:
    """Tune the recursion on healthy recordings: P_d = (R/N) R_phi^-1, so that all directions forget alike.

    Parameters
    ----------
    regressions
        One per recording.
    memory
        N in samples.
    names
        Of the coefficients, for error messages.

    Raises
    ------
    NotEnoughError
        If too few samples are usable or a column is not excited at all.
    """
    n = len(names)
    usable = sum(int(g.ok.sum()) for g in regressions)
    if usable < 20 * n:
        raise NotEnoughError(
            f"only {usable} usable samples when filters have settled and rest is left out: record longer, or lower "
            "rest_speed"
        )
    phi = np.vstack([g.phi[g.ok] for g in regressions])
    z = np.vstack([g.z[g.ok] for g in regressions])
    eta = np.concatenate([g.eta[g.ok] for g in regressions])
    scale = np.sqrt((phi**2).mean(axis=0))
    for name, size in zip(names, scale, strict=True):
        if not size > 0.0:
            raise NotEnoughError(f"nothing excites {name}: its column is zero throughout the healthy recordings")
    R_phi = z.T @ phi / len(eta)
    scaled = R_phi / np.outer(scale, scale)
    own = phi.T @ phi / len(eta) / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(own)
    if values[0] < WEAKEST * values[-1]:
        weakest = names[int(np.argmax(np.abs(vectors[:, 0])))]
        raise NotEnoughError(f"the healthy recordings do not tell {weakest} from the other coefficients: move more")
    theta = solve_scaled(R_phi, z.T @ eta / len(eta))
    residuals = [(g.eta - g.phi @ theta)[g.ok] for g in regressions]
    a, gamma = autoregression(residuals)
    R = float(gamma[0])
    P_d = R / memory * np.linalg.inv(scaled) / np.outer(scale, scale)
    strength = float(np.linalg.eigvals(np.linalg.solve(own, scaled)).real.min())
    tuning = Tuning(theta, scale, P_d, R, a, gamma)
    covariances = np.array([coloured_covariance(g, tuning) for g in regressions])
    joint = Regression(eta, phi, z, np.ones(len(eta), dtype=bool))
    correlation = gamma / gamma[0]
    return Fit(
        tuning=tuning,
        covariance=coloured_covariance(joint, tuning),
        each=np.array([least_squares(g) for g in regressions]),
        each_covariance=covariances,
        explained=1.0 - R / float(eta.var()),
        dof=len(eta) / float(1.0 + 2.0 * (correlation[1:] ** 2).sum()),
        strength=strength,
        rms_eta=float(np.sqrt((eta**2).mean())),
    )
