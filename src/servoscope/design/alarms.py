"""When the monitor would alarm: both tests on the change as it comes through the loop, and on simulated noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from servoscope.cusum import LAGS, columns
from servoscope.design.information import fisher
from servoscope.design.scene import Scene
from servoscope.detection import POWER, delayed, whiten
from servoscope.errors import SimulationError
from servoscope.identification import fault_directions
from servoscope.inverse import nominal_theta
from servoscope.pipeline import Regression
from servoscope.plants import Fault, FloatArray
from servoscope.recording import Recording
from servoscope.refinement.hypotheses import bounds
from servoscope.sequential import STEP
from servoscope.signatures import Course, Expectation, colour_of
from servoscope.simulation import simulate

RUNS = 120  # healthy recordings that are simulated, each with an error of the baseline
MEMORIES = 5.0  # before the onset, after which an estimate has forgotten how it began
SEED = 77
HOPELESS = 6.0  # standard deviations by which a CUSUM misses its limit on average
FINE = 0.02  # relative precision of a radius
GUESS = 60.0  # squared distance from healthy with which a search begins
BRACKET = 1.3
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Delays:
    """Times from onset to alarm [s], infinite where there is none in time: one per realisation, (M,)."""

    times: FloatArray

    def probability(self, within_s: float = np.inf) -> float:
        """Return the probability of an alarm within some seconds."""
        return float(np.mean((self.times <= within_s) & np.isfinite(self.times)))

    def quantile(self, share: float) -> float:
        """Return the time by which a share of all changes is announced [s]; may be infinite."""
        return float(np.sort(self.times)[int(np.ceil(share * len(self.times) - 1e-9)) - 1])


class Alarms:
    """Both tests of a baseline under one reference, beside realisations of their noise and of the baseline's error."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self.baseline = scene, scene.baseline
        loop, self.plant = scene.loop, self.baseline.plant
        rate = loop.sample_rate
        first = max(scene.onset - round(MEMORIES * loop.monitor.memory * rate), 0)
        self.r, self.since = scene.r[first:], scene.onset - first
        self.pipeline, self.tuning, self.noise = self.baseline.pipeline(), self.baseline.tuning, scene.noise
        kept = np.arange(len(self.r))
        self.expectation = Expectation(self.pipeline, self.tuning, self.noise, Course(self.r, kept, kept == 0))
        self.rng, self.theta = np.random.default_rng(SEED), nominal_theta(loop, self.plant)
        healthy, (u_std, y_std) = loop.model_copy(update={"plant": self.plant}), (self.noise.u_std, self.noise.y_std)
        recordings = [
            simulate(healthy, self.r, noise_u_std=u_std, noise_y_std=y_std, seed=SEED + i)[0] for i in range(RUNS)
        ]
        parameters, coefficients = self._errors_of_baseline()
        self._statistic(recordings, coefficients)
        self._sequential(recordings, parameters)

    def delays(self, fault: Fault, x: float) -> Delays:
        """Return when a fault is announced whose logarithm of the ratio is x.

        Raises
        ------
        SimulationError
            If the loop is unstable with it.
        """
        from servoscope.design.kernels import crossings

        ill = self.plant.with_ratios({fault.parameter: float(np.exp(x))})
        rate, every = self.scene.loop.sample_rate, self.pipeline.every
        path = self.expectation.path(self.start, self.plant, ill, self.since)[self.looks] - self.healthy
        T2 = ((self.errors + np.einsum("kij,kj->ki", self.white, path)) ** 2).sum(axis=-1)
        on = self.pipeline.delays[0]
        alarm = np.array([delayed(over, on, 0) for over in self.baseline.limit < T2])
        late = np.where(alarm.any(axis=1), (self.index[alarm.argmax(axis=1)] - self.since + 1) / rate, np.inf)
        if not len(self.limits):
            return Delays(late)
        shift = self._shift(self.expectation.regression(self.plant, ill, self.since))
        chosen = self._worth_hearing(shift)
        updates = crossings(shift, self.residuals, self.heard[chosen], self.limits[chosen], self.updates_since)
        evaluations = np.ceil(updates * self.pipeline.stride / every) + on
        return Delays(np.minimum(late, evaluations * every / rate))

    def _worth_hearing(self, shift: FloatArray) -> BoolArray:
        """Return which CUSUMs have a chance to reach their limits, shape (q,)."""
        s = self.heard[:, self.updates_since :]
        drift = np.cumsum(s * (shift[self.updates_since :] - 0.5 * s), axis=1)
        reach = (drift + HOPELESS * np.sqrt(np.cumsum(s**2, axis=1))).max(axis=1)
        return np.asarray(reach >= self.limits)

    def _errors_of_baseline(self) -> tuple[FloatArray, FloatArray]:
        """Draw errors of the healthy parameters, (M, m), and of the coefficients that they lead to, (M, n)."""
        C = np.array(self.baseline.ratios_covariance)
        if len(C) and self.baseline.members:  # both tests err together
            error = self.rng.standard_normal((RUNS, len(C))) @ np.linalg.cholesky(C).T
            directions = fault_directions(self.scene.loop, self.plant, self.theta)
            return error, error @ np.array([directions[name] for name in self.plant.parameters])
        C = self.baseline.cov()
        size = np.sqrt(np.maximum(np.diag(C), 1e-300))
        value, vector = np.linalg.eigh(C / np.outer(size, size))
        root = size[:, None] * vector * np.sqrt(np.maximum(value, 0.0))
        return np.zeros((RUNS, 0)), self.rng.standard_normal((RUNS, len(C))) @ root.T

    def _statistic(self, recordings: Sequence[Recording], errors: FloatArray) -> None:
        """Prepare T^2: deviations of healthy recordings, whitened with what the baseline thinks of them."""
        e = [self.pipeline.estimate(self.tuning, recording) for recording in recordings]
        self.looks = (e[0].updates > 0) & (e[0].index >= self.since)
        self.index = e[0].index[self.looks]
        self.start = np.array(self.baseline.model_theta)
        self.healthy = self.expectation.path(self.start, self.plant)[self.looks]
        covariance = np.mean([each.S for each in e], axis=0)[self.looks] + self.baseline.cov()
        self.covariance = covariance[len(covariance) // 2 :].mean(axis=0)
        self.white = whiten(covariance, np.broadcast_to(np.eye(len(self.start)), covariance.shape))
        expected = self.healthy + (self.tuning.theta - self.start)
        deviations = np.array([each.theta[self.looks] for each in e]) - expected + errors[:, None, :]
        self.errors = np.einsum("kij,rkj->rki", self.white, deviations)

    def _sequential(self, recordings: Sequence[Recording], errors: FloatArray) -> None:
        """Prepare the CUSUMs: what they listen for, their limits, and the residual of a healthy loop."""
        watch = self.baseline.watch(self.pipeline, self.expectation)
        self.limits = watch.limits if watch is not None else np.zeros(0)
        if watch is None or self.baseline.loudest is None:
            return
        g = self.expectation.regression(self.plant)
        self.ok = g.ok
        self.whitening = colour_of(self.pipeline, self.plant, self.baseline.loudest)
        scale = np.pad(self.tuning.scale, (0, LAGS), mode="edge")
        self.heard = np.ascontiguousarray((watch.changes / scale) @ columns(self.whitening.whiten(g.phi[g.ok])).T)
        self.heard[:, : watch.warm] = 0.0
        self.quiet = self.whitening.whiten((g.eta - g.phi @ self.theta)[g.ok])
        self.updates_since = int(np.searchsorted(np.flatnonzero(g.ok), self.since))
        noisy = [self.pipeline.regression(rec.r, rec.u, rec.y, rec.restart) for rec in recordings]
        nudged = [self.plant.with_ratios({name: float(np.exp(STEP))}) for name in self.plant.parameters]
        drift = np.array([self._shift(self.expectation.regression(each)) for each in nudged]) / STEP
        self.residuals = np.array([self._shift(each) for each in noisy]) + errors @ drift

    def _shift(self, g: Regression) -> FloatArray:
        """Return what a noise-free regression has beyond the healthy one, whitened, update by update."""
        white = self.whitening.whiten((g.eta - g.phi @ self.theta)[self.ok])
        return np.ascontiguousarray(white - self.quiet)


def detectable(alarms: Alarms, fault: Fault, up: bool, progress: Callable[[], None] = lambda: None) -> float:
    """Return the detectability radius: the smallest size that is announced in time with 90 % probability.

    As a logarithm (positive); infinite where the whole range is too small.
    """
    scene = alarms.scene
    (low,), (high,) = bounds([fault])
    sign, end = (1.0, float(high)) if up else (-1.0, float(-low))

    def seen(x: float) -> bool:
        progress()
        try:
            return alarms.delays(fault, sign * x).probability() >= POWER
        except SimulationError:  # nobody could have recorded it
            return True

    if not seen(end):
        return np.inf
    information = float(np.diag(fisher(scene, exact=False))[scene.names.index(fault.parameter)])
    x = min(np.sqrt(GUESS / max(information, 1e-300)), end)
    above = seen(x)
    while 1e-9 < x < end and seen(x / BRACKET if above else min(x * BRACKET, end)) == above:
        x = x / BRACKET if above else min(x * BRACKET, end)
    low_x, high_x = (x / BRACKET, x) if above else (x, min(x * BRACKET, end))
    while high_x / low_x > 1.0 + FINE:
        middle = float(np.sqrt(low_x * high_x))
        low_x, high_x = (low_x, middle) if seen(middle) else (middle, high_x)
    return float(high_x)
