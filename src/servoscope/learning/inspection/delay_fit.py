"""The delay between u as logged and u acting, by the likelihood of y: noise in the regressors cannot fake it.

Given y, an exact controller makes u carry nothing more, so the likelihood of y given the logged u is the joint one, in
closed loop too, and no controller is needed: ``x+ = A x + b_now (u[k-m] + n_u) + b_late (u[k-m-1] + n_u),
y = c x + n_y`` with white n_u and n_y (Ljung, 1999, section 13.4). The delay is free, with the logarithms of the
plant's parameters and of the ratio of the noises; the level of the noise is concentrated out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray, IndexArray
from servoscope.estimation.filter_bank import filter_cutoff
from servoscope.estimation.noise_model import WhiteNoise, largest_autocorrelation
from servoscope.estimation.tuning import sum_covariance
from servoscope.isolation.ml.predictor import MAX_GAIN_SAMPLES, PredictorFactory
from servoscope.isolation.ml.window import plant_input
from servoscope.learning.inspection.delay import MAX_DELAY_S, MIN_MAX_DELAY_SAMPLES
from servoscope.learning.inspection.model_order import Regressors, fit_regression
from servoscope.models.discretise import split_delay
from servoscope.models.loop import Loop
from servoscope.models.lti import settling_samples
from servoscope.models.plants import Column, Plant
from servoscope.signals import Recording

PRIOR = 0.3  # standard deviation of the logarithm of a parameter that the loop file gives
# and of a coefficient that least squares found: noise in its regressors may have made it a tenth
COEFFICIENT_LOG_STD = 3.0
NOISE_PRIOR = 3.0  # of the logarithm of the ratio of the noises
START_NOISE_SHARE = 1e-3  # noise on u, of its standard deviation, at which the search begins
MIN_NOISE_SHARE = 1e-9  # noise on y, of its standard deviation: what is quieter was simulated without any
MAX_SAMPLES = 60_000  # samples that are looked at
MIN_SAMPLES = 200  # usable samples
# samples, delays at which a search begins; from one that is further off it may end with another plant
TRIALS = (0, 0.25, 0.5, 0.75, 1, 1.5, 2, 2.5, 3, 3.5, 4, 5, 6, 8, 11, 16, 22, 32, 45, 64, 90)
SCAN_STEPS, STEPS = 2, 60  # of Gauss and Newton
MAX_STEP = 0.5  # of a logarithm, and samples of delay
MAX_COST_GAP = 0.1  # of -2 log likelihood per sample, within which a second delay is looked at closely
COST_TOLERANCE = 1e-2  # of -2 log likelihood
DIFFERENCE = 1e-5  # of a logarithm, for derivatives
DIFFERENCE_DELAY = 1e-3  # samples
MIN_CERTAIN_LOG_RATIO = 16.0  # twice the logarithm of a likelihood ratio, and
MIN_CERTAIN_STDS = 4.0  # standard deviations, above which a delay is certain
MAX_WHITE_AUTOCORRELATION = 0.1  # largest autocorrelation of innovations that are called white
LAGS = 20
MAX_DAMPING = 1e6  # damping at which a search gives up


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
        return self.largest_autocorrelation < MAX_WHITE_AUTOCORRELATION

    @property
    def significant(self) -> bool:
        """Whether the configured delay is certainly wrong."""
        off = abs(self.seconds - self.search.loop.delay)
        return self.ratio > MIN_CERTAIN_LOG_RATIO and off > MIN_CERTAIN_STDS * self.std_s

    def improves(self, delay_s: float) -> bool:
        """Return whether a delay, as it would be written into the loop file, is likelier than the configured one."""
        return self.search.cost_at(delay_s) < self.search.cost_at(self.search.loop.delay)


@dataclass(frozen=True)
class _Point:
    """A place of the search: parameters z, its residual and -2 log likelihood."""

    z: FloatArray
    residual: FloatArray
    cost: float


def fit_delay(loop: Loop, recording: Recording, regressors: Regressors | None = None) -> DelayFit | None:
    """Find the likeliest delay; None where the predictor cannot be written down or says nothing.

    That is so where the plant has friction or is not linear, where the input is not held, and where neither the loop
    file nor least squares on `regressors` give a plant to begin with.
    """
    begin = _initial_plant(loop, regressors)
    if begin is None or loop.hold != "zoh":
        return None
    search = DelaySearch.from_recording(loop, recording, *begin)
    return search.run() if search is not None else None


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
    block = settling_samples(filter_cutoff(loop), g.bank.n, 1.0 / loop.sample_rate)
    fit = fit_regression(g.bank.names, g.eta, g.phi, g.ok, block)
    if fit is None:
        return None
    coefficients = {name: float(value) for name, value in zip(g.bank.names, fit.theta, strict=True)}
    if any(not value > 0.0 for name, value in coefficients.items() if name != "offset"):
        return None
    return plant.model_copy(update={"coefficients": coefficients}), COEFFICIENT_LOG_STD


@dataclass(frozen=True, eq=False)
class DelaySearch:
    """One recording, the plant to begin with, and the rows that all delays have in common."""

    loop: Loop
    plant: Plant
    names: tuple[str, ...]  # parameters of the plant that are free
    factory: PredictorFactory  # noise in it: the level from which the search begins
    u: FloatArray  # what acted, but for the delay
    rows: IndexArray  # samples that are predicted, none of whose inputs lies before its run, shape (N,)
    y: FloatArray  # shape (N,)
    restart: BoolArray  # shape (N,)
    latest: int  # samples
    spread: FloatArray  # standard deviations of the priors, shape (m,)
    offset: float  # unit of the constant that is taken off u; 0: none
    nulls: dict[float, float] = field(default_factory=dict)
    starts: list[FloatArray] = field(default_factory=list)

    @classmethod
    def from_recording(cls, loop: Loop, recording: Recording, plant: Plant, spread: float) -> DelaySearch | None:
        """Prepare the search; None where too few samples are left."""
        rate, end = loop.sample_rate, min(recording.samples, MAX_SAMPLES)
        configured = math.ceil(loop.delay * rate)
        latest = max(MIN_MAX_DELAY_SAMPLES, math.ceil(MAX_DELAY_S * rate), configured + 4)
        u = plant_input(loop, recording.u)[:end]
        restart = recording.restart[:end].copy()
        restart[0] = True
        at = np.arange(end)
        begin = np.maximum.accumulate(np.where(restart, at, 0))
        rows = np.flatnonzero(at - begin > latest)
        y_std = _white_noise_std(recording.y[:end], restart)
        if len(rows) < MIN_SAMPLES or not y_std > 0.0:
            return None
        names = (*(p for p in plant.parameters if p != "input_gain"), *plant.causes)
        names = tuple(name for name in names if name != "offset")
        offset = float(u.std()) if Column.CONSTANT in plant.extras else 0.0
        base = loop.model_copy(update={"plant": plant, "delay": 0.0})
        noise = WhiteNoise(u_std=START_NOISE_SHARE * float(u.std()), y_std=y_std)
        factory = PredictorFactory.from_input(base, noise, recording.u)
        prior = [spread] * len(names) + [NOISE_PRIOR] + [1.0] * bool(offset)
        first = np.diff(rows, prepend=-2) != 1
        return cls(loop, plant, names, factory, u, rows, recording.y[rows], first, latest, np.array(prior), offset)

    def run(self) -> DelayFit | None:
        """Search from many delays, each from the loop file, and compare the best with the configured one."""
        rate, configured = self.loop.sample_rate, self.loop.delay * self.loop.sample_rate
        nothing = np.zeros(len(self.spread))
        trials = sorted({configured, *(float(k) for k in TRIALS if k <= self.latest)})
        with np.errstate(all="ignore"):
            scanned = [self._fit(np.append(nothing, k), SCAN_STEPS, held=True) for k in trials]
            scanned.sort(key=lambda end: end.cost)
            near = [end for end in scanned[:2] if end.cost <= scanned[0].cost + MAX_COST_GAP * len(self.y)]
            ends = [self._search_freely(end) for end in near or scanned[:1]]
            best = min(ends, key=lambda end: end.cost)
            if not np.isfinite(best.cost):
                return None
            self.starts.append(best.z)
            null = self.cost_at(self.loop.delay)
            std, inflation = self._delay_std(best)
            if best.cost > null:  # the search was stuck where the configured delay is not
                best = self._fit(np.append(best.z[:-1], configured), STEPS, held=False)
        if not np.isfinite(std):
            return None
        return DelayFit(
            seconds=float(best.z[-1]) / rate,
            std_s=std * math.sqrt(inflation) / rate,
            ratio=max(null - best.cost, 0.0) / inflation,
            largest_autocorrelation=largest_autocorrelation(best.residual, LAGS),
            search=self,
        )

    def cost_at(self, delay_s: float) -> float:
        """Return the smallest -2 log likelihood at a delay, started from the free optimum and from the loop file."""
        samples = delay_s * self.loop.sample_rate
        if samples not in self.nulls:
            starts = [*(z[:-1] for z in self.starts), np.zeros(len(self.spread))]
            with np.errstate(all="ignore"):
                self.nulls[samples] = min(self._fit(np.append(z, samples), STEPS, held=True).cost for z in starts)
        return self.nulls[samples]

    def residual(self, z: FloatArray) -> FloatArray:
        """Return innovations whose sum of squares ranks as the likelihood does, the noise's level being free."""
        m = len(self.names)
        plant = self.plant.scaled(dict(zip(self.names, np.exp(z[:m]).tolist(), strict=True)))
        noise = self.factory.noise
        heard = WhiteNoise(u_std=noise.u_std * float(np.exp(z[m])), y_std=noise.y_std)
        rate = self.loop.sample_rate
        whole, rest = split_delay(float(z[-1]) / rate, rate)
        u = self.u[self.rows - whole]
        if self.offset:
            u = u - self._nominal_offset - z[m + 1] * self.offset
        predictor = self.factory.predictor(plant, later_s=rest / rate, noise=heard)
        e = np.asarray(predictor.innovations(0, 0, u, self.y, self.restart), dtype=np.float64)
        # a predictor takes the input before a restart to be that at it; here it is known, and the likelihood would
        # jump at whole samples of delay without it
        missed = np.where(self.restart, self.u[self.rows - whole - 1] - self.u[self.rows - whole], 0.0)
        late = predictor._replace(b=predictor.b_late, b_late=np.zeros_like(predictor.b_late))
        e += np.asarray(late.innovations(0, 0, missed, np.zeros_like(self.y), self.restart), dtype=np.float64)
        log_S = np.log(predictor.S[0])
        return np.asarray(e * np.exp(0.5 * log_S[self.age].mean()))

    @cached_property
    def age(self) -> IndexArray:
        """Samples since a restart, as far as the gains change with them, shape (N,)."""
        at = np.arange(len(self.y))
        return np.minimum(at - np.maximum.accumulate(np.where(self.restart, at, 0)), MAX_GAIN_SAMPLES - 1)

    @property
    def _nominal_offset(self) -> float:
        nominal = dict(zip(self.plant.names, self.plant.theta(), strict=True)) if self.plant.has_physics else {}
        return float(nominal.get("offset", 0.0)) / self.plant.input_gain

    def _point(self, z: FloatArray) -> _Point:
        if not np.isfinite(z).all():  # LAPACK would say so on the terminal
            return _Point(z, np.zeros(0), np.inf)
        try:
            e = self.residual(z)
        except (ValueError, np.linalg.LinAlgError):
            return _Point(z, np.zeros(0), np.inf)
        squares = float(e @ e)
        if not np.isfinite(squares) or not squares > 0.0:
            return _Point(z, e, np.inf)
        return _Point(z, e, len(e) * math.log(squares) + float(((z[:-1] / self.spread) ** 2).sum()))

    def _jacobian(self, at: _Point, held: bool) -> FloatArray:
        columns = []
        for i in range(len(at.z) - held):
            step = DIFFERENCE if i < len(at.z) - 1 else DIFFERENCE_DELAY
            if i == len(at.z) - 1 and at.z[-1] + step > self.latest:
                step = -step
            moved = at.z.copy()
            moved[i] += step
            columns.append((self.residual(moved) - at.residual) / step)
        return np.array(columns).T

    def _normal(self, at: _Point, J: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return gradient and Gauss-Newton matrix of half of -2 log likelihood."""
        weight = len(at.residual) / float(at.residual @ at.residual)
        k = J.shape[1]
        prior = np.zeros(k)
        prior[: len(self.spread)] = self.spread**-2.0
        return weight * (J.T @ at.residual) + prior * at.z[:k], weight * (J.T @ J) + np.diag(prior)

    def _fit(self, z: FloatArray, steps: int, held: bool) -> _Point:
        """Minimise by Levenberg and Marquardt, the delay held or free."""
        at, damping = self._point(np.asarray(z, dtype=np.float64)), 1e-3
        for _ in range(steps):
            if not np.isfinite(at.cost):
                break
            g, H = self._normal(at, self._jacobian(at, held))
            if not held and ((at.z[-1] <= 0.0 and g[-1] > 0.0) or (at.z[-1] >= self.latest and g[-1] < 0.0)):
                g, H = g[:-1], H[:-1, :-1]  # at its bound, and held there
            after = at
            while damping < MAX_DAMPING:
                step = np.linalg.solve(H + damping * np.diag(np.diag(H)), -g)
                z = at.z.copy()
                z[: len(step)] += np.clip(step, -MAX_STEP, MAX_STEP)
                z[-1] = min(max(z[-1], 0.0), self.latest)
                after = self._point(z)
                if after.cost < at.cost:
                    damping = max(damping / 10.0, 1e-9)
                    break
                damping *= 10.0
                after = at
            gained, at = at.cost - after.cost, after
            if gained < COST_TOLERANCE:
                break
        return at

    def _search_freely(self, start: _Point) -> _Point:
        """Minimise with the delay free, and once more from the whole sample beside it where that leaves a colour.

        The innovations bend where the delay passes a whole sample, and a search may be stuck beside the bend.
        """
        end = self._fit(start.z, STEPS, held=False)
        if not np.isfinite(end.cost) or largest_autocorrelation(end.residual, LAGS) < MAX_WHITE_AUTOCORRELATION:
            return end
        whole = self._fit(np.append(end.z[:-1], round(end.z[-1])), STEPS, held=True)
        return min(end, self._fit(whole.z, STEPS, held=False), key=lambda each: each.cost)

    def _delay_std(self, at: _Point) -> tuple[float, float]:
        """Return the standard deviation of the delay [samples], and by how much correlation inflates its variance.

        What counts is the score of the delay, the others projected out.
        """
        J = self._jacobian(at, held=False)
        _, H = self._normal(at, J)
        C = np.linalg.pinv(H)
        own = J @ C[:, -1] / C[-1, -1]
        weight = len(at.residual) / float(at.residual @ at.residual)
        score = own * at.residual * weight
        naive, robust = weight * float(own @ own), float(sum_covariance(score[:, None], LAGS)[0, 0])
        return math.sqrt(max(float(C[-1, -1]), 0.0)) or math.inf, max(robust / max(naive, 1e-300), 1.0)


def _white_noise_std(y: FloatArray, restart: BoolArray) -> float:
    """Return a first guess of the noise of y, from what its second differences jump by."""
    jumps = np.diff(y, 2)[~restart[2:]]
    guess = float(np.median(np.abs(jumps))) / (0.6745 * math.sqrt(6.0)) if jumps.size else 0.0
    return max(guess, MIN_NOISE_SHARE * float(y.std()))
