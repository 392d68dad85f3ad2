"""Healthy recordings of a motor axis -> its coefficients, how much they scatter, and the noise of its filter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servoscope.baseline.axis_model import AxisModel, AxisMoves
from servoscope.baseline.threshold import score_limit
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import NotEnoughError
from servoscope.core.messages import Message, message
from servoscope.estimation.axis_filter import NO_LAG, AxisFilter, AxisNoise, AxisSignals, DriveLag, axis_stride
from servoscope.fit.search import Experiment, fit
from servoscope.fit.tuning import sandwich_covariance, sum_covariance
from servoscope.isolation.axis_change import HEALTHY_MARGIN, largest_vibration, learn_changes
from servoscope.isolation.ml.axis_vibration import BANDS, scan_limit
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
FALSE_ALARMS = 1.0 / 200.0  # share of healthy recordings that vibrate beyond a learned limit
MIN_STATISTIC = 1.0  # of a vibration whose logarithm counts
MIN_SAMPLES_PER_COLUMN = 10  # samples in motion
# samples that the fit of the noise leaves per column, of those in motion up to a share: a filter that forgets rests
# slowly would leave a handful of a y whose noise looks like them, and explain these perfectly
MIN_NOISE_SAMPLES_PER_COLUMN, MAX_NOISE_SHARE = 30, 0.5
DELAYS_S, LAGS_S = np.arange(0.0, 0.1, 0.01), (0.0, 0.01, 0.02, 0.04, 0.08)  # that are tried first
MIN_DRIVE_GAIN = 50.0  # of twice the log-likelihood, for a delay and a lag
MIN_DRIVE_S = 5e-3  # of both together: less is what the sampling or a compliant coupling does
MAX_DRIVE_ROUNDS = 3  # of delay and lag, and noise, in turns
DRIVE_DIFFERENCE = 0.02  # samples of delay and lag, for derivatives: a lag below half of it is none
STEPS, FIRST_STEP = 250, 0.7  # of the search for the noise: steps, and the logarithm of the first ones


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

    def regress(self, noise: AxisNoise, rest_speed: float) -> tuple[FloatArray, FloatArray, AxisFilter]:
        """Return regressors (N, p) and target (N,) of the innovations that count, in standard deviations."""
        filter = AxisFilter.design(noise, self.signals.sample_rate, self.signals.derivative)
        where = self.signals.moving(rest_speed, filter.settling)
        X = filter.of_acceleration(self.columns, self.signals.runs)[:, where].T
        e = filter.of_output(self.signals.y, self.signals.runs)[where]
        return X / np.sqrt(filter.variance), e / np.sqrt(filter.variance), filter


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


def fit_axis_noise(problems: Sequence[AxisRegression], slow: float) -> AxisNoise:
    """Return the noise that makes the innovations likeliest, each recording with coefficients of its own.

    Raises LinAlgError where the signals say nothing.
    """
    from scipy.optimize import minimize
    from scipy.signal import savgol_filter

    rate = problems[0].signals.sample_rate
    accelerations = [np.gradient(problem.signals.speed, 1.0 / rate) for problem in problems]
    rough = np.concatenate([problem.signals.y - savgol_filter(problem.signals.y, 5, 2) for problem in problems])
    size = float(np.sqrt(np.mean(np.concatenate(accelerations) ** 2)))
    start = np.log([0.2 * size, 1.0 / rate, max(float(rough.std()), 1e-12 * size)])
    bounds = [
        (start[0] - 7.0, start[0] + 5.0),
        tuple(np.log([0.1 / rate, max(MAX_FORCE_CORRELATION_S, 1.0 / rate)])),
        (start[2] - 9.0, start[2] + 3.0),
    ]

    fewest = [
        min(
            MIN_NOISE_SAMPLES_PER_COLUMN * len(problem.columns), MAX_NOISE_SHARE * problem.signals.moving(slow, 0).sum()
        )
        for problem in problems
    ]
    first = 0

    def cost(x: FloatArray) -> float:
        nonlocal first
        total, count = 0.0, 0
        for problem, least in zip(problems, fewest, strict=True):
            X, e, filter = problem.regress(AxisNoise(*np.exp(x).tolist()), slow)
            if len(e) < least:
                return np.inf
            left = e - X @ np.linalg.lstsq(X, e, rcond=None)[0]
            total += len(e) * float(np.log(filter.variance)) + float(left @ left)
            count += len(e)
        first = first or count
        # a filter that forgets a reversal sooner counts more innovations, which makes it no likelier
        return total * first / max(count, 1)

    while np.isinf(cost(start)):  # the quieter y is, the sooner a filter forgets
        if start[2] <= bounds[2][0]:
            raise NotEnoughError(
                "y is too coarse or too noisy for its speed: it seems to rest every few samples; record faster motion, "
                "or log at a lower rate"
            )
        start[2] -= FIRST_STEP
    # a simplex of its own size: SciPy's is a share of the logarithms, and so depends on the unit of y
    simplex = np.vstack([start, start + FIRST_STEP * np.eye(len(start))])
    optimize_result = minimize(
        cost,
        start,
        method="Nelder-Mead",
        bounds=bounds,
        options={"maxiter": STEPS, "xatol": 0.02, "fatol": 0.5, "initial_simplex": simplex},
    )
    return AxisNoise(*np.exp(optimize_result.x).tolist())


def _fit_drive_and_noise(
    loop: Loop, recordings: Sequence[Recording], stride: int, slow: float, moves: AxisMoves | None
) -> tuple[DriveLag, AxisNoise, list[AxisRegression]]:
    """Return how late the force is, the noise, and the regressions with both; a lag that explains little is none."""
    plant, drive = loop.plant, NO_LAG
    assert isinstance(plant, AxisPlant)

    def regressions(drive: DriveLag) -> list[AxisRegression]:
        return [
            AxisRegression.of(plant, axis_signals(loop, recording, stride, drive, moves)) for recording in recordings
        ]

    noise = fit_axis_noise(regressions(drive), slow)
    for _ in range(MAX_DRIVE_ROUNDS):
        later = fit_drive(loop, recordings, regressions(drive), noise, slow, drive, moves)
        if later == drive:
            break
        drive = later
        noise = fit_axis_noise(regressions(drive), slow)
    return drive, noise, regressions(drive)


def fit_drive(
    loop: Loop,
    recordings: Sequence[Recording],
    problems: Sequence[AxisRegression],
    noise: AxisNoise,
    slow: float,
    known: DriveLag,
    moves: AxisMoves | None = None,
) -> DriveLag:
    """Return the delay and lag of the force behind u that make the innovations smallest, `known` where none matters.

    Each recording has coefficients of its own. All columns but that of u stay, so that their directions are taken off
    once; a grid comes before the search, for the sum of squares has several minima.
    """
    rate, stride = loop.sample_rate, round(loop.sample_rate / problems[0].signals.sample_rate)
    fixed = []
    for recording, problem in zip(recordings, problems, strict=True):
        X, e, filter = problem.regress(noise, slow)
        Q = np.linalg.qr(X[:, 1:])[0]
        where = problem.signals.moving(slow, filter.settling)
        fixed.append((recording, Q, e - Q @ (Q.T @ e), filter, where, problem.signals.runs))

    def unexplained(x: FloatArray) -> FloatArray:
        parts = []
        for recording, Q, e, filter, where, runs in fixed:
            u = axis_signals(loop, recording, stride, DriveLag(*(x / rate).tolist()), moves).force
            column = filter.of_acceleration(u, runs)[where]
            column = column - Q @ (Q.T @ column)
            parts.append(e - column * (float(column @ e) / max(float(column @ column), np.finfo(np.float64).tiny)))
        return np.concatenate(parts)

    unknown = np.full(2, np.inf)  # samples of delay and lag
    experiment = Experiment(unexplained, unknown, level_known=False, low=0.0, difference=DRIVE_DIFFERENCE)
    before = experiment.at(rate * np.array(known))
    grid = [rate * np.array([delay, lag]) for delay in DELAYS_S for lag in LAGS_S]
    start = min([before, *map(experiment.at, grid)], key=lambda tried: tried.cost)
    likely = fit(experiment, start.x)
    late = DriveLag(*(likely.x / rate).tolist())
    matters = before.cost - likely.cost > MIN_DRIVE_GAIN and sum(late) > max(MIN_DRIVE_S, 1.0 / rate)
    return late if matters else known


def fit_recording(problem: AxisRegression, noise: AxisNoise, slow: float) -> AxisFit:
    """Return the coefficients of one recording by least squares on its innovations."""
    X, e, _ = problem.regress(noise, slow)
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
    signals = [axis_signals(loop, recording, stride) for recording in recordings]
    slow = rest_speed(signals)
    check_motion(recordings, signals, slow, 1 + len(plant.acting))
    drive, noise, problems = _fit_drive_and_noise(loop, recordings, stride, slow, moves)
    fits = [fit_recording(problem, noise, slow) for problem in problems]
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
        noise=noise,
        drive=drive,
        stride=stride,
        rest_speed=slow,
        offset_std=FORCE_OFFSET_SHARE * force,
        drift_std=FORCE_OFFSET_SHARE * force,
        unseen=dict(zip(of_unseen, off[unseen].tolist(), strict=True)),
        moves=moves,
        changes=learn_changes(loop, recordings, moves),
    )
    model, own_notes = _with_own_limit(loop, model, recordings)
    return model, [*notes, *own_notes]


def _with_own_limit(loop: Loop, model: AxisModel, recordings: Sequence[Recording]) -> tuple[AxisModel, list[Message]]:
    """Return the axis with what a vibration within a recording has to exceed where healthy ones vibrate themselves."""
    shaken, usual = [largest_vibration(loop, model, recording) for recording in recordings], scan_limit(BANDS)
    if HEALTHY_MARGIN * max(shaken) <= usual:
        return model, []
    limit = score_limit([max(statistic, MIN_STATISTIC) for statistic in shaken], FALSE_ALARMS)
    if limit <= usual:
        return model, []
    name = recordings[int(np.argmax(shaken))].name
    return model.model_copy(update={"vibration_limit": limit}), [
        message("learning.axis_own_vibration", name=name, times=limit / usual)
    ]


def combine_fits(fits: Sequence[AxisFit], n: int) -> tuple[FloatArray, FloatArray]:
    """Return the n coefficients that recordings have in common, and the covariance of that estimate, (n,) and (n, n).

    Each counts by the inverse of its covariance plus that of the scatter between recordings, which is estimated with
    them: what only one recording shows is taken from that one, and none counts for more than recordings agree (random
    effects of several coefficients: Jackson, Riley and White, 2011).
    """
    values = np.array([fit.coefficients[:n] for fit in fits])
    covariances = np.array([fit.covariance[:n, :n] for fit in fits])
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    if not (variances > 0.0).all():
        raise np.linalg.LinAlgError("the columns of a recording are alike")
    stds = np.sqrt(variances)
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
