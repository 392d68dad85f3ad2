"""The delay between u as logged and u acting, by the likelihood of y: noise in the regressors cannot fake it.

The delay is free with the logarithms of the plant's parameters and of the ratio of the noises.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.estimation.noise_model import WhiteNoise, largest_autocorrelation
from servoscope.fit.plant_experiment import (
    LAGS,
    MAX_AUTOCORRELATION,
    MAX_SAMPLES,
    PlantExperiment,
    robust_covariance,
)
from servoscope.fit.search import MAX_STEPS, Fit, fit
from servoscope.learning.inspection.delay import MAX_DELAY_S, MIN_MAX_DELAY_SAMPLES, PRIOR
from servoscope.learning.inspection.model_order import Regressors, fit_regression
from servoscope.models.loop import Loop
from servoscope.models.lti import settling_samples
from servoscope.models.plants import Plant
from servoscope.signals import Recording
from servoscope.signals.quantisation import white_noise_std

# standard deviation of the logarithm of a coefficient that least squares found: noise in the regressors may have made
# it a tenth
COEFFICIENT_LOG_STD = 3.0
START_NOISE_SHARE = 1e-3  # noise on u, of its standard deviation, at which the search begins
MIN_NOISE_SHARE = 1e-9  # noise on y, of its standard deviation: what is quieter was simulated without any
MIN_DELAYS_BEYOND = 4  # samples beyond the configured delay that are tried at least
MIN_SAMPLES = 200  # usable samples
# samples, delays at which a search begins; from one that is further off it may end with another plant
TRIALS = (0, 0.25, 0.5, 0.75, 1, 1.5, 2, 2.5, 3, 3.5, 4, 5, 6, 8, 11, 16, 22, 32, 45, 64, 90)
SCAN_STEPS = 2  # of a search from each of them
MAX_COST_GAP = 0.1  # of -2 log likelihood per sample, within which a second delay is looked at closely
COST_TOLERANCE = 1e-2  # of -2 log likelihood
MIN_CERTAIN_LOG_RATIO = 16.0  # twice the logarithm of a likelihood ratio, and
MIN_CERTAIN_STDS = 4.0  # standard deviations, above which a delay is certain


@dataclass(frozen=True)
class DelayFit:
    """The likeliest delay beside the one of the loop file."""

    seconds: float
    std_s: float  # standard deviation, inflated by what the innovations are correlated
    ratio: float  # twice the logarithm of the likelihood ratio to the configured delay, deflated likewise
    largest_autocorrelation: float  # of the innovations at the likeliest delay, up to `LAGS`
    search: DelaySearch = field(repr=False)

    @property
    def white(self) -> bool:
        """Whether plant, noise and delay leave nothing but noise."""
        return self.largest_autocorrelation < MAX_AUTOCORRELATION

    @property
    def significant(self) -> bool:
        """Whether the configured delay is certainly wrong."""
        off = abs(self.seconds - self.search.loop.delay)
        return self.ratio > MIN_CERTAIN_LOG_RATIO and off > MIN_CERTAIN_STDS * self.std_s

    def improves(self, delay_s: float) -> bool:
        """Return whether a delay, as it would be written into the loop file, is likelier than the configured one."""
        return self.search.cost_at(delay_s) < self.search.cost_at(self.search.loop.delay)


def fit_delay(loop: Loop, recording: Recording, regressors: Regressors | None = None) -> DelayFit | None:
    """Find the likeliest delay; None where the predictor cannot be written down or says nothing.

    That is so where the plant has friction or is not linear, where the input is not held, and where neither the loop
    file nor least squares on `regressors` give a plant to begin with.
    """
    begin = _initial_plant(loop, regressors)
    if begin is None or loop.hold != "zoh":
        return None
    search = DelaySearch.from_recording(loop, recording, *begin)
    try:
        return search.run() if search is not None else None
    except np.linalg.LinAlgError:  # numbers so large that they have no covariance
        return None


def _initial_plant(loop: Loop, regressors: Regressors | None) -> tuple[Plant, float] | None:
    """Return the plant that the search begins with, and the standard deviation of its logarithms."""
    plant = loop.plant
    if not plant.affine:
        return None
    if plant.has_physics:
        return plant, PRIOR
    if regressors is None or "coefficients" not in type(plant).model_fields:
        return None
    g = regressors
    block = settling_samples(loop.cutoff, g.bank.n, 1.0 / loop.sample_rate)
    fit = fit_regression(g.bank.names, g.eta, g.phi, g.ok, block)
    if fit is None:
        return None
    coefficients = {name: float(value) for name, value in zip(g.bank.names, fit.theta, strict=True)}
    if any(not value > 0.0 for name, value in coefficients.items() if name != "offset"):
        return None
    return plant.model_copy(update={"coefficients": coefficients}), COEFFICIENT_LOG_STD


@dataclass(frozen=True, eq=False)
class DelaySearch:
    """One recording, whose delay is free or held."""

    loop: Loop
    recorded: PlantExperiment
    nulls: dict[float, float] = field(default_factory=dict)
    starts: list[FloatArray] = field(default_factory=list)

    @classmethod
    def from_recording(cls, loop: Loop, recording: Recording, plant: Plant, spread: float) -> DelaySearch | None:
        """Prepare the search; None where too few samples are left."""
        rate, head = loop.sample_rate, slice(0, min(recording.samples, MAX_SAMPLES))
        latest = max(
            MIN_MAX_DELAY_SAMPLES, math.ceil(MAX_DELAY_S * rate), math.ceil(loop.delay * rate) + MIN_DELAYS_BEYOND
        )
        names = (*(p for p in plant.parameters if p != "input_gain"), *plant.causes)
        names = tuple(name for name in names if name != "offset")
        y = recording.y[head]
        y_std = max(white_noise_std(y, recording.restart[head]), MIN_NOISE_SHARE * float(y.std()))
        noise = WhiteNoise(u_std=START_NOISE_SHARE * float(recording.u[head].std()), y_std=y_std)
        prior = np.full(len(names), spread)
        recorded = PlantExperiment.from_recordings(loop, [recording], plant, names, prior, noise, latest)
        return cls(loop, recorded) if len(recorded.rows) >= MIN_SAMPLES and y_std > 0.0 else None

    def run(self) -> DelayFit | None:
        """Search from many delays, each from the loop file, and compare the best with the configured one."""
        rate, configured = self.loop.sample_rate, self.loop.delay * self.loop.sample_rate
        recorded = self.recorded
        trials = sorted({configured, *(float(k) for k in TRIALS if k <= recorded.latest)})
        with np.errstate(all="ignore"):
            scanned = [self._fit(recorded.start(delay=k), held=True, steps=SCAN_STEPS) for k in trials]
            scanned.sort(key=lambda end: end.cost)
            least = scanned[0].cost + MAX_COST_GAP * len(recorded.y)
            ends = [self._search_freely(end.x) for end in scanned[:2] if end.cost <= least]
            best = min(ends, key=lambda end: end.cost, default=scanned[0])
            if not np.isfinite(best.cost):
                return None
            self.starts.append(best.x)
            null = self.cost_at(self.loop.delay)
            variance = max(float(best.covariance[-1, -1]), 0.0) or math.inf
            inflation = float(robust_covariance(best)[-1, -1]) / variance
            if best.cost > null:  # the search was stuck where the configured delay is not
                best = self._fit(np.append(best.x[:-1], configured), held=False)
        if not np.isfinite(variance):
            return None
        return DelayFit(
            seconds=float(best.x[-1]) / rate,
            std_s=math.sqrt(variance * inflation) / rate,
            ratio=max(null - best.cost, 0.0) / inflation,
            largest_autocorrelation=largest_autocorrelation(best.residual, LAGS),
            search=self,
        )

    def cost_at(self, delay_s: float) -> float:
        """Return the smallest -2 log likelihood at a delay, started from the free optimum and from the loop file."""
        samples = delay_s * self.loop.sample_rate
        if samples not in self.nulls:
            starts = [*(np.append(x[:-1], samples) for x in self.starts), self.recorded.start(delay=samples)]
            with np.errstate(all="ignore"):
                self.nulls[samples] = min(self._fit(x, held=True).cost for x in starts)
        return self.nulls[samples]

    def _fit(self, x: FloatArray, held: bool, steps: int = MAX_STEPS) -> Fit:
        free = self.recorded.all_but_delay if held else None
        return fit(self.recorded.search, x, free, steps, COST_TOLERANCE)

    def _search_freely(self, start: FloatArray) -> Fit:
        """Minimise with the delay free, and once more from the whole sample beside it where that leaves a colour.

        The innovations bend where the delay passes a whole sample, and a search may be stuck beside the bend.
        """
        end = self._fit(start, held=False)
        if not np.isfinite(end.cost) or largest_autocorrelation(end.residual, LAGS) < MAX_AUTOCORRELATION:
            return end
        whole = self._fit(np.append(end.x[:-1], round(end.x[-1])), held=True)
        return min(end, self._fit(whole.x, held=False), key=lambda fitted: fitted.cost)
