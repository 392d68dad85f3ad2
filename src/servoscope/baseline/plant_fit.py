"""Which noise and which plant would say what the healthy recordings say; and where theta goes when it ails."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from servoscope.baseline.expectation import Expectation, residual_system
from servoscope.core import outofcore
from servoscope.core.arrays import FloatArray
from servoscope.estimation.filter_bank import nominal_theta
from servoscope.estimation.noise_model import ArmaNoise, WhiteNoise, sample_autocovariance
from servoscope.estimation.pipeline import Pipeline, Regression
from servoscope.fit import search
from servoscope.fit.search import Experiment
from servoscope.fit.tuning import TuningFit
from servoscope.models.loop import Loop
from servoscope.models.lti import autocovariances, solve_scaled
from servoscope.models.plants import Plant
from servoscope.signals import Recording

COVARIATE_PRIOR_STD = 1.0  # standard deviation of how far covariates may move the logarithm of a parameter
MAX_COVARIATE_LOGARITHM = 3.0  # how far they move it at most
EXACT = 1e-9  # of the squared distance in standard deviations: two neighbours of a covariate differ by little
PRIOR_STD = 0.05  # standard deviation of the logarithm of a nominal parameter, where the recordings know no better
MAX_LOGARITHM = 1.5  # of a parameter relative to the loop file's
DIFFERENCE = 1e-4  # of that logarithm, for derivatives
MAX_STEPS = 12  # of the search for the parameters
MAX_SATURATED_SHARE = 0.5  # share of rows with u at a limit, from which u says nothing


@dataclass(frozen=True, eq=False)
class HealthyPlant:
    """The plant that the healthy recordings show."""

    ratios: dict[str, float]  # parameters relative to the loop file's
    covariance: FloatArray  # of the ratios' logarithms, shape (m, m)
    # theta, theta_covariance: coefficients that the plant leads to under the recordings' references, shapes (n,) and
    # (n, n)
    theta: FloatArray
    theta_covariance: FloatArray
    # of these to the coefficients of least squares: chi-square with n degrees of freedom when the loop file is right
    misfit: float
    true_theta: FloatArray  # coefficients of the plant itself, shape (n,)
    # what is left of v = eta - phi' true when a simulated loop's is taken off, one array per recording
    residuals: list[FloatArray]

    def std(self) -> dict[str, float]:
        """Return the standard deviations of the ratios' logarithms by parameter."""
        return dict(zip(self.ratios, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


def saturated_share(loop: Loop, recording: Recording) -> float:
    """Return the share of samples with u at or beyond a limit, where a linear closed loop is no model of the loop.

    A plant that is not simulated with its controller takes u as it acted, at a limit as elsewhere.
    """
    return share_at_limits(loop, recording) if can_simulate(loop) else 0.0


def share_at_limits(loop: Loop, recording: Recording) -> float:
    """Return the share of samples with u at or beyond a limit."""
    if loop.input_limits is None:
        return 0.0
    low, high = loop.input_limits
    count = 0
    for rows in outofcore.iter_chunks(0, recording.samples):
        u = recording.u[rows]
        count += int(((u <= low) | (u >= high)).sum())
    return count / recording.samples


def can_simulate(loop: Loop) -> bool:
    """Return whether the loop can be simulated as a linear closed loop, which expectations and signatures need."""
    return loop.controller is not None and loop.plant.has_physics and not loop.plant.extras


def split_residual_noise(pipeline: Pipeline, tuning: TuningFit, regressions: Sequence[Regression]) -> WhiteNoise:
    """Split the residual into n_u and n_y; with two stages its autocovariance is a non-negative mixture of theirs."""
    from scipy.optimize import nnls

    if tuning.noises is not None:
        return tuning.noises.noise

    lags = 20
    system = residual_system(pipeline, pipeline.loop.plant)
    columns = [autocovariances(system.input(unit[:, None]), lags, pipeline.stride)[:, 0, 0] for unit in np.eye(2)]
    measured = sample_autocovariance([(g.eta - g.phi @ tuning.tuning.theta)[g.ok] for g in regressions], lags)
    size = np.array([column[0] for column in columns])
    shares, _ = nnls(np.column_stack(columns) / size, measured)
    u_std, y_std = np.sqrt(shares / size).tolist()
    return WhiteNoise(u_std=u_std, y_std=y_std)


def fit_healthy_plant(
    expectations: Sequence[Expectation],
    regressions: Sequence[Regression],
    tuning: TuningFit,
    theta: FloatArray,
    noise: ArmaNoise,
) -> HealthyPlant:
    """Fit the plant's parameters to the healthy recordings, held near the loop file's by a prior.

    Maximum a posteriori by Gauss and Newton on the whitened residual: v = eta - phi' theta with theta fixed has the
    mean that a simulated loop has under the same reference, and a colour that is known. Nothing of the intersample
    behaviour and of the noise in phi is left in it (prediction errors; Ljung, 1999, section 7.4).
    """
    plant = expectations[0].pipeline.loop.plant
    measured = [(g.eta - g.phi @ theta)[g.ok] for g in regressions]

    def misfit(x: FloatArray) -> FloatArray:
        changed = plant.with_ratios(dict(zip(plant.parameters, np.exp(x).tolist(), strict=True)))
        parts = [
            noise.whiten(v - e.mean_residual(changed, theta, g.ok))
            for v, e, g in zip(measured, expectations, regressions, strict=True)
        ]
        return np.concatenate(parts)

    start = np.zeros(len(plant.parameters))
    experiment = Experiment(misfit, start + PRIOR_STD, low=-MAX_LOGARITHM, high=MAX_LOGARITHM, difference=DIFFERENCE)
    fitted = search.fit(experiment, start, steps=MAX_STEPS)
    return describe_healthy_plant(expectations, regressions, tuning, plant.parameters, fitted.x, fitted.covariance)


def describe_healthy_plant(
    expectations: Sequence[Expectation],
    regressions: Sequence[Regression],
    tuning: TuningFit,
    names: Sequence[str],
    x: FloatArray,
    C: FloatArray,
) -> HealthyPlant:
    """Return what m parameters mean for the recursion: logarithms x (m,) of their ratios and covariance C (m, m)."""
    plant = expectations[0].pipeline.loop.plant

    def ratios(x: FloatArray) -> dict[str, float]:
        return dict(zip(names, np.exp(x).tolist(), strict=True))

    def expected(x: FloatArray) -> FloatArray:
        changed = plant.scaled(ratios(x))
        A, b = zip(*(e.normal_equations(changed) for e in expectations), strict=True)
        return solve_scaled(np.sum(A, axis=0), np.sum(b, axis=0))  # each reference weighs what it tells, as in the fit

    step = 1e-3
    J = np.array([expected(x + step * e) - expected(x - step * e) for e in np.eye(len(x))]).T
    J /= 2.0 * step
    limit = expected(x)
    size = np.sqrt(np.diag(tuning.covariance))
    off = (tuning.tuning.theta - limit) / size
    covariance = tuning.covariance / np.outer(size, size) + 1e-9 * np.eye(len(size))
    final = plant.scaled(ratios(x))
    true = nominal_theta(expectations[0].pipeline.loop, final)
    return HealthyPlant(
        ratios=ratios(x),
        covariance=C,
        theta=limit,
        theta_covariance=J @ C @ J.T,
        misfit=float(off @ np.linalg.solve(covariance, off)),
        true_theta=true,
        residuals=[
            (g.eta - g.phi @ true)[g.ok] - e.mean_residual(final, true, g.ok)
            for g, e in zip(regressions, expectations, strict=True)
        ],
    )


def match_ratios(
    loop: Loop, ratios: Mapping[str, float], theta: FloatArray, covariance: FloatArray
) -> dict[str, float]:
    """Return the ratios of the same parameters at which the plant has other coefficients theta (n,), about known ones.

    Least squares weighted by the covariance (n, n) of theta; a parameter that theta does not tell stays where it is.
    """
    before = np.log(list(ratios.values()))
    size = np.sqrt(np.diag(covariance))
    white = np.linalg.inv(np.linalg.cholesky(covariance / np.outer(size, size))) / size

    def misfit(x: FloatArray) -> FloatArray:
        plant = loop.plant.scaled(dict(zip(ratios, np.exp(before + x).tolist(), strict=True)))
        return np.asarray(white @ (nominal_theta(loop, plant) - theta))

    start = np.zeros(len(before))
    reach = MAX_COVARIATE_LOGARITHM
    x = search.fit(Experiment(misfit, start + COVARIATE_PRIOR_STD, low=-reach, high=reach), start, tolerance=EXACT).x
    return dict(zip(ratios, np.exp(before + x).tolist(), strict=True))


def fault_directions(
    loop: Loop, plant: Plant, theta: FloatArray, parameters: Sequence[str] | None = None
) -> dict[str, FloatArray]:
    """Return d theta / d log(parameter) for every parameter of the plant's faults, or others, each of shape (n,)."""
    parameters = plant.parameters if parameters is None else parameters
    if plant.has_physics and not plant.extras and not plant.parameters_are_coefficients:
        step = 1e-4

        def at(ratio: float, parameter: str) -> FloatArray:
            return nominal_theta(loop, plant.scaled({parameter: ratio}))

        return {p: (at(np.exp(step), p) - at(np.exp(-step), p)) / (2.0 * step) for p in parameters}
    healthy = dict(zip(plant.names, theta.tolist(), strict=True))
    moved = {p: plant.exponents(p, healthy) for p in parameters}
    return {p: np.array([powers.get(name, 0.0) for name in plant.names]) * theta for p, powers in moved.items()}
