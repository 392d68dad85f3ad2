"""The stretch of a recording of a motor axis that a refit looks at: innovations that are linear in its coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from servoscope.baseline.axis_model import AxisModel, AxisMoves
from servoscope.baseline.baseline import Baseline
from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.core.jit import minimum, where
from servoscope.core.jit.array_function import ArrayFunction
from servoscope.estimation.axis_filter import NO_LAG, AxisFilter, AxisSignals, DriveLag
from servoscope.estimation.noise_model import sample_autocovariance
from servoscope.fit.kernels import Array
from servoscope.fit.plant_experiment import plant_input
from servoscope.isolation.ml.least_squares import orthonormal_basis
from servoscope.isolation.ml.window import (
    SENSOR_GAIN,
    ChangeProfile,
    ChangeSums,
    ChangeWindow,
    delay_input,
)
from servoscope.models.loop import Loop
from servoscope.models.plants.axis import AxisPlant
from servoscope.models.plants.base import FaultRay, expand_rays
from servoscope.signals import Recording

RECORDING_NUISANCES = (
    "offset",
    "drift",
)  # nuisances of every recording: a constant force, and its change from end to end
LONG_RUN_S = 0.5  # over which the scores may hang together


@dataclass(frozen=True, eq=False)
class AxisWindow(ChangeWindow):
    """What the filter of a motor axis sees; `names` are the logarithms of parameters, then `RECORDING_NUISANCES`."""

    plant: AxisPlant
    model: AxisModel
    rate: float
    factors: FloatArray | None  # what covariates multiply the columns by, shape (1 + n, N)

    systematic = 2e-2  # the terms are simpler than friction is
    size_error = 2e-2
    follows = True  # healthy recordings differ by more than small changes do

    @classmethod
    def from_recording(cls, baseline: Baseline, recording: Recording, first: int, end: int) -> AxisWindow:
        """Cut samples `first` to `end` out of a recording of an axis."""
        if baseline.axis is None:
            raise ValueError("a window of an axis needs a baseline of one")
        return cls.of_healthy(baseline.loop, baseline.axis, recording.rows(slice(first, end)), first)

    @classmethod
    def of_healthy(cls, loop: Loop, model: AxisModel, recording: Recording, first: int = 0) -> AxisWindow:
        """Return all of a recording of a healthy axis; it begins at sample `first` of a longer one."""
        assert isinstance(loop.plant, AxisPlant)
        signals = axis_signals(loop, recording, model.stride, model.drive, model.moves)
        root = [np.linalg.inv(np.linalg.cholesky(np.array(model.covariance)))] if model.parameters else []
        m = len(model.parameters)
        prior = np.zeros((m + 2, m + 2))
        prior[:m, :m] = root[0] if root else 0.0
        prior[m:, m:] = np.diag([1.0 / model.offset_std, 1.0 / model.drift_std])
        return cls(
            model.plant(loop.plant),
            prior,
            (*model.parameters, *RECORDING_NUISANCES),
            first,
            signals.u,
            signals.y,
            signals.restart,
            model,
            signals.sample_rate,
            signals.factors,
        )

    @property
    def stride(self) -> int:  # type: ignore[override]
        """Samples of the recording from one of the window to the next."""
        return self.model.stride

    @property
    def coloured(self) -> int:  # type: ignore[override]
        """Samples over which what the terms leave of friction may hang together."""
        return round(LONG_RUN_S * self.rate)

    @property
    def sample_rate(self) -> float:
        """Sample rate of the window [Hz]."""
        return self.rate

    @property
    def noise_y_std(self) -> float:
        """Standard deviation of the noise of y."""
        return self.model.noise.y_std

    @cached_property
    def filter(self) -> AxisFilter:
        """The filter."""
        return AxisFilter.design(self.model.noise, self.rate, self.plant.derivative)

    @cached_property
    def signals(self) -> AxisSignals:
        """The samples of the window."""
        return AxisSignals(self.u, self.y, self.restart, self.rate, self.plant.derivative, self.factors)

    @cached_property
    def columns(self) -> FloatArray:
        """What the coefficients multiply, shape (1 + n + 2, N); the last two are offset and drift."""
        drift = np.linspace(-0.5, 0.5, self.samples)
        return np.vstack([self.signals.columns(self.plant), -np.ones(self.samples), -drift])

    @cached_property
    def counted(self) -> BoolArray:
        """Where an innovation counts, shape (N,)."""
        return self.signals.moving(self.model.rest_speed, self.filter.settling)

    @property
    def used(self) -> int:
        """Number of innovations that count."""
        return max(int(self.counted.sum()), 1)

    @cached_property
    def _weight(self) -> FloatArray:
        return np.asarray(self.counted / np.sqrt(self.filter.variance))

    @cached_property
    def _rays(self) -> tuple[FaultRay, ...]:
        return self.plant.rays

    @cached_property
    def _grows_with_y(self) -> BoolArray:
        """Columns that grow with y as measured, and so with its gain, shape (1 + n,)."""
        return np.array([False, *(column.degree != 0 for column in self.plant.acting)])

    @cached_property
    def _of_output(self) -> FloatArray:
        return self.filter.of_output(self.y, self.signals.runs)

    def predictor(self, d: Array, names: Sequence[str], x: Array, profile: ChangeProfile) -> Array:
        """Return the coefficients of all columns, healthy and from then on, shape (p, 1 + n + 2)."""
        m = len(self.model.parameters)
        healthy = dict(zip(self.names[:m], np.exp(d[:m]), strict=True))
        rows = [self._coefficients(healthy, d[m:])]
        for share in profile.shares:
            faulty = dict(healthy)
            for name, value in zip(names, np.exp(share * x), strict=True):
                faulty[name] = faulty.get(name, 1.0) * value
            rows.append(self._coefficients(faulty, d[m:]))
        return np.array(rows)

    def _coefficients(self, factors: dict[str, Any], added: Array) -> Array:
        factors = dict(factors)
        output_gain = factors.pop(SENSOR_GAIN, 1.0)
        moved = self.plant.scaled_coefficients(expand_rays(self._rays, factors))
        coefficients = self.plant.acceleration_coefficients(moved)
        coefficients = np.where(self._grows_with_y, 1.0, output_gain) * coefficients
        return np.concatenate([coefficients, output_gain * np.asarray(added) / moved["inertia"]])

    def _shares(self, profile: ChangeProfile, predictors: int) -> FloatArray:
        """Return how far each set of coefficients is in force, shape (p, N)."""
        p, k = predictors - 1, np.arange(self.samples)
        if profile.duration:
            at = np.clip((k - profile.onset) / profile.duration, 0.0, 1.0) * p
            return np.asarray(np.maximum(1.0 - np.abs(at - np.arange(predictors)[:, None]), 0.0))
        return np.array([k < profile.onset, k >= profile.onset], dtype=np.float64)

    def _responses(self, profile: ChangeProfile, predictors: int) -> FloatArray:
        """Return what a unit of each coefficient, in force by its share, takes off the innovations, (p (1 + n + 2), N).

        A search tries many sizes of one profile: the last one is kept.
        """
        if self._kept.get("profile") != (profile, predictors):
            parts = self._shares(profile, predictors)[:, None] * self.columns
            responses = self.filter.of_acceleration(parts.reshape(-1, self.samples), self.signals.runs)
            self._kept.update(profile=(profile, predictors), responses=responses * self._weight)
        return np.asarray(self._kept["responses"])

    @cached_property
    def _kept(self) -> dict[str, Any]:
        return {}

    def innovations(self, predictor: Array, profile: ChangeProfile) -> Array:
        """Return the innovations in standard deviations, shape (N,); 0 where they do not count."""
        return np.asarray(self.variant_innovations([predictor], profile)[0])

    def variant_innovations(self, variants: Sequence[Array], profile: ChangeProfile) -> Array:
        """Return the innovations of each in standard deviations, shape (V, N)."""
        matrix = np.array(variants)
        responses, matrix = self._responses(profile, matrix.shape[1]), matrix.reshape(len(matrix), -1)
        innovations = self._of_output * self._weight - matrix.real @ responses
        return innovations - 1j * (matrix.imag @ responses) if np.iscomplexobj(matrix) else innovations

    def disturbance_response(
        self, predictor: Array, profile: ChangeProfile, u: FloatArray, y: FloatArray
    ) -> FloatArray:
        """Return what disturbances of u and of y, shape (N,), add to the innovations."""
        predictor, runs = np.real(predictor), self.signals.runs
        acceleration = predictor[:, 0] @ self._shares(profile, len(predictor)) * u
        added = self.filter.of_output(y, runs) - self.filter.of_acceleration(acceleration, runs)
        return np.asarray(added * self._weight)

    def unmodelled_signals(self) -> tuple[list[FloatArray], list[FloatArray]]:
        """Return forces that no term of the axis has: of position, of its square, and of the speed's."""
        v, y = self.signals.speed, self.y - self.y.mean()
        placed = [] if self.plant.derivative else [y, y**2]
        return [], [*placed, v * np.abs(v), v, np.sign(v), np.ones(self.samples)]

    def inflation(self, jacobian: FloatArray, residual: FloatArray, sizes: int) -> float:
        """Return the long-run variance of the scores of the sizes over that of white innovations, at least 1.

        What is left of real friction hangs together over tenths of seconds (Newey and West, 1987).
        """
        if not sizes:
            return 1.0
        J, N, lags = jacobian, self.samples, self.coloured
        Q = orthonormal_basis(J[:, :-sizes])
        own = J[:, -sizes:] - Q @ (Q.T @ J[:, -sizes:])
        e = residual[:N]
        variance = float(e @ e) / self.used
        inflations = [1.0]
        for column in own[:N].T:
            gamma = sample_autocovariance([column * e], lags)
            window = 1.0 - np.arange(1, lags + 1) / (lags + 1.0)
            white = variance * float(column @ column) / N
            inflations.append(float(gamma[0] + 2.0 * (window * gamma[1:]).sum()) / max(white, 1e-300))
        return max(inflations)

    def change_sums(self, d: FloatArray, names: Sequence[str], x: FloatArray, step: float, Q: FloatArray) -> ChangeSums:
        """Prepare the sums of products by onset; a drift grows in a straight line."""
        at = ChangeProfile(0)
        healthy, changed = self.predictor(d, names, x, at)
        moved = [(self.predictor(d, names, x + step * e, at)[-1] - changed) / step for e in np.eye(len(x))]
        added = np.array([changed - healthy, *moved]) @ self.columns
        e = np.asarray(self.innovations(np.array([healthy, healthy]), at))

        before = np.zeros((len(e) + 1, 1 + Q.shape[1]))
        np.cumsum(e[:, None] * np.column_stack([e, Q]), axis=0, out=before[1:])
        signals, V = (self.filter.to_acceleration, self.filter.poles, added, e, self._weight, self.restart), len(added)

        def sums(onsets: IntArray, overs: IntArray) -> tuple[FloatArray, FloatArray]:
            costs = np.zeros((len(onsets), V, V + Q.shape[1]))
            onset_sums(*signals, onsets, overs, Q, before, np.empty((V, 3)), np.empty(V), costs)
            return costs, np.zeros(len(onsets))

        return sums

    def cut(self, first: int, end: int) -> AxisWindow:
        """Return samples `first` to `end` of it."""
        factors = None if self.factors is None else self.factors[:, first:end]
        return replace(super().cut(first, end), factors=factors)  # what was computed of the whole is left behind


def axis_signals(
    loop: Loop, recording: Recording, stride: int, drive: DriveLag = NO_LAG, moves: AxisMoves | None = None
) -> AxisSignals:
    """Return a recording as the filter of an axis takes it.

    `drive`: how late the force is beyond the loop's delay; `moves`: how covariates move the coefficients.
    """
    plant = loop.plant
    assert isinstance(plant, AxisPlant)
    restart = recording.restart.copy()
    restart[0] = True
    u = delay_input(plant_input(loop, recording.u), restart, round(loop.delay * loop.sample_rate))
    if loop.hold == "foh":  # the mean until the next sample is that of both
        drive = drive._replace(delay_s=drive.delay_s - 0.5 / loop.sample_rate)
    u = drive.of_input(u, restart, loop.sample_rate)
    factors = None if moves is None else moves.factors(plant, recording.channels)
    return AxisSignals.thinned(u, recording.y, restart, loop.sample_rate, stride, plant.derivative, factors)


@ArrayFunction
def onset_sums(
    printer: Any, numerator: Any, poles: Any, added: Any, e: Any, weight: Any, restart: Any, onsets: Any,
    durations: Any, Q: Any, before: Any, state: Any, row: Any, out: Any,
) -> None:  # fmt: skip
    """Sum up products of innovations and their derivatives for changes that come at many times, (M, V, V + m).

    `added` (V, N): accelerations that the change and its derivatives add, filtered by ``numerator/poles`` (order 3)
    from the onset on, growing over the duration; `e` (N,): healthy innovations; Q (N, m); `before` (N + 1, 1 + m):
    sums of their products with e and Q up to a sample; state (V, 3) and row (V,) are scratch memory; `out` is zero.
    """
    (V, N), m = added.shape, Q.shape[1]
    for i in printer.loop(0, onsets.shape[0]):
        first, duration = onsets[i], durations[i]
        for v in printer.loop(0, V):
            for o in range(3):
                state[v, o] = 0.0
        out[i, 0, 0] = before[first, 0]
        for j in printer.loop(0, m):
            out[i, 0, V + j] = before[first, 1 + j]
        for k in printer.loop(first, N):
            grown = minimum(printer.number(k - first) / printer.number(duration), 1.0)
            share = where(duration > 0, grown, 1.0)
            for v in printer.loop(0, V):
                old = [where(restart[k] > 0, 0.0, state[v, o]) for o in range(3)]
                x = share * added[v, k]
                y = numerator[0] * x + old[0]
                for o in range(2):
                    state[v, o] = numerator[o + 1] * x - poles[o + 1] * y + old[o + 1]
                state[v, 2] = numerator[3] * x - poles[3] * y
                row[v] = -y * weight[k]
            row[0] = row[0] + e[k]
            for v in printer.loop(0, V):
                for w in printer.loop(0, v + 1):
                    out[i, v, w] = out[i, v, w] + row[v] * row[w]
                for j in printer.loop(0, m):
                    out[i, v, V + j] = out[i, v, V + j] + row[v] * Q[k, j]
        for v in printer.loop(0, V):
            for w in printer.loop(0, v):
                out[i, w, v] = out[i, v, w]
