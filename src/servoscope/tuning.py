"""Healthy regressors -> theta, noise model, P_d and R: the numbers that a baseline gives to the recursion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servoscope.errors import NotEnoughError
from servoscope.noise import (
    AR_ORDER,
    Coloured,
    WhiteNoises,
    autocovariance,
    coloured,
    misfit,
    residual_of,
    white_noises,
    yule_walker,
)
from servoscope.pipeline import Pipeline, Regression, Tuning
from servoscope.plants import FloatArray
from servoscope.signatures import solve_scaled

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
    noises
        White noises of u and y that fit the residual best; None with two stages, where u does not enter.
    """

    tuning: Tuning
    covariance: FloatArray
    each: FloatArray
    each_covariance: FloatArray
    explained: float
    dof: float
    strength: float
    rms_eta: float
    noises: WhiteNoises | None


def least_squares(g: Regression) -> FloatArray:
    """Return (sum z phi')^-1 sum z eta over the usable samples, shape (n,)."""
    return solve_scaled(g.z[g.ok].T @ g.phi[g.ok], g.z[g.ok].T @ g.eta[g.ok])


def coloured_covariance(g: Regression, tuning: Tuning) -> FloatArray:
    """Return the covariance of `least_squares` under autoregressive noise, shape (n, n).

    sum z v has the covariance of z passed through the noise's shaping filter, summed: the spectrum of z decides how
    much of the noise's spectrum reaches theta.
    """
    phi, z = g.phi[g.ok], g.z[g.ok]
    size = np.sqrt((z**2).mean(axis=0))
    shaped = tuning.noise.shape(z / size)
    X = shaped.T @ shaped
    G = np.linalg.inv((z / size).T @ (phi / size))
    return np.asarray(G @ X @ G.T / np.outer(size, size))


def white_enough(runs: Sequence[FloatArray], noises: WhiteNoises, free: Coloured) -> bool:
    """Return whether white noises explain residuals better than an autoregression, by Schwarz' criterion (1978).

    Two white noises have two numbers, an autoregression has one for each lag and its variance.
    """
    price = 0.5 * float(np.log(sum(len(run) for run in runs)))
    return noises.cost + 2.0 * price <= misfit(free, runs) + (len(free.a) + 1.0) * price


def fit(pipeline: Pipeline, regressions: Sequence[Regression]) -> Fit:
    """Tune the recursion on healthy recordings: P_d = (R/N) R_phi^-1, so that all directions forget alike.

    Parameters
    ----------
    pipeline
        Gives the memory and, for error messages, the names of the coefficients.
    regressions
        One per recording, each with many more usable samples than coefficients.

    Raises
    ------
    NotEnoughError
        If a column is not excited at all, or not told from the others.
    """
    names = pipeline.bank.names
    phi = np.vstack([g.phi[g.ok] for g in regressions])
    z = np.vstack([g.z[g.ok] for g in regressions])
    eta = np.concatenate([g.eta[g.ok] for g in regressions])
    scale = np.sqrt((phi**2).mean(axis=0))
    for name, size in zip(names, scale, strict=True):
        if not size > 0.0:
            raise NotEnoughError(f"nothing excites {name}: its column is zero throughout")
    R_phi = z.T @ phi / len(eta)
    scaled = R_phi / np.outer(scale, scale)
    own = phi.T @ phi / len(eta) / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(own)
    if values[0] < WEAKEST * values[-1]:
        weakest = names[int(np.argmax(np.abs(vectors[:, 0])))]
        raise NotEnoughError(f"the recordings do not tell {weakest} from the other coefficients: move more")
    theta = solve_scaled(R_phi, z.T @ eta / len(eta))
    residuals = [(g.eta - g.phi @ theta)[g.ok] for g in regressions]
    R = float(autocovariance(residuals, 0)[0])
    model, noises = yule_walker(autocovariance(residuals, AR_ORDER)), None
    if pipeline.stage_one is None:
        noises = white_noises(residual_of(pipeline.bank, theta), residuals, pipeline.stride)
        if white_enough(residuals, noises, model):
            model = coloured(pipeline.bank, theta, noises.noise, pipeline.stride)
    P_d = R / pipeline.memory * np.linalg.inv(scaled) / np.outer(scale, scale)
    strength = float(np.linalg.eigvals(np.linalg.solve(own, scaled)).real.min())
    tuning = Tuning(theta, scale, P_d, R, model)
    covariances = np.array([coloured_covariance(g, tuning) for g in regressions])
    joint = Regression(eta, phi, z, np.ones(len(eta), dtype=bool))
    correlation = model.autocovariance(AR_ORDER) / model.gamma[0]
    return Fit(
        tuning=tuning,
        covariance=coloured_covariance(joint, tuning),
        each=np.array([least_squares(g) for g in regressions]),
        each_covariance=covariances,
        explained=1.0 - R / float(eta.var()),
        dof=len(eta) / float(1.0 + 2.0 * (correlation[1:] ** 2).sum()),
        strength=strength,
        rms_eta=float(np.sqrt((eta**2).mean())),
        noises=noises,
    )
