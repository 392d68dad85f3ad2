"""The smallest change that is announced: the power of T^2 and of the sequential test under one reference."""

from __future__ import annotations

import numpy as np

from servoscope.baseline.expectation import Expectation, ReferencePath, residual_noise_model
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import SimulationError
from servoscope.design.fisher_information import fisher_matrix
from servoscope.design.scenario import Scenario
from servoscope.detection.baseline_run import cusum_constants
from servoscope.detection.cusum_design import OVERSHOOT, STEP
from servoscope.detection.statistic import POWER, whiten
from servoscope.estimation.filter_bank import nominal_theta
from servoscope.estimation.kernel.cusum import LAGS, lagged_columns
from servoscope.estimation.pipeline import Regression
from servoscope.isolation.ml.hypothesis import log_ratio_bounds
from servoscope.models.plants import Fault, Plant
from servoscope.simulation import simulate

MEMORIES = 5.0  # before the onset, after which an estimate has forgotten how it began
INDEPENDENT_MEMORIES = 2.0  # between two estimates that hardly have noise in common
NODES = 7  # of the Gaussian quadrature over the baseline's error
SEED = 77  # of the healthy recording whose excitation gives the covariance of the estimates
SIZE_TOLERANCE = 0.02  # relative precision of a size
FIRST_DISTANCE = 60.0  # squared distance from healthy with which a search begins
BRACKET = 1.3


class AlarmPower:
    """The probability that the tests of a baseline announce a change in time, from its mean effect on them."""

    def __init__(self, scene: Scenario) -> None:
        loop, baseline = scene.loop, scene.baseline
        self.scene, self.baseline, self.plant = scene, baseline, baseline.plant
        first = max(scene.onset - round(MEMORIES * loop.monitor.memory * loop.sample_rate), 0)
        r, self.onset = scene.r[first:], scene.onset - first
        self.pipeline = baseline.pipeline()
        kept = np.arange(len(r))
        self.expectation = Expectation(self.pipeline, baseline.tuning, scene.noise, ReferencePath(r, kept, kept == 0))
        self.theta, self.start = nominal_theta(loop, self.plant), np.array(baseline.healthy.theta)
        healthy = loop.model_copy(update={"plant": self.plant})
        u_std, y_std = scene.noise.u_std, scene.noise.y_std
        recording, _ = simulate(healthy, r, noise_u_std=u_std, noise_y_std=y_std, seed=SEED)
        estimates = self.pipeline.estimate(baseline.tuning, recording)
        self.evaluated = (estimates.updates > 0) & (estimates.index >= self.onset)
        covariance = estimates.S[self.evaluated] + baseline.covariance_array()
        self.whitening = whiten(covariance, np.broadcast_to(np.eye(len(self.start)), covariance.shape))
        self.healthy = self.expectation.mean_path(self.start, self.plant)[self.evaluated]
        self._prepare_cusums()

    def _prepare_cusums(self) -> None:
        """Prepare what the CUSUMs are designed for, shape (q, K), their limits, and what the baseline's error does."""
        watch = cusum_constants(self.baseline, self.pipeline, self.expectation)
        self.limits = watch.limits if watch is not None else np.zeros(0)
        if watch is None or self.baseline.healthy.loudest is None:
            return
        g = self.expectation.regression(self.plant)
        self.ok = g.ok
        self.noise_model = residual_noise_model(self.pipeline, self.plant, self.baseline.healthy.loudest)
        self.healthy_residual = self.noise_model.whiten((g.eta - g.phi @ self.theta)[g.ok])
        self.begin = max(int(np.searchsorted(np.flatnonzero(g.ok), self.onset)), watch.warm)
        columns = lagged_columns(self.noise_model.whiten(g.phi[g.ok]))
        scale = np.pad(self.baseline.tuning.scale, (0, LAGS), mode="edge")
        self.designed = (watch.changes / scale @ columns.T)[:, self.begin :]
        C = np.array(self.baseline.healthy.covariance)
        nudged = [
            self.plant.with_ratios({name: float(np.exp(STEP))}) for name in self.plant.physical_parameters[: len(C)]
        ]
        drift = np.array([self._shift(self.expectation.regression(plant)) for plant in nudged]) / STEP
        q = self.designed @ drift.T if len(C) else np.zeros((len(self.limits), 0))
        self.error_std = np.sqrt(np.einsum("qi,ij,qj->q", q, C, q)) if len(C) else np.zeros(len(self.limits))

    def _shift(self, g: Regression) -> FloatArray:
        """Return what a noise-free regression adds to the whitened residual from the onset on, update by update."""
        white = self.noise_model.whiten((g.eta - g.phi @ self.theta)[self.ok])
        return np.asarray(white - self.healthy_residual)[self.begin :]

    def probability(self, fault: Fault, x: float) -> float:
        """Return the probability that a fault whose logarithm of the ratio is x is announced in time."""
        faulty = self.plant.with_ratios({fault.parameter: float(np.exp(x))})
        return max(self._statistic_power(faulty), self._sequential_power(faulty))

    def _statistic_power(self, faulty: Plant) -> float:
        """Return the power of T^2, at evaluations so far apart that their noise is independent."""
        from scipy.special import chndtr

        path = self.expectation.mean_path(self.start, self.plant, faulty, self.onset)[self.evaluated] - self.healthy
        distance = (np.einsum("kij,kj->ki", self.whitening, path) ** 2).sum(axis=1)
        every = max(round(INDEPENDENT_MEMORIES * self.pipeline.memory_samples / self.pipeline.every), 1)
        missed = chndtr(self.baseline.thresholds.statistic, path.shape[1], distance[::-1][::every])
        return 1.0 - float(np.prod(missed))

    def _sequential_power(self, faulty: Plant) -> float:
        """Return the power of the best CUSUM.

        Its sum is Brownian motion with drift in the time that its own variance counts, which passes a limit h with
        Phi((M - h)/s) + exp(2 h M / s^2) Phi(-(M + h)/s), M and s^2 the mean and variance of the whole sum (Siegmund,
        1985, chapter 3). The error of the baseline moves M.
        """
        from scipy.special import log_ndtr

        if not len(self.limits):
            return 0.0
        shift = self._shift(self.expectation.regression(self.plant, faulty, self.onset))
        variance = np.maximum((self.designed**2).sum(axis=1), 1e-300)
        mean = self.designed @ shift - 0.5 * variance
        steps = max(self.designed.shape[1] // self.pipeline.cusum_updates, 1)
        h = (self.limits + OVERSHOOT * np.sqrt(variance / steps))[:, None]
        nodes, weights = np.polynomial.hermite_e.hermegauss(NODES)
        M, s = mean[:, None] + self.error_std[:, None] * nodes, np.sqrt(variance)[:, None]
        reflected = np.exp(np.minimum(2.0 * h * M / s**2 + log_ndtr(-(M + h) / s), 0.0))
        crossing = np.minimum(np.exp(log_ndtr((M - h) / s)) + reflected, 1.0)
        return float((crossing @ weights / weights.sum()).max())


def detectable_size(power: AlarmPower, fault: Fault, up: bool) -> float:
    """Return the smallest size that is announced in time with 90 % probability.

    As a logarithm (positive); infinite where the whole range is too small.
    """
    (low,), (high,) = log_ratio_bounds([fault])
    sign, end = (1.0, float(high)) if up else (-1.0, float(-low))

    def is_seen(x: float) -> bool:
        try:
            return power.probability(fault, sign * x) >= POWER
        except SimulationError:  # nobody could have recorded it
            return True

    if not is_seen(end):
        return np.inf
    scene = power.scene
    information = float(np.diag(fisher_matrix(scene, exact=False))[scene.names.index(fault.parameter)])
    x = min(np.sqrt(FIRST_DISTANCE / max(information, 1e-300)), end)
    above = is_seen(x)
    while 1e-9 < x < end and is_seen(x / BRACKET if above else min(x * BRACKET, end)) == above:
        x = x / BRACKET if above else min(x * BRACKET, end)
    low_x, high_x = (x / BRACKET, x) if above else (x, min(x * BRACKET, end))
    while high_x / low_x > 1.0 + SIZE_TOLERANCE:
        middle = float(np.sqrt(low_x * high_x))
        low_x, high_x = (low_x, middle) if is_seen(middle) else (middle, high_x)
    return float(high_x)
