"""Healthy recordings of a motor axis -> its coefficients, how much they scatter, and the noise of its filter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.messages import Message, message
from servoscope.detection.axis_model import AxisModel
from servoscope.estimation.axis_filter import AxisFilter, AxisNoise, AxisSignals, axis_stride
from servoscope.estimation.tuning import sum_covariance
from servoscope.isolation.ml.axis_window import LONG_RUN_S, axis_signals
from servoscope.models.loop import Loop
from servoscope.models.plants.axis import AxisPlant
from servoscope.signals import Recording

REST_SHARE = 0.03  # of the speed of motion (rms), below which the axis counts as resting
LONGEST_FORCE_S = 0.05  # correlation of the unexplained force: a slower one would take over what friction does
SCATTER = 0.05  # standard deviation of a coefficient's logarithm between recordings, before any is compared
SCATTER_DOF = 2.0  # recordings that this is worth
LEAST_SCATTER = 0.01
ADDED_SHARE = 0.05  # of the force (rms), by which the constant one may differ between recordings and within one
SEEN = 3.0  # standard deviations from which a coefficient is seen
STEPS = 250  # of the search for the noise


@dataclass(frozen=True, eq=False)
class AxisFit:
    """The coefficients of one recording: b, those of the terms, and of what is its own, with their covariance."""

    coefficients: FloatArray  # b, a and the nuisances, of ``y'' = b u - sum a_i column_i``
    covariance: FloatArray  # of their estimates, by the long-run variance of the scores
    cost: float  # sum of squared innovations
    count: int  # innovations that count


@dataclass(frozen=True, eq=False)
class AxisRegression:
    """One recording: signals, and the columns of its regression."""

    signals: AxisSignals
    columns: FloatArray

    @classmethod
    def of(cls, plant: AxisPlant, signals: AxisSignals) -> AxisRegression:
        """Return the columns of the terms, then those of the recording's own force and its drift."""
        N = len(signals.y)
        own = [-np.linspace(-0.5, 0.5, N)] if "offset" in plant.terms else [-np.ones(N), -np.linspace(-0.5, 0.5, N)]
        return cls(signals, np.vstack([signals.columns(plant), *own]))

    def regress(self, noise: AxisNoise, rest_speed: float) -> tuple[FloatArray, FloatArray, AxisFilter]:
        """Return regressors (N, p) and target (N,) of the innovations that count, in standard deviations."""
        filter = AxisFilter.design(noise, self.signals.sample_rate, self.signals.derivative)
        where = self.signals.moving(rest_speed, filter.settling)
        X = filter.of_acceleration(self.columns, self.signals.runs)[:, where].T
        e = filter.of_output(self.signals.y, self.signals.runs)[where]
        return X / np.sqrt(filter.variance), e / np.sqrt(filter.variance), filter


def rest_speed(signals: Sequence[AxisSignals]) -> float:
    """Return the speed below which an axis counts as resting."""
    speed = np.concatenate([one.speed for one in signals])
    return REST_SHARE * float(np.sqrt(np.mean(speed**2)))


def fit_axis_noise(problems: Sequence[AxisRegression], slow: float) -> AxisNoise:
    """Return the noise that makes the innovations likeliest, each recording with coefficients of its own.

    Raises LinAlgError where the signals say nothing.
    """
    from scipy.optimize import minimize
    from scipy.signal import savgol_filter

    rate = problems[0].signals.sample_rate
    accelerations = [np.gradient(one.signals.speed, 1.0 / rate) for one in problems]
    rough = np.concatenate([one.signals.y - savgol_filter(one.signals.y, 5, 2) for one in problems])
    size = float(np.sqrt(np.mean(np.concatenate(accelerations) ** 2)))
    start = np.log([0.2 * size, 1.0 / rate, max(float(rough.std()), 1e-12 * size)])
    bounds = [
        (start[0] - 7.0, start[0] + 5.0),
        tuple(np.log([0.1 / rate, LONGEST_FORCE_S])),
        (start[2] - 9.0, start[2] + 3.0),
    ]

    def cost(x: FloatArray) -> float:
        total = 0.0
        for one in problems:
            X, e, filter = one.regress(AxisNoise(*np.exp(x).tolist()), slow)
            left = e - X @ np.linalg.lstsq(X, e, rcond=None)[0]
            total += len(e) * float(np.log(filter.variance)) + float(left @ left)
        return total

    found = minimize(
        cost, start, method="Nelder-Mead", bounds=bounds, options={"maxiter": STEPS, "xatol": 0.02, "fatol": 0.5}
    )
    return AxisNoise(*np.exp(found.x).tolist())


def fit_recording(problem: AxisRegression, noise: AxisNoise, slow: float) -> AxisFit:
    """Return the coefficients of one recording by least squares on its innovations."""
    X, e, _ = problem.regress(noise, slow)
    size = np.linalg.norm(X, axis=0)
    theta, *_ = np.linalg.lstsq(X / size, e, rcond=None)
    left = e - X / size @ theta
    H = np.linalg.inv((X / size).T @ (X / size))
    lags = round(LONG_RUN_S * problem.signals.sample_rate)
    G = sum_covariance(X / size * left[:, None], lags)
    covariance = H @ G @ H
    return AxisFit(theta / size, covariance / np.outer(size, size), float(left @ left), len(e))


def fit_axis(loop: Loop, recordings: Sequence[Recording]) -> tuple[AxisModel | None, list[Message]]:
    """Learn a healthy axis; None, with a note, where u does not show its inertia.

    A friction that the recordings do not show stays as they have it, and has no faults in the refit.
    """
    plant, stride = loop.plant, axis_stride(loop.sample_rate)
    assert isinstance(plant, AxisPlant)
    signals = [axis_signals(loop, one, stride) for one in recordings]
    slow = rest_speed(signals)
    problems = [AxisRegression.of(plant, one) for one in signals]
    noise = fit_axis_noise(problems, slow)
    fits = [fit_recording(one, noise, slow) for one in problems]
    names = ("inertia", *(column.coefficient for column in plant.columns))
    values = np.array([_physical(one, plant, len(names)) for one in fits])
    stds = np.array([np.sqrt(np.diag(_physical_covariance(one, plant, len(names)))) for one in fits])
    weight = 1.0 / (stds**2 + (SCATTER * values) ** 2)
    mean = (weight * values).sum(axis=0) / weight.sum(axis=0)
    known = [
        i for i, name in enumerate(names) if name == "inertia" or not plant.columns[i - 1].signed or name == "gravity"
    ]
    # of all recordings together (Stouffer, 1949)
    seen = (values / stds).sum(axis=0) / np.sqrt(len(fits))
    unseen = [i for i in known if seen[i] < SEEN and names[i] != "gravity"]
    of_unseen = tuple(names[i] for i in unseen)
    if 0 in unseen:
        return None, [message("learning.axis_unseen_none", names=of_unseen)]
    notes = [message("learning.axis_unseen_partly", names=of_unseen)] if unseen else []
    off = np.sqrt(np.mean((values - mean) ** 2 + stds**2, axis=0))
    mean[unseen] = np.maximum(mean[unseen], 0.0)  # friction drives nothing
    known = [i for i in known if i not in unseen]
    covariance = np.zeros((len(known), len(known)))
    for one in fits:
        C = _physical_covariance(one, plant, len(names))[np.ix_(known, known)]
        covariance += C / np.outer(mean[known], mean[known]) / len(fits)
    logs = values[:, known] / mean[known] - 1.0
    own = np.diag(covariance)
    between = (SCATTER_DOF * SCATTER**2 + np.maximum((logs**2).sum(axis=0) - (len(fits) - 1) * own, 0.0)) / (
        SCATTER_DOF + len(fits) - 1
    )
    covariance = covariance / len(fits) + np.diag(np.maximum(between, LEAST_SCATTER**2))
    coefficients = dict(zip(names, mean.tolist(), strict=True))
    force = abs(plant.input_gain) * float(np.sqrt(np.mean(np.concatenate([one.u for one in signals]) ** 2)))
    model = AxisModel(
        coefficients=coefficients,
        parameters=tuple(names[i] for i in known),
        covariance=tuple(tuple(row) for row in covariance.tolist()),
        noise=noise,
        stride=stride,
        rest_speed=slow,
        offset_std=ADDED_SHARE * force,
        drift_std=ADDED_SHARE * force,
        unseen=dict(zip(of_unseen, off[unseen].tolist(), strict=True)),
    )
    return model, notes


def _physical(fit: AxisFit, plant: AxisPlant, n: int) -> FloatArray:
    """Return inertia and the coefficients of the terms, shape (n,)."""
    inertia = plant.input_gain / fit.coefficients[0]
    return np.array([inertia, *(inertia * fit.coefficients[1:n])])


def _physical_covariance(fit: AxisFit, plant: AxisPlant, n: int) -> FloatArray:
    b, a = fit.coefficients[0], fit.coefficients[1:n]
    J = np.zeros((n, n))
    J[:, 0] = -plant.input_gain / b**2 * np.array([1.0, *a])
    J[1:, 1:] = np.eye(n - 1) * plant.input_gain / b
    return np.asarray(J @ fit.covariance[:n, :n] @ J.T)
