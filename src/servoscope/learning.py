"""Healthy recordings -> Baseline: coefficients, noise, delay, healthy parameters, threshold, promises."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from servoscope import estimators, twostage
from servoscope.baseline import Baseline, Source, digest
from servoscope.delays import check_delay
from servoscope.errors import LoopError, NotEnoughError
from servoscope.homogeneity import odd_ones, scatter, told
from servoscope.identification import (
    MOST_SATURATED,
    fault_directions,
    healthy_parameters,
    noise_of,
    saturated,
    simulated,
)
from servoscope.inverse import nominal_theta
from servoscope.loop import Loop
from servoscope.noise import AR_ORDER, autocovariance, white_noises, yule_walker
from servoscope.pipeline import Pipeline, Regression
from servoscope.plants import FloatArray
from servoscope.promises import WORTH_A_LOOK, misfit_of, noise_notes, promises, supported_budget
from servoscope.recording import Recording
from servoscope.refinement.gate import learn_exact
from servoscope.rehearsal import Rehearsed, limit_of, prepare
from servoscope.sequential import Member
from servoscope.signatures import Expectation, colour_of, course, residual_system
from servoscope.simulation import reference, simulate
from servoscope.tuning import Fit, fit, white_enough

SHORTEST = 10.0  # memories; a shorter baseline is warned about
FEWEST_PER_COEFFICIENT = 20  # usable samples of every recording
SPEED_OVER = 0.05  # s over which a speed is measured here
STILL_SHARE = 0.02  # of the speed of motion, below which an axis stands still
WEAKEST_INSTRUMENT = 0.05  # below, the instrument says too little of the regressor to be worth its variance
MOST_SIMULATED = 2e6  # samples behind a nominal baseline
LEAST_EXPLAINED = 0.9  # share of u's variance
NOTHING = 1e-9  # of the residual's variance: what is left below is rounding
UNLIKELY = 1e-3  # probability below which the physics are not believed to hold

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
    progress("regressors")
    for rec in recordings:
        if (share := saturated(loop, rec)) > MOST_SATURATED:
            raise NotEnoughError(
                f"{rec.name}: u is at a limit in {share:.0%} of the rows: lower the demand, or check input_limits"
            )
    pipeline, regressions, found = _tuned(loop, recordings)
    notes = [
        f"estimator = {loop.monitor.estimator!r}: {why}; false alarms and wrong names are possible, with 'akf' less so"
        for check, why in estimators.exceptions(loop.monitor.estimator).items()
        if check in ("mean", "covariance")
    ]
    if found.strength < WEAKEST_INSTRUMENT:
        notes.append(
            f"the instrument is too weak (strength {found.strength:.2g} of 1, at least {WEAKEST_INSTRUMENT:g} needed): "
            "estimator = 'akf' is used instead"
        )
        loop = loop.model_copy(update={"monitor": loop.monitor.model_copy(update={"estimator": "akf"})})
        pipeline, regressions, found = _tuned(loop, recordings)
    progress("delay")
    delay_s, doubts = check_delay(loop, recordings)
    notes += doubts
    return _assemble(loop, recordings, pipeline, regressions, found, delay_s, notes, progress)


def still_speed(loop: Loop, recordings: Sequence[Recording]) -> float:
    """Return the speed below which the axis stands still: a small share of the speed at which it moves.

    At rest the controller may push as it likes against static friction, and u then says nothing of the plant. Where
    the loop can be simulated, rest is part of what is expected, and nothing is held (0).
    """
    if loop.monitor.update_when != "auto" or simulated(loop):
        return 0.0
    span = max(1, round(SPEED_OVER * loop.sample_rate))
    speeds = []
    for rec in recordings:
        source = rec.r if getattr(loop.plant, "sign_from", "output") == "reference" else rec.y
        stretch = np.cumsum(rec.restart)
        together = stretch[span:] == stretch[:-span]
        speeds.append(np.abs(source[span:] - source[:-span])[together] * loop.sample_rate / span)
    speed = np.concatenate(speeds)
    if not len(speed) or not speed.max() > 0.0:
        return 0.0
    moving = speed[speed > 0.1 * speed.max()]
    return STILL_SHARE * float(np.sqrt((moving**2).mean()))


def _tuned(loop: Loop, recordings: Sequence[Recording]) -> tuple[Pipeline, list[Regression], Fit]:
    pipeline = Pipeline.of(loop, twostage.tune(loop, recordings), still_speed(loop, recordings))
    regressions = [pipeline.regression(rec.r, rec.u, rec.y, rec.restart) for rec in recordings]
    fewest = FEWEST_PER_COEFFICIENT * pipeline.bank.n
    for rec, g in zip(recordings, regressions, strict=True):
        if (usable := int(g.ok.sum())) < fewest:
            raise NotEnoughError(
                f"{rec.name}: only {usable} usable samples of at least {fewest} when filters have settled and rest is "
                "left out: record longer, lower rest_speed, or learn without it"
            )
    return pipeline, regressions, fit(pipeline, regressions)


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
    duration_s = min(duration_s, MOST_SIMULATED / loop.sample_rate)
    healthy, _ = simulate(loop, reference("profile", duration_s, loop.sample_rate))
    pipeline, regressions, found = _tuned(loop, [healthy])
    note = "computed from nominal parameters: an asset that differs from them by construction counts as a fault"
    return _assemble(loop, [healthy], pipeline, regressions, found, loop.delay, [note], progress, exact=True)


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
    rehearsed = Rehearsed()
    sure, apart = found.covariance, found.each
    error = np.diag((loop.monitor.model_error * found.rms_eta / found.tuning.scale) ** 2)
    theta, noise, model_theta, loudest = found.tuning.theta, None, np.zeros(0), None
    ratios: dict[str, float] = {}
    ratios_std: dict[str, float] = {}
    ratios_covariance = np.zeros((0, 0))
    listening: tuple[Member, ...] = ()
    expectations: list[Expectation] = []
    if simulated(loop):
        from scipy import special

        progress("healthy parameters")
        noise = noise_of(pipeline, found, regressions)
        expectations = [Expectation(pipeline, found.tuning, noise, course(rec)) for rec in recordings]
        if exact:
            theta = model_theta = expectations[0].batch(loop.plant)
        else:
            healthy = healthy_parameters(expectations, regressions, found, nominal_theta(loop), found.tuning.noise)
            # what the plant leaves of the residual is noise alone: its colour is known better now
            plant = loop.plant.with_ratios(healthy.ratios)
            gamma = autocovariance(healthy.residuals, AR_ORDER)
            silent = not gamma[0] > NOTHING * found.tuning.R  # simulated without noise, for example
            model = found.tuning.noise if silent else yule_walker(gamma)
            if pipeline.stage_one is None and not silent:
                noises = white_noises(residual_system(pipeline, plant), healthy.residuals, pipeline.stride)
                if white_enough(healthy.residuals, noises, model):
                    noise, loudest = noises.noise, noises.loudest
                    model = colour_of(pipeline, plant, noise)
                    found = replace(found, tuning=replace(found.tuning, noise=model))
            expectations = [replace(e, tuning=found.tuning, noise=noise) for e in expectations]
            healthy = healthy_parameters(expectations, regressions, found, healthy.true, model)
            ratios, ratios_std, model_theta = healthy.ratios, healthy.std(loop.plant), healthy.theta
            plant = loop.plant.with_ratios(ratios)
            apart = found.each - np.array([e.batch(plant) for e in expectations])  # each reference has its own bias
            ratios_covariance = healthy.covariance
            if healthy.misfit <= special.chdtri(pipeline.bank.n, UNLIKELY):
                # the physics hold: what they say is known better than the coefficients one by one
                theta, sure = model_theta, healthy.theta_covariance
                if loudest and not loop.monitor.model_error:
                    progress("rehearsal")
                    rehearsed, listening, doubts = prepare(
                        recordings, expectations, plant, healthy.theta, healthy.covariance, loudest
                    )
                    notes += doubts
            if healthy.misfit > 10.0 * pipeline.bank.n:
                notes.append(
                    f"[plant] and [controller] do not explain the healthy recordings (misfit {healthy.misfit:.0f}, "
                    f"about {pipeline.bank.n} expected): sizes of faults are uncertain, check the parameters"
                )
    covariance = sure + scatter(apart, found.each_covariance) + error
    odd = odd_ones(apart, found.each_covariance + error)
    notes += told(odd, [rec.name for rec in recordings], pipeline.bank.names)
    tuning = replace(found.tuning, theta=theta)
    plant = loop.plant.with_ratios(ratios) if ratios else loop.plant
    limit = limit_of(loop, pipeline.bank.n, found.dof, rehearsed, bool(listening))
    progress("promises")
    estimates = [pipeline.estimate(tuning, rec) for rec in recordings]
    expected = [replace(e, tuning=tuning).healthy(plant, model_theta) for e in expectations] or [theta] * len(estimates)
    deviations = [e.theta - mean for e, mean in zip(estimates, expected, strict=True)]
    notes += noise_notes(pipeline, found, estimates, simulated(loop))
    excess, suggestion = misfit_of(estimates, deviations, covariance, found)
    if found.explained < LEAST_EXPLAINED:
        notes.append(
            f"the motion explains only {found.explained:.0%} of u: not a baseline to trust, check columns, units, plant"
        )
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
    supported = supported_budget(pipeline.bank.n, loop, found.dof, excess)
    if supported > loop.monitor.false_alarms_per_year:
        notes.append(
            f"the data support a budget of {supported:.3g} false alarms per year, not "
            f"{loop.monitor.false_alarms_per_year:g}: record longer, or give a model_error"
        )
    directions = fault_directions(loop, plant, theta)
    baseline = Baseline(
        loop=loop.to_dict(),
        sources=tuple(Source(name=r.name, samples=r.samples, duration_s=r.duration_s) for r in recordings),
        hash=digest(loop, [a for rec in recordings for a in (rec.t, rec.r, rec.u, rec.y)]),
        names=pipeline.bank.names,
        theta=tuple(theta),
        covariance=_rows(covariance),
        scale=tuple(tuning.scale),
        P_d=_rows(tuning.P_d),
        stage_one=pipeline.stage_one,
        R=tuning.R,
        noise_a=tuple(tuning.noise.a),
        noise_b=tuple(tuning.noise.b),
        noise_gamma=tuple(tuning.noise.gamma),
        noise_variance=tuning.noise.variance,
        noise=noise,
        ratios=ratios,
        ratios_std=ratios_std,
        ratios_covariance=_rows(ratios_covariance),
        model_theta=tuple(model_theta),
        dof=found.dof,
        limit=limit,
        explained=found.explained,
        still_speed=pipeline.still_speed,
        delay_s=delay_s,
        suggested_model_error=suggestion,
        supported_false_alarms_per_year=supported,
        loudest=loudest,
        rehearsed=rehearsed,
        members=listening,
        promises=promises(loop, directions, estimates, covariance, limit),
        notes=tuple(notes),
    )
    progress("predictor")
    predictor = learn_exact(baseline, recordings)
    if predictor is not None and predictor.misfit > 1.0:
        notes.append(
            f"the sampled plant leaves {predictor.misfit:.2g} times what noise would in the healthy recordings: faults "
            "are named by the recursion alone, without a refit; check [plant] and delay"
        )
    return baseline.model_copy(update={"exact": predictor, "notes": tuple(notes)})


def _rows(matrix: FloatArray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(x) for x in row) for row in matrix)
