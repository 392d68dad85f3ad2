"""The sequential test on drawn noise, compiled: when each of many realisations would alarm."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from servoscope.baseline.expectation import Expectation, ReferencePath, residual_noise_model
from servoscope.baseline.plant_fit import fault_directions
from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.errors import SimulationError
from servoscope.core.jit import kernel
from servoscope.design.fisher_information import fisher_matrix
from servoscope.design.scenario import Scenario
from servoscope.detection.baseline_run import cusum_constants
from servoscope.detection.cusum_design import STEP
from servoscope.detection.statistic import POWER, apply_alarm_delays, whiten
from servoscope.estimation.filter_bank import nominal_theta
from servoscope.estimation.kernel.cusum import CLIP, LAGS, lagged_columns
from servoscope.estimation.pipeline import Regression
from servoscope.isolation.ml.hypothesis import log_ratio_bounds
from servoscope.models.plants import Fault
from servoscope.signals import Recording
from servoscope.simulation import simulate


@kernel
def cusum_crossings(
    shift: FloatArray, noise: FloatArray, heard: FloatArray, limits: FloatArray, since: int, together: int
) -> FloatArray:
    """Return how many updates after `since` the first CUSUM reaches its limit, shape (M,); infinity if none does.

    `shift`: what the change adds to the whitened residual, shape (K,); `noise`: realisations of the residual of a
    healthy loop, shape (M, K); `heard`: shifts that the members listen for, shape (q, K); `limits`: shape (q,);
    `together`: updates that a step of the CUSUMs takes together.
    """
    M, K = noise.shape
    q = len(limits)
    found = np.full(M, np.inf)
    g, gain = np.zeros(q), np.zeros(q)
    for i in range(M):
        g[:] = 0.0
        gain[:] = 0.0
        for k in range(K):
            e = min(max(noise[i, k] + shift[k], -CLIP), CLIP)
            over = False
            for j in range(q):
                s = heard[j, k]
                gain[j] += s * (e - 0.5 * s)
                if (k + 1) % together != 0:
                    continue
                g[j] = max(g[j] + gain[j], 0.0)
                gain[j] = 0.0
                if g[j] >= limits[j]:
                    over = True
                    g[j] = limits[j]
            if over and k >= since:
                found[i] = k - since + 1.0
                break
    return found


RUNS = 120  # healthy recordings that are simulated, each with an error of the baseline
MEMORIES = 5.0  # before the onset, after which an estimate has forgotten how it began
SEED = 77
HOPELESS = 6.0  # standard deviations by which a CUSUM misses its limit on average
FINE = 0.02  # relative precision of a radius
GUESS = 60.0  # squared distance from healthy with which a search begins
BRACKET = 1.3


@dataclass(frozen=True, eq=False)
class AlarmDelays:
    """Times from onset to alarm [s], infinite where there is none in time: one per realisation, (M,)."""

    times: FloatArray

    def probability(self, within_s: float = np.inf) -> float:
        """Return the probability of an alarm within some seconds."""
        return float(np.mean((self.times <= within_s) & np.isfinite(self.times)))

    def quantile(self, share: float) -> float:
        """Return the time by which a share of all changes is announced [s]; may be infinite."""
        return float(np.sort(self.times)[int(np.ceil(share * len(self.times) - 1e-9)) - 1])


class AlarmSimulator:
    """Both tests of a baseline under one reference, beside realisations of their noise and of the baseline's error."""

    def __init__(self, scene: Scenario) -> None:
        self.scene, self.baseline = scene, scene.baseline
        loop, self.plant = scene.loop, self.baseline.plant
        rate = loop.sample_rate
        first = max(scene.onset - round(MEMORIES * loop.monitor.memory * rate), 0)
        self.r, self.onset = scene.r[first:], scene.onset - first
        self.pipeline, self.tuning, self.noise = self.baseline.pipeline(), self.baseline.tuning, scene.noise
        kept = np.arange(len(self.r))
        self.expectation = Expectation(self.pipeline, self.tuning, self.noise, ReferencePath(self.r, kept, kept == 0))
        self.rng, self.theta = np.random.default_rng(SEED), nominal_theta(loop, self.plant)
        healthy, (u_std, y_std) = loop.model_copy(update={"plant": self.plant}), (self.noise.u_std, self.noise.y_std)
        recordings = [
            simulate(healthy, self.r, noise_u_std=u_std, noise_y_std=y_std, seed=SEED + i)[0] for i in range(RUNS)
        ]
        parameters, coefficients = self._draw_baseline_errors()
        self._prepare_statistic(recordings, coefficients)
        self._prepare_cusums(recordings, parameters)

    def delays(self, fault: Fault, x: float) -> AlarmDelays:
        """Return when a fault is announced whose logarithm of the ratio is x."""
        pass

        faulty = self.plant.with_ratios({fault.parameter: float(np.exp(x))})
        rate, every = self.scene.loop.sample_rate, self.pipeline.every
        path = self.expectation.mean_path(self.start, self.plant, faulty, self.onset)[self.evaluated] - self.healthy
        T2 = ((self.errors + np.einsum("kij,kj->ki", self.whitening_matrices, path)) ** 2).sum(axis=-1)
        on = self.pipeline.delays[0]
        alarm = np.array([apply_alarm_delays(over, on, 0) for over in self.baseline.limit < T2])
        late = np.where(alarm.any(axis=1), (self.index[alarm.argmax(axis=1)] - self.onset + 1) / rate, np.inf)
        if not len(self.limits):
            return AlarmDelays(late)
        shift = self._shift(self.expectation.regression(self.plant, faulty, self.onset))
        chosen = self._reachable_cusums(shift)
        heard, limits = self.cusum_shifts[chosen], self.limits[chosen]
        together = self.pipeline.cusum_updates
        updates = cusum_crossings(shift, self.residuals, heard, limits, self.onset_update, together)
        evaluations = np.ceil(updates * self.pipeline.stride / every) + on
        return AlarmDelays(np.minimum(late, evaluations * every / rate))

    def _reachable_cusums(self, shift: FloatArray) -> BoolArray:
        """Return which CUSUMs have a chance to reach their limits, shape (q,)."""
        s = self.cusum_shifts[:, self.onset_update :]
        drift = np.cumsum(s * (shift[self.onset_update :] - 0.5 * s), axis=1)
        reach = (drift + HOPELESS * np.sqrt(np.cumsum(s**2, axis=1))).max(axis=1)
        return np.asarray(reach >= self.limits)

    def _draw_baseline_errors(self) -> tuple[FloatArray, FloatArray]:
        """Draw errors of the healthy parameters, (M, m), and of the coefficients that they lead to, (M, n)."""
        C = np.array(self.baseline.ratios_covariance)
        if len(C) and self.baseline.members:  # both tests err together
            error = self.rng.standard_normal((RUNS, len(C))) @ np.linalg.cholesky(C).T
            names = self.plant.physical_parameters[: len(C)]
            directions = fault_directions(self.scene.loop, self.plant, self.theta, names)
            return error, error @ np.array([directions[name] for name in names])
        C = self.baseline.covariance_array()
        size = np.sqrt(np.maximum(np.diag(C), 1e-300))
        value, vector = np.linalg.eigh(C / np.outer(size, size))
        root = size[:, None] * vector * np.sqrt(np.maximum(value, 0.0))
        return np.zeros((RUNS, 0)), self.rng.standard_normal((RUNS, len(C))) @ root.T

    def _prepare_statistic(self, recordings: Sequence[Recording], errors: FloatArray) -> None:
        """Prepare T^2: deviations of healthy recordings, whitened with what the baseline thinks of them."""
        e = [self.pipeline.estimate(self.tuning, recording) for recording in recordings]
        self.evaluated = (e[0].updates > 0) & (e[0].index >= self.onset)
        self.index = e[0].index[self.evaluated]
        self.start = np.array(self.baseline.model_theta)
        self.healthy = self.expectation.mean_path(self.start, self.plant)[self.evaluated]
        covariance = np.mean([each.S for each in e], axis=0)[self.evaluated] + self.baseline.covariance_array()
        self.covariance = covariance[len(covariance) // 2 :].mean(axis=0)
        self.whitening_matrices = whiten(covariance, np.broadcast_to(np.eye(len(self.start)), covariance.shape))
        expected = self.healthy + (self.tuning.theta - self.start)
        deviations = np.array([each.theta[self.evaluated] for each in e]) - expected + errors[:, None, :]
        self.errors = np.einsum("kij,rkj->rki", self.whitening_matrices, deviations)

    def _prepare_cusums(self, recordings: Sequence[Recording], errors: FloatArray) -> None:
        """Prepare the CUSUMs: what they listen for, their limits, and the residual of a healthy loop."""
        watch = cusum_constants(self.baseline, self.pipeline, self.expectation)
        self.limits = watch.limits if watch is not None else np.zeros(0)
        if watch is None or self.baseline.loudest is None:
            return
        g = self.expectation.regression(self.plant)
        self.ok = g.ok
        self.whitening = residual_noise_model(self.pipeline, self.plant, self.baseline.loudest)
        scale = np.pad(self.tuning.scale, (0, LAGS), mode="edge")
        self.cusum_shifts = np.ascontiguousarray(
            (watch.changes / scale) @ lagged_columns(self.whitening.whiten(g.phi[g.ok])).T
        )
        self.cusum_shifts[:, : watch.warm] = 0.0
        self.healthy_residual = self.whitening.whiten((g.eta - g.phi @ self.theta)[g.ok])
        self.onset_update = int(np.searchsorted(np.flatnonzero(g.ok), self.onset))
        noisy = [self.pipeline.regression(rec.r, rec.u, rec.y, rec.restart) for rec in recordings]
        nudged = [self.plant.with_ratios({name: float(np.exp(STEP))}) for name in self.plant.parameters]
        drift = np.array([self._shift(self.expectation.regression(each)) for each in nudged]) / STEP
        self.residuals = np.array([self._shift(each) for each in noisy]) + errors @ drift

    def _shift(self, g: Regression) -> FloatArray:
        """Return what a noise-free regression has beyond the healthy one, whitened, update by update."""
        white = self.whitening.whiten((g.eta - g.phi @ self.theta)[self.ok])
        return np.ascontiguousarray(white - self.healthy_residual)


def detectability_radius(
    alarms: AlarmSimulator, fault: Fault, up: bool, progress: Callable[[], None] = lambda: None
) -> float:
    """Return the detectability radius: the smallest size that is announced in time with 90 % probability.

    As a logarithm (positive); infinite where the whole range is too small.
    """
    scene = alarms.scene
    (low,), (high,) = log_ratio_bounds([fault])
    sign, end = (1.0, float(high)) if up else (-1.0, float(-low))

    def seen(x: float) -> bool:
        progress()
        try:
            return alarms.delays(fault, sign * x).probability() >= POWER
        except SimulationError:  # nobody could have recorded it
            return True

    if not seen(end):
        return np.inf
    information = float(np.diag(fisher_matrix(scene, exact=False))[scene.names.index(fault.parameter)])
    x = min(np.sqrt(GUESS / max(information, 1e-300)), end)
    above = seen(x)
    while 1e-9 < x < end and seen(x / BRACKET if above else min(x * BRACKET, end)) == above:
        x = x / BRACKET if above else min(x * BRACKET, end)
    low_x, high_x = (x / BRACKET, x) if above else (x, min(x * BRACKET, end))
    while high_x / low_x > 1.0 + FINE:
        middle = float(np.sqrt(low_x * high_x))
        low_x, high_x = (low_x, middle) if seen(middle) else (middle, high_x)
    return float(high_x)
