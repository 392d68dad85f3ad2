"""Healthy recordings -> Baseline: coefficients, noise, delay, healthy parameters, threshold, and what it can promise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from servoscope.baseline import Baseline, Promise, Source, digest
from servoscope.detection import SECONDS_PER_YEAR, noncentrality, required_noncentrality, statistic, threshold
from servoscope.errors import LoopError, NotEnoughError, RecordingError
from servoscope.inverse import nominal_theta
from servoscope.linear import Linear, autocovariances
from servoscope.loop import Loop
from servoscope.pipeline import Estimates, Pipeline, Regression
from servoscope.plants import FloatArray, Plant
from servoscope.recording import Recording
from servoscope.signatures import Expectation, Noise, course, noise_system
from servoscope.simulation import reference, simulate
from servoscope.tuning import Fit, autocovariance, fit, least_squares

PRIOR = 0.05  # standard deviation of the logarithm of a nominal parameter, where the recordings know no better
SHORTEST = 10.0  # memories; a shorter baseline is warned about
DELAY_TOLERANCE = 0.5  # samples; intersample models alone move the estimate by a tenth
DELAY_SIGNIFICANT = 0.1  # relative gain in residual variance below which a delay is not worth a refusal
WORTH_A_LOOK = 2.0  # T^2 per coefficient on healthy data above which the model is said to be wrong

Progress = Callable[[str], None]


def learn(loop: Loop, recordings: Sequence[Recording], progress: Progress = lambda _: None) -> Baseline:
    """Learn what healthy looks like.

    Parameters
    ----------
    loop
        The loop.
    recordings
        One or more healthy recordings; with several, the scatter between them counts.
    progress
        Told what is being done.

    Raises
    ------
    NotEnoughError
        If the recordings are too short or excite too little.
    RecordingError
        If u and y are out of step by more than the loop file says.
    LoopError
        If the settings do not go together.
    """
    if not recordings:
        raise NotEnoughError("no recording to learn from: give at least one healthy recording")
    pipeline = Pipeline.of(loop)
    progress("regressors")
    regressions = [pipeline.regression(rec.r, rec.u, rec.y, rec.restart) for rec in recordings]
    found = fit(regressions, pipeline.memory, pipeline.bank.names)
    progress("delay")
    delay_s, notes = _delay(loop, recordings, found)
    return _assemble(loop, recordings, pipeline, regressions, found, delay_s, notes, progress)


def nominal(loop: Loop, progress: Progress = lambda _: None, duration_s: float = 60.0) -> Baseline:
    """Compute the baseline from the plant's nominal parameters, as the paper does, instead of learning it.

    The recursion is tuned on a simulated healthy recording (the built-in profile at the paper's noise).

    Raises
    ------
    LoopError
        If the plant's nominal values or the controller are missing.
    """
    if not loop.plant.has_physics or loop.controller is None:
        raise LoopError(f"{loop.name}: a nominal baseline needs [controller] and the plant's nominal values")
    r = reference("profile", duration_s, loop.sample_rate)
    healthy, _ = simulate(loop, r)
    pipeline = Pipeline.of(loop)
    regressions = [pipeline.regression(healthy.r, healthy.u, healthy.y, healthy.restart)]
    found = fit(regressions, pipeline.memory, pipeline.bank.names)
    note = "computed from nominal parameters: an asset that differs from them by construction counts as a fault"
    return _assemble(loop, [healthy], pipeline, regressions, found, loop.delay, [note], progress, exact=True)


def simulated(loop: Loop) -> bool:
    """Return whether the loop can be simulated as a linear closed loop, which expectations and signatures need."""
    return loop.controller is not None and loop.plant.has_physics and not loop.plant.extras


def _assemble(
    loop: Loop,
    recordings: Sequence[Recording],
    pipeline: Pipeline,
    regressions: Sequence[Regression],
    found: Fit,
    delay_s: float | None,
    notes: list[str],
    progress: Progress,
    exact: bool = False,
) -> Baseline:
    covariance = found.covariance + _scatter(found)
    error = loop.monitor.model_error * found.rms_eta / found.tuning.scale
    covariance = covariance + np.diag(error**2)
    theta, noise, ratios, model_theta = found.tuning.theta, None, {}, np.zeros(0)
    if simulated(loop):
        progress("healthy parameters")
        noise = _noise(pipeline, found, regressions)
        expectations = [Expectation(pipeline, found.tuning, noise, course(rec)) for rec in recordings]
        if exact:
            theta = model_theta = expectations[0].batch(loop.plant)
        else:
            ratios, model_theta, misfit = _healthy_parameters(expectations, found, covariance)
            if misfit > 10.0 * pipeline.bank.n:
                notes.append(
                    f"[plant] and [controller] do not explain the healthy recordings (misfit {misfit:.0f}, about "
                    f"{pipeline.bank.n} expected): sizes of faults are uncertain, check the parameters"
                )
    tuning = replace(found.tuning, theta=theta)
    plant = loop.plant.with_ratios(ratios) if ratios else loop.plant
    limit = threshold(
        pipeline.bank.n,
        loop.monitor.evaluation_rate,
        loop.monitor.memory,
        loop.monitor.false_alarms_per_year,
        found.dof,
    )
    progress("promises")
    estimates = [pipeline.estimate(tuning, rec) for rec in recordings]
    deviations = []
    for rec, e in zip(recordings, estimates, strict=True):
        expected = theta
        if noise is not None:
            expected = Expectation(pipeline, tuning, noise, course(rec)).healthy(plant, model_theta)
        deviations.append(e.theta - expected)
    excess, suggestion = _excess(estimates, deviations, covariance, found)
    duration = sum(rec.duration_s for rec in recordings)
    if excess > WORTH_A_LOOK and loop.monitor.model_error < suggestion:
        notes.append(
            f"the residuals of the healthy recordings are {excess:.1f} times what noise explains: "
            f"set [monitor] model_error = {suggestion:.2g}"
        )
    if duration < SHORTEST * loop.monitor.memory:
        notes.append(
            f"{duration:.0f} s are short for a memory of {loop.monitor.memory:g} s: record at least "
            f"{SHORTEST * loop.monitor.memory:.0f} s"
        )
    supported = _supported_budget(pipeline.bank.n, loop, found.dof, excess)
    if supported > loop.monitor.false_alarms_per_year:
        notes.append(
            f"the data support a budget of {supported:.3g} false alarms per year, not "
            f"{loop.monitor.false_alarms_per_year:g}: record longer, or give a model_error"
        )
    directions = fault_directions(loop, plant, theta)
    return Baseline(
        loop=loop.to_dict(),
        sources=tuple(Source(name=r.name, samples=r.samples, duration_s=r.duration_s) for r in recordings),
        hash=digest(loop, [a for rec in recordings for a in (rec.t, rec.r, rec.u, rec.y)]),
        names=pipeline.bank.names,
        theta=tuple(theta),
        covariance=_rows(covariance),
        scale=tuple(tuning.scale),
        P_d=_rows(tuning.P_d),
        R=tuning.R,
        noise_a=tuple(tuning.noise_a),
        noise_gamma=tuple(tuning.noise_gamma),
        noise=noise,
        ratios=ratios,
        model_theta=tuple(model_theta),
        dof=found.dof,
        limit=limit,
        explained=found.explained,
        delay_s=delay_s,
        suggested_model_error=suggestion,
        supported_false_alarms_per_year=supported,
        promises=_promises(loop, directions, estimates, covariance, limit),
        notes=tuple(notes),
    )


def _rows(matrix: FloatArray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(x) for x in row) for row in matrix)


def _scatter(found: Fit) -> FloatArray:
    """Return the covariance between recordings beyond their noise; it is diagonal, few recordings give no more.

    A further recording scatters like Student's t around the mean of m, with the variance (m - 1)/(m - 3); fewer than
    four recordings get the factor of four.
    """
    m, n = found.each.shape
    if m < 2:
        return np.zeros((n, n))
    own = np.mean([np.diag(c) for c in found.each_covariance], axis=0)
    beyond = np.maximum(found.each.var(axis=0, ddof=1) - own, 0.0)
    students = (m - 1.0) / (m - 3.0) if m > 3 else 3.0
    return np.diag(beyond * students * (1.0 + 1.0 / m))


def _noise(pipeline: Pipeline, found: Fit, regressions: Sequence[Regression]) -> Noise:
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


def _healthy_parameters(
    expectations: Sequence[Expectation], found: Fit, covariance: FloatArray
) -> tuple[dict[str, float], FloatArray, float]:
    """Fit the plant's parameters to the healthy coefficients, held near the loop file's by a prior.

    Maximum a posteriori by Gauss and Newton on the expected least squares estimate; also returns that estimate and
    the misfit, which is chi-square with n degrees of freedom when the loop file is right.
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
    result = minimise(misfit, start, x_scale=PRIOR, diff_step=1e-3, max_nfev=12, bounds=(-1.5, 1.5))
    return ratios(result.x), expected(result.x), 2.0 * float(result.cost)


def fault_directions(loop: Loop, plant: Plant, theta: FloatArray) -> dict[str, FloatArray]:
    """Return d theta / d log(parameter) for every parameter of the plant's faults, each of shape (n,)."""
    if plant.has_physics and not plant.extras and loop.plant.kind != "polynomial":
        step = 1e-4

        def at(ratio: float, parameter: str) -> FloatArray:
            return nominal_theta(loop.model_copy(update={"plant": plant.with_ratios({parameter: ratio})}))

        return {p: (at(np.exp(step), p) - at(np.exp(-step), p)) / (2.0 * step) for p in plant.parameters}
    names = plant.names
    return {
        p: np.where(np.array(names) == p, theta, 0.0) if p in names else np.array(theta) for p in plant.parameters
    }


def _excess(
    estimates: Sequence[Estimates], deviations: Sequence[FloatArray], covariance: FloatArray, found: Fit
) -> tuple[float, float]:
    """Return T^2 per coefficient on the healthy data themselves, and the model error that would bring it to one."""
    from scipy.optimize import brentq

    learned = [e.updates > 0 for e in estimates]
    S = np.concatenate([e.S[ok] for e, ok in zip(estimates, learned, strict=True)])
    d = np.concatenate([each[ok] for each, ok in zip(deviations, learned, strict=True)])
    if not len(d):
        return 0.0, 0.0
    unit = np.diag((found.rms_eta / found.tuning.scale) ** 2)

    def mean(rho: float) -> float:
        return float(statistic(d, 0.0 * d, S + covariance + rho**2 * unit).mean()) / d.shape[1]

    excess = mean(0.0)
    if excess <= 1.0 or mean(0.5) > 1.0:
        return excess, 0.0 if excess <= 1.0 else 0.5
    return excess, float(brentq(lambda rho: mean(rho) - 1.0, 0.0, 0.5, xtol=1e-4))


def _supported_budget(n: int, loop: Loop, dof: float, excess: float) -> float:
    """Return the smallest budget that the data speak for [false alarms per year].

    The tail of T^2 is extrapolated from the estimated noise; that is trusted while the noise's own uncertainty raises
    the threshold by less than half, and not at all where healthy data contradict the noise model.
    """
    if excess > WORTH_A_LOOK:
        return SECONDS_PER_YEAR / loop.monitor.memory
    looks = loop.monitor.evaluation_rate, loop.monitor.memory
    for exponent in np.arange(-3.0, 9.0, 0.5):
        budget = float(10.0**exponent)
        if threshold(n, *looks, budget, dof) <= 1.5 * threshold(n, *looks, budget, 1e9):
            return budget
    return SECONDS_PER_YEAR * looks[0]


def _promises(
    loop: Loop,
    directions: dict[str, FloatArray],
    estimates: Sequence[Estimates],
    covariance: FloatArray,
    limit: float,
) -> tuple[Promise, ...]:
    """Return the smallest change of each fault's parameter that the baseline's own excitation shows."""
    rows = np.array(list(directions.values()))
    seen = []
    for e in estimates:
        half = slice(len(e.theta) // 2, None)
        if len(e.theta[half]):
            seen.append(np.median(noncentrality(e.S[half] + covariance, e.Psi[half], rows), axis=0))
    needed = required_noncentrality(covariance.shape[0], limit)
    best = np.max(seen, axis=0) if seen else np.zeros(len(rows))
    return tuple(
        Promise(
            name=fault.name,
            parameter=fault.parameter,
            change=float(np.sqrt(needed / information)) if information > 0.0 else None,
        )
        for fault, information in zip(loop.plant.faults, best, strict=True)
    )


def _delay(loop: Loop, recordings: Sequence[Recording], found: Fit) -> tuple[float | None, list[str]]:
    """Find the delay with the smallest residual; refuse a recording that is out of step with the loop file.

    One sample that the model does not know costs 63 % at 10 Hz (THEORY section 6), so half a sample matters.
    """
    dt = 1.0 / loop.sample_rate
    late = loop.delay + dt * np.arange(-1.5, 3.1, 0.5)
    late = np.unique(np.append(late[late >= 0.0], loop.delay))
    log_R = []
    for delay in late:
        shifted = Pipeline.of(loop.model_copy(update={"delay": float(delay)}))
        square = count = 0.0
        for rec in recordings:
            g = shifted.regression(rec.r, rec.u, rec.y, rec.restart)
            v = (g.eta - g.phi @ least_squares(g))[g.ok]
            square, count = square + float(v @ v), count + len(v)
        log_R.append(np.log(max(square / count, 1e-300)))
    values = np.array(log_R)
    here = values[int(np.argmin(np.abs(late - loop.delay)))]
    i = int(np.argmin(values))
    best = float(late[i])
    inside = 0 < i < len(late) - 1  # at an end the residual only falls: a misfit of another kind
    if inside:
        left, mid, right = values[i - 1 : i + 2]
        step_left, step_right = late[i] - late[i - 1], late[i + 1] - late[i]
        slope = (right - mid) / step_right - (mid - left) / step_left
        if slope > 0.0:
            best -= float(((right - mid) / step_right * step_left + (mid - left) / step_left * step_right) / (2 * slope))
    gain = found.dof * (here - values[i]) / 2.0  # log likelihood ratio of the best delay
    if (i and not inside) or (gain < 5.0 and values.max() - values.min() < 10.0 / found.dof):
        return None, ["the recordings do not tell the delay between u and y"]
    if gain > 10.0 and abs(best - loop.delay) > DELAY_TOLERANCE * dt and here - values[i] > DELAY_SIGNIFICANT:
        raise RecordingError(
            f"{recordings[0].name}: y answers u {best * 1e3:.3g} ms late, the loop file says delay = {loop.delay:g} s: "
            f"set delay = {best:.4g} or align the channels"
        )
    return best, []
