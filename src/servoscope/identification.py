"""Which noise and which plant would say what the healthy recordings say; and where theta goes when it ails."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servoscope.inverse import nominal_theta
from servoscope.linear import Linear, autocovariances
from servoscope.loop import Loop
from servoscope.pipeline import Pipeline, Regression
from servoscope.plants import FloatArray, Plant
from servoscope.recording import Recording
from servoscope.signatures import Expectation, Noise, noise_system
from servoscope.tuning import Fit, autocovariance

PRIOR = 0.05  # standard deviation of the logarithm of a nominal parameter, where the recordings know no better


MOST_SATURATED = 0.5  # share of rows with u at a limit, from which u says nothing


@dataclass(frozen=True, eq=False)
class HealthyPlant:
    """The plant that the healthy recordings show.

    Parameters
    ----------
    ratios
        Parameters relative to the loop file's.
    std
        Standard deviations of the ratios' logarithms.
    theta
        Coefficients that the plant leads to under the recordings' references, shape (n,).
    misfit
        Chi-square with n degrees of freedom when the loop file is right.
    """

    ratios: dict[str, float]
    std: dict[str, float]
    theta: FloatArray
    misfit: float


def saturated(loop: Loop, recording: Recording) -> float:
    """Return the share of samples with u at or beyond a limit of the loop."""
    if loop.input_limits is None:
        return 0.0
    low, high = loop.input_limits
    return float(((recording.u <= low) | (recording.u >= high)).mean())


def simulated(loop: Loop) -> bool:
    """Return whether the loop can be simulated as a linear closed loop, which expectations and signatures need."""
    return loop.controller is not None and loop.plant.has_physics and not loop.plant.extras


def noise_of(pipeline: Pipeline, found: Fit, regressions: Sequence[Regression]) -> Noise:
    """Split the residual into n_u and n_y: its autocovariance is a non-negative mixture of theirs."""
    from scipy.optimize import nnls

    lags = 20
    n = pipeline.bank.n
    residual = np.concatenate([[1.0], -nominal_theta(pipeline.loop)])  # v = eta - phi' theta
    system = noise_system(pipeline, pipeline.loop.plant)
    v = Linear(system.A, system.B, residual @ system.C[None, : 1 + n], residual @ system.D[None, : 1 + n])
    columns = [
        autocovariances(Linear(v.A, v.B[:, [i]], v.C, v.D[:, [i]]), lags, pipeline.stride)[:, 0, 0] for i in (0, 1)
    ]
    measured = autocovariance([(g.eta - g.phi @ found.tuning.theta)[g.ok] for g in regressions], lags)
    size = np.array([column[0] for column in columns])
    shares, _ = nnls(np.column_stack(columns) / size, measured)
    u_std, y_std = np.sqrt(shares / size).tolist()
    return Noise(u_std=u_std, y_std=y_std)


def healthy_parameters(expectations: Sequence[Expectation], found: Fit, covariance: FloatArray) -> HealthyPlant:
    """Fit the plant's parameters to the healthy coefficients, held near the loop file's by a prior.

    Maximum a posteriori by Gauss and Newton on the expected least squares estimate.
    """
    from scipy.optimize import least_squares as minimise

    plant = expectations[0].pipeline.loop.plant
    size = np.sqrt(np.diag(covariance))
    L = np.linalg.cholesky(covariance / np.outer(size, size) + 1e-9 * np.eye(len(size)))
    weights = [len(e.course.kept) for e in expectations]

    def ratios(x: FloatArray) -> dict[str, float]:
        return dict(zip(plant.parameters, np.exp(x).tolist(), strict=True))

    def expected(x: FloatArray) -> FloatArray:
        changed = plant.with_ratios(ratios(x))
        return np.asarray(np.average([e.batch(changed) for e in expectations], axis=0, weights=weights))

    def misfit(x: FloatArray) -> FloatArray:
        return np.concatenate([np.linalg.solve(L, (found.tuning.theta - expected(x)) / size), x / PRIOR])

    start = np.zeros(len(plant.parameters))
    result = minimise(misfit, start, x_scale=PRIOR, diff_step=[1e-3], max_nfev=12, bounds=(-1.5, 1.5))
    slope = np.asarray(result.jac)
    std = np.sqrt(np.diag(np.linalg.inv(slope.T @ slope)))
    return HealthyPlant(
        ratios(result.x),
        dict(zip(plant.parameters, std.tolist(), strict=True)),
        expected(result.x),
        2.0 * float(result.cost),
    )


def fault_directions(loop: Loop, plant: Plant, theta: FloatArray) -> dict[str, FloatArray]:
    """Return d theta / d log(parameter) for every parameter of the plant's faults, each of shape (n,)."""
    if plant.has_physics and not plant.extras and loop.plant.kind != "polynomial":
        step = 1e-4

        def at(ratio: float, parameter: str) -> FloatArray:
            return nominal_theta(loop.model_copy(update={"plant": plant.with_ratios({parameter: ratio})}))

        return {p: (at(np.exp(step), p) - at(np.exp(-step), p)) / (2.0 * step) for p in plant.parameters}
    names = plant.names
    return {p: np.where(np.array(names) == p, theta, 0.0) if p in names else np.array(theta) for p in plant.parameters}
