"""Healthy recordings of a motor axis -> its coefficients, how much they scatter, and the noise of its filter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from servoscope.baseline.axis_model import AxisModel, AxisMoves
from servoscope.baseline.threshold import score_limit
from servoscope.core.arrays import BoolArray, FloatArray, IndexArray
from servoscope.core.errors import NotEnoughError
from servoscope.core.messages import Message, message
from servoscope.estimation.axis_filter import NO_LAG, AxisFilter, AxisNoise, AxisSignals, DriveLag, axis_stride
from servoscope.fit.search import DIFFERENCE, Experiment, fit
from servoscope.fit.tuning import sandwich_covariance, sum_covariance
from servoscope.isolation.ml.axis_scan import HEALTHY_MARGIN, largest_changes, scan_limit
from servoscope.isolation.ml.axis_vibration import BANDS
from servoscope.isolation.ml.axis_window import LONG_RUN_S, axis_signals
from servoscope.isolation.ml.least_squares import normalise_columns
from servoscope.models.loop import Loop
from servoscope.models.plants.axis import AxisPlant
from servoscope.signals import Recording

REST_SHARE = 0.03  # of the speed of motion (rms), below which the axis counts as resting
MAX_FORCE_CORRELATION_S = 0.05  # correlation of the unexplained force: a slower one would take over what friction does
SCATTER = 0.05  # standard deviation of a coefficient's logarithm between recordings, before any is compared
SCATTER_DOF = 0.5  # recordings that this is worth: three that agree are believed more than it
MIN_SCATTER = 0.01
FORCE_OFFSET_SHARE = 0.05  # of the force (rms), by which the constant one may differ between recordings and within one
MIN_COEFFICIENT_STDS = 3.0  # standard deviations from which a coefficient is seen
MAX_SCATTER_ROUNDS = 30  # steps in which coefficients and their scatter agree
FALSE_ALARMS = 1.0 / 200.0  # share of healthy recordings that change within themselves beyond a learned limit
MIN_LOG_LIKELIHOOD_GAIN = 1.0  # of a likelihood ratio whose logarithm counts
MIN_SAMPLES_PER_COLUMN = 10  # samples in motion
DELAYS_S, LAGS_S = np.arange(0.0, 0.1, 0.01), (0.0, 0.01, 0.02, 0.04, 0.08)  # that are tried first
MIN_DRIVE_GAIN = 50.0  # of twice the log-likelihood, for a delay and a lag
MIN_DRIVE_S = 5e-3  # of both together: less is what the sampling or a compliant coupling does
MAX_NOISE_ROUNDS = 4  # of the noise, and of the innovations that count with it, in turns
MAX_LOG_RATIO = 12.0  # of the force's standard deviation to that of y's noise, relative to its start
DRIVE_DIFFERENCE = 0.02  # samples of delay and lag, for derivatives: a lag below half of it is none
OF_NOISE = np.arange(2)  # the unknowns of an experiment that are those of the noise


@dataclass(frozen=True, eq=False)
class AxisFit:
    """The coefficients of one recording: b, those of the terms, and of what is its own, with their covariance."""

    coefficients: FloatArray  # b, a and the nuisances, of ``y'' = b u - sum a_i column_i``
    covariance: FloatArray  # of their estimates, by the long-run variance of the scores


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

    def regress(self, filter: AxisFilter, where: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Return regressors (N, p) and target (N,) of the innovations that count."""
        X = filter.of_acceleration(self.columns, self.signals.runs)[:, where].T
        return X, filter.of_output(self.signals.y, self.signals.runs)[where]


def rest_speed(signals: Sequence[AxisSignals]) -> float:
    """Return the speed below which an axis counts as resting."""
    speed = np.concatenate([signal.speed for signal in signals])
    return REST_SHARE * float(np.sqrt(np.mean(speed**2)))


def check_motion(recordings: Sequence[Recording], signals: Sequence[AxisSignals], slow: float, columns: int) -> None:
    """Raise NotEnoughError where a recording moves too little for some columns of a regression."""
    fewest = MIN_SAMPLES_PER_COLUMN * columns
    for recording, signal in zip(recordings, signals, strict=True):
        if (usable := int(signal.moving(slow, 0).sum())) < fewest:
            raise NotEnoughError(
                f"{recording.name}: it moves in {usable} samples only, of at least {fewest}: leave it out, or record a "
                "motion with more excitation"
            )


@dataclass(frozen=True, eq=False)
class AxisExperiment:
    """Healthy recordings as a function of the noise's colour and of how late the force is.

    Unknowns are, in this order: the logarithms of the force's standard deviation relative to that of y's noise, and of
    its correlation time, both relative to `noise`; samples of delay and of lag. Each recording has coefficients of its
    own, and the level of the noise is concentrated out.
    """

    loop: Loop
    recordings: Sequence[Recording]
    problems: Sequence[AxisRegression]  # with a force that is not late
    slow: float
    moves: AxisMoves | None
    noise: AxisNoise
    drive: DriveLag = NO_LAG

    @property
    def rate(self) -> float:
        """Sample rate of the filter [Hz]."""
        return self.problems[0].signals.sample_rate

    @cached_property
    def filter(self) -> AxisFilter:
        """The filter of `noise`."""
        return AxisFilter.design(self.noise, self.rate, self.problems[0].signals.derivative)

    def at(self, x: FloatArray) -> AxisExperiment:
        """Return the same recordings with a noise and a drive, the noise at the level of `noise`."""
        ratio, time = np.exp(x[:2]).tolist()
        noise = self.noise._replace(
            acceleration_std=ratio * self.noise.acceleration_std, correlation_s=time * self.noise.correlation_s
        )
        return replace(self, noise=noise, drive=DriveLag(*(x[2:] / self.rate).tolist()))

    def innovations(self, x: FloatArray) -> FloatArray:
        """Return innovations whose sum of squares ranks as the likelihood does, shape (N,)."""
        at, unexplained = self.at(x), []
        for problem in at.late:
            # which innovations count is the same throughout a search
            X, e = problem.regress(at.filter, problem.signals.moving(self.slow, self.filter.settling))
            Q = np.linalg.qr(X)[0]
            unexplained.append(e - Q @ (Q.T @ e))
        return np.concatenate(unexplained)

    @property
    def late(self) -> Sequence[AxisRegression]:
        """The recordings, the force as late as `drive`."""
        if not any(self.drive):
            return self.problems
        stride = round(self.loop.sample_rate / self.rate)
        forces = [axis_signals(self.loop, rec, stride, self.drive, self.moves).force for rec in self.recordings]
        return [
            replace(problem, columns=np.vstack([force, problem.columns[1:]]))
            for problem, force in zip(self.problems, forces, strict=True)
        ]

    @cached_property
    def search(self) -> Experiment:
        """The experiment that is searched."""
        times = np.log([0.1 / self.rate, max(MAX_FORCE_CORRELATION_S, 1.0 / self.rate)])
        low, high = times - np.log(self.noise.correlation_s)
        return Experiment(
            self.innovations,
            np.full(4, np.inf),
            level_known=False,
            low=np.array([-MAX_LOG_RATIO, low, 0.0, 0.0]),
            high=np.array([MAX_LOG_RATIO, high, np.inf, np.inf]),
            difference=np.array([DIFFERENCE, DIFFERENCE, DRIVE_DIFFERENCE, DRIVE_DIFFERENCE]),
        )

    def likeliest(self, free: IndexArray) -> AxisExperiment:
        """Return it with the likeliest unknowns; anew while its filter forgets a reversal sooner or later than before.

        Raises LinAlgError where the signals say nothing.
        """
        at = self
        for _ in range(MAX_NOISE_ROUNDS):
            before, fitted = at, fit(at.search, np.array([0.0, 0.0, *(np.array(at.drive) * at.rate)]), free)
            if not np.isfinite(fitted.cost):
                raise np.linalg.LinAlgError("the innovations are not finite")
            at = before.at(fitted.x)
            level = float(np.sqrt(np.mean(fitted.residual**2) / at.filter.variance))
            force, time, y = at.noise
            at = replace(at, noise=AxisNoise(level * force, time, level * y))
            if at.filter.settling == before.filter.settling:
                break
        return at


def fit_noise_and_drive(experiment: AxisExperiment) -> AxisExperiment:
    """Return the likeliest noise, and how late the force is; a lag that explains little is none.

    A grid comes before the search, for the likelihood has several maxima along delay and lag.
    """
    prompt = experiment.likeliest(OF_NOISE)
    grid = [np.array([0.0, 0.0, delay, lag]) for delay in DELAYS_S for lag in LAGS_S]
    costs = [prompt.search.at(x * prompt.rate).cost for x in grid]
    late = fit(prompt.search, grid[int(np.argmin(costs))] * prompt.rate)
    drive = prompt.at(late.x)
    if costs[0] - late.cost <= MIN_DRIVE_GAIN or sum(drive.drive) <= max(MIN_DRIVE_S, 1.0 / prompt.rate):
        return prompt
    return drive.likeliest(np.arange(len(late.x)))


def rough_noise(problems: Sequence[AxisRegression]) -> AxisNoise:
    """Return the noise that a search begins with."""
    from scipy.signal import savgol_filter

    rate = problems[0].signals.sample_rate
    accelerations = [np.gradient(problem.signals.speed, 1.0 / rate) for problem in problems]
    rough = np.concatenate([problem.signals.y - savgol_filter(problem.signals.y, 5, 2) for problem in problems])
    size = float(np.sqrt(np.mean(np.concatenate(accelerations) ** 2)))
    return AxisNoise(0.2 * size, 1.0 / rate, max(float(rough.std()), 1e-12 * size))


def fit_recording(problem: AxisRegression, noise: AxisNoise, slow: float) -> AxisFit:
    """Return the coefficients of one recording by least squares on its innovations."""
    filter = AxisFilter.design(noise, problem.signals.sample_rate, problem.signals.derivative)
    X, e = problem.regress(filter, problem.signals.moving(slow, filter.settling))
    scaled, size = normalise_columns(X)
    theta, *_ = np.linalg.lstsq(scaled, e, rcond=None)
    left = e - scaled @ theta
    H = np.asarray(np.linalg.inv(scaled.T @ scaled))
    G = sum_covariance(scaled * left[:, None], round(LONG_RUN_S * problem.signals.sample_rate))
    return AxisFit(theta / size, sandwich_covariance(H, G, size))


def fit_axis(
    loop: Loop, recordings: Sequence[Recording], moves: AxisMoves | None = None
) -> tuple[AxisModel | None, list[Message]]:
    """Learn a healthy axis, at the middle of its covariates; None, with a note, where u does not show its inertia.

    A friction that the recordings do not show stays as they have it, and has no faults in the refit. Raises
    NotEnoughError with a recording that hardly moves.
    """
    plant, stride = loop.plant, axis_stride(loop.sample_rate)
    assert isinstance(plant, AxisPlant)
    signals = [axis_signals(loop, recording, stride, NO_LAG, moves) for recording in recordings]
    slow = rest_speed(signals)
    check_motion(recordings, signals, slow, 1 + len(plant.acting))
    problems = [AxisRegression.of(plant, signal) for signal in signals]
    fitted = fit_noise_and_drive(AxisExperiment(loop, recordings, problems, slow, moves, rough_noise(problems)))
    fits = [fit_recording(problem, fitted.noise, slow) for problem in fitted.late]
    names = ("inertia", *(column.coefficient for column in plant.acting))
    center, of_center = combine_fits(fits, len(names))
    # in physical units, linear around the common coefficients: u alone may hardly show in a recording
    J = _physical_slope(center, plant)
    mean = _physical(center, plant)
    values = np.array([mean + J @ (fit.coefficients[: len(names)] - center) for fit in fits])
    covariances = np.array([J @ fit.covariance[: len(names), : len(names)] @ J.T for fit in fits])
    stds = np.sqrt(np.array([np.diag(covariance) for covariance in covariances]))
    known = [
        i for i, name in enumerate(names) if name == "inertia" or not plant.acting[i - 1].signed or name == "gravity"
    ]
    seen = mean / np.sqrt(np.diag(J @ of_center @ J.T))  # of all recordings together
    unseen = [i for i in known if seen[i] < MIN_COEFFICIENT_STDS and names[i] != "gravity"]
    of_unseen = tuple(names[i] for i in unseen)
    if 0 in unseen:
        return None, [message("learning.axis_unseen_none", names=of_unseen)]
    notes = [message("learning.axis_unseen_partly", names=of_unseen)] if unseen else []
    off = np.sqrt(np.mean((values - mean) ** 2 + stds**2, axis=0))
    mean[unseen] = np.maximum(mean[unseen], 0.0)  # friction drives nothing
    known = [i for i in known if i not in unseen]
    covariance = (J @ of_center @ J.T)[np.ix_(known, known)] / np.outer(mean[known], mean[known])
    covariance = covariance + np.diag(relative_scatter(values[:, known], stds[:, known], mean[known]) ** 2)
    coefficients = dict(zip(names, mean.tolist(), strict=True))
    force = abs(plant.input_gain) * float(np.sqrt(np.mean(np.concatenate([signal.u for signal in signals]) ** 2)))
    model = AxisModel(
        coefficients=coefficients,
        parameters=tuple(names[i] for i in known),
        covariance=tuple(tuple(row) for row in covariance.tolist()),
        noise=fitted.noise,
        drive=fitted.drive,
        stride=stride,
        rest_speed=slow,
        offset_std=FORCE_OFFSET_SHARE * force,
        drift_std=FORCE_OFFSET_SHARE * force,
        unseen=dict(zip(of_unseen, off[unseen].tolist(), strict=True)),
        moves=moves,
    )
    model, own_notes = _with_own_limits(loop, model, recordings)
    return model, [*notes, *own_notes]


def _with_own_limits(loop: Loop, model: AxisModel, recordings: Sequence[Recording]) -> tuple[AxisModel, list[Message]]:
    """Return the axis with what a change within a recording has to exceed where healthy ones change themselves."""
    changes, shaken = zip(*(largest_changes(loop, model, recording) for recording in recordings), strict=True)
    limits, notes = {}, []
    for key, key_message, own, usual in (
        ("change_limit", "learning.axis_own_change", changes, scan_limit(len(model.visible_faults(loop.plant.faults)))),
        ("vibration_limit", "learning.axis_own_vibration", shaken, scan_limit(BANDS)),
    ):
        most = max(own)
        # the machine does what the terms do not know, and chance alone is no longer what a change has to exceed
        limit = (
            score_limit([max(gain, MIN_LOG_LIKELIHOOD_GAIN) for gain in own], FALSE_ALARMS)
            if HEALTHY_MARGIN * most > usual
            else 0.0
        )
        if limit > usual:
            limits[key] = limit
            notes.append(message(key_message, name=recordings[own.index(most)].name, times=limit / usual))
    return model.model_copy(update=limits), notes


def combine_fits(fits: Sequence[AxisFit], n: int) -> tuple[FloatArray, FloatArray]:
    """Return the n coefficients that recordings have in common, and the covariance of that estimate, (n,) and (n, n).

    Each counts by the inverse of its covariance plus that of the scatter between recordings, which is estimated with
    them: what only one recording shows is taken from that one, and none counts for more than recordings agree (random
    effects of several coefficients: Jackson, Riley and White, 2011).
    """
    values = np.array([fit.coefficients[:n] for fit in fits])
    covariances = np.array([fit.covariance[:n, :n] for fit in fits])
    stds = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    center, scatter = np.zeros(n), np.full(n, SCATTER)
    for step in range(MAX_SCATTER_ROUNDS):
        weights = np.linalg.inv(covariances + np.diag((scatter * center) ** 2))
        A = np.linalg.inv(weights.sum(axis=0))
        center = A @ np.einsum("kij,kj->i", weights, values)
        if step:  # the first center knows of no scatter
            scatter = relative_scatter(values, stds, center)
    return center, np.asarray(A @ (weights @ covariances @ weights).sum(axis=0) @ A)


def relative_scatter(values: FloatArray, stds: FloatArray, center: FloatArray) -> FloatArray:
    """Return the standard deviation of coefficients between recordings over their common value, shape (n,).

    `values`, `stds` (m, n): each recording's, and how far chance may be off. The squared deviations beyond what chance
    explains are averaged (DerSimonian and Laird, 1986) together with `SCATTER`, which counts as `SCATTER_DOF`
    recordings; one that hardly shows a coefficient says little of how much that scatters.
    """
    own = (stds / center) ** 2
    weight = 1.0 / (own + SCATTER**2) ** 2
    weight = weight / weight.max(axis=0)
    share = 1.0 - 1.0 / len(values)  # the center follows each of them
    beyond = (weight * ((values / center - 1.0) ** 2 - share * own)).sum(axis=0)
    counted = SCATTER_DOF + share * weight.sum(axis=0)
    between = (SCATTER_DOF * SCATTER**2 + np.maximum(beyond, 0.0)) / counted
    return np.asarray(np.sqrt(np.maximum(between, MIN_SCATTER**2)))


def _physical(coefficients: FloatArray, plant: AxisPlant) -> FloatArray:
    """Return inertia and the coefficients of the terms, shape (n,), of b and a."""
    inertia = plant.input_gain / coefficients[0]
    return np.array([inertia, *(inertia * coefficients[1:])])


def _physical_slope(coefficients: FloatArray, plant: AxisPlant) -> FloatArray:
    """Return the derivatives of `_physical`, (n, n)."""
    b, a = coefficients[0], coefficients[1:]
    J = np.zeros((len(coefficients), len(coefficients)))
    J[:, 0] = -plant.input_gain / b**2 * np.array([1.0, *a])
    J[1:, 1:] = np.eye(len(a)) * plant.input_gain / b
    return J
