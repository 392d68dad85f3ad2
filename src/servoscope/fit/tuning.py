"""Tunes the recursion: from healthy regressors to theta, noise model, P_d and R."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import NotEnoughError
from servoscope.estimation.noise_model import (
    AR_ORDER,
    ArmaNoise,
    arma_from_white_noise,
    residual_system,
    sample_autocovariance,
    yule_walker,
)
from servoscope.estimation.pipeline import Pipeline, Regression, Tuning
from servoscope.fit.white_noise import WhiteNoiseFit, fit_white_noise, whittle_cost
from servoscope.models.lti import solve_scaled

# smallest eigenvalue of the scaled R_phi, relative to the largest, that still counts as excited
MIN_EIGENVALUE_RATIO = 1e-14


@dataclass(frozen=True, eq=False)
class TuningFit:
    """Least squares over healthy regressors."""

    tuning: Tuning  # for the recursion
    covariance: FloatArray  # of theta under coloured noise, shape (n, n)
    each: FloatArray  # coefficients recording by recording, shape (m, n), and their covariances (m, n, n)
    each_covariance: FloatArray
    explained: float  # share of eta's variance that the model explains, 0 to 1
    dof: float  # effective number of independent residuals
    # of the instrument: smallest real part of the eigenvalues of E[phi phi']^-1 E[z phi'], 1 where z is phi. The
    # recursion diverges where it is negative.
    strength: float
    rms_eta: float  # root mean square of eta
    # white noises of u and y that fit the residual best; None with two stages, where u does not enter
    noises: WhiteNoiseFit | None


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
    return sandwich_covariance(G, X, size)


def sandwich_covariance(G: FloatArray, X: FloatArray, size: FloatArray) -> FloatArray:
    """Return the robust covariance of least squares, G X G', from columns scaled to `size` (White, 1980).

    G is the inverse of the normal matrix, X the covariance of the sums that it solves for: with noise of a known
    colour, or from the sums of blocks of residuals.
    """
    return np.asarray(G @ X @ G.T / np.outer(size, size))


def sum_covariance(score: FloatArray, lags: int) -> FloatArray:
    """Return the covariance of the sum of correlated rows (N, k), which hardly know each other beyond some lags.

    Newey and West (1987).
    """
    X = score.T @ score
    for lag in range(1, lags + 1):
        G = score[:-lag].T @ score[lag:]
        X += (1.0 - lag / (lags + 1)) * (G + G.T)
    return np.asarray(X)


def prefers_white_noise(runs: Sequence[FloatArray], noises: WhiteNoiseFit, free: ArmaNoise) -> bool:
    """Return whether white noises explain residuals better than an autoregression, by Schwarz' criterion (1978).

    Two white noises have two numbers, an autoregression has one for each lag and its variance.
    """
    price = 0.5 * float(np.log(sum(len(run) for run in runs)))
    return noises.cost + 2.0 * price <= whittle_cost(free, runs) + (len(free.a) + 1.0) * price


def fit_tuning(pipeline: Pipeline, regressions: Sequence[Regression]) -> TuningFit:
    """Tune the recursion on healthy recordings: P_d = (R/N) R_phi^-1, or R_z^-1, so that all directions forget alike.

    There is one regression per recording, each with many more usable samples than coefficients. Raises NotEnoughError
    if a column is not excited, or cannot be told from the others.
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
    if values[0] < MIN_EIGENVALUE_RATIO * values[-1]:
        weakest = names[int(np.argmax(np.abs(vectors[:, 0])))]
        raise NotEnoughError(f"the recordings do not tell {weakest} from the other coefficients: move more")
    theta = solve_scaled(R_phi, z.T @ eta / len(eta))
    residuals = [(g.eta - g.phi @ theta)[g.ok] for g in regressions]
    R = float(sample_autocovariance(residuals, 0)[0])
    model, noises = yule_walker(sample_autocovariance(residuals, AR_ORDER)), None
    if pipeline.stage_one is None:
        noises = fit_white_noise(residual_system(pipeline.bank, theta), residuals, pipeline.stride)
        if prefers_white_noise(residuals, noises, model):
            model = arma_from_white_noise(pipeline.bank, theta, noises.noise, pipeline.stride)
    # with an instrument, its own moments: those with phi are not symmetric
    excitation = z.T @ z / len(eta) / np.outer(scale, scale) if pipeline.bank.has_instrument else own
    P_d = R / pipeline.memory * np.linalg.inv(excitation) / np.outer(scale, scale)
    strength = float(np.linalg.eigvals(np.linalg.solve(own, scaled)).real.min())
    tuning = Tuning(theta, scale, P_d, R, model)
    covariances = np.array([coloured_covariance(g, tuning) for g in regressions])
    joint = Regression(eta, phi, z, np.ones(len(eta), dtype=bool))
    correlation = model.autocovariance(AR_ORDER) / model.gamma[0]
    return TuningFit(
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
