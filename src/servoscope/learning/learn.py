"""Healthy recordings -> Baseline: coefficients, noise, delay, healthy parameters, threshold, promises."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from servoscope.baseline.axis_model import AxisModel
from servoscope.baseline.baseline import Baseline
from servoscope.baseline.covariates import CovariateModel, CovariatePath
from servoscope.baseline.expectation import Expectation, reference_path, residual_noise_model, residual_system
from servoscope.baseline.hypothesis import CusumHypothesis
from servoscope.baseline.motion import learn_motion
from servoscope.baseline.plant_fit import (
    MAX_SATURATED_SHARE,
    can_simulate,
    describe_healthy_plant,
    fault_directions,
    fit_healthy_plant,
    saturated_share,
    split_residual_noise,
)
from servoscope.baseline.records import BaselineSource, digest
from servoscope.baseline.sensors import learn_sensors
from servoscope.baseline.threshold import CalibrationFactors, t2_threshold
from servoscope.core.arrays import FloatArray, to_tuples
from servoscope.core.blas import with_one_blas_thread
from servoscope.core.errors import LoopError, NotEnoughError, RecordingError
from servoscope.core.messages import Message, message
from servoscope.detection import homogeneity
from servoscope.detection.signal_defects import describe_misfit, find_signal_defect, find_switched_off
from servoscope.detection.threshold_calibration import design_sequential_test
from servoscope.estimation import estimators, two_stage
from servoscope.estimation.filter_bank import nominal_theta
from servoscope.estimation.noise_model import AR_ORDER, fit_white_noise, sample_autocovariance, yule_walker
from servoscope.estimation.pipeline import Pipeline, Regression
from servoscope.estimation.tuning import TuningFit, fit_tuning, prefers_white_noise
from servoscope.isolation.ml.validity import fit_exact_predictor
from servoscope.learning import detectability
from servoscope.learning.axis_fit import fit_axis
from servoscope.learning.covariates import fit_covariates
from servoscope.learning.delay import check_delay
from servoscope.learning.detectability import detectable_changes, noise_notes, supported_budget
from servoscope.learning.features import learn_features
from servoscope.learning.innovation_fit import FILE_ERROR, fit_innovations
from servoscope.learning.instrument import learn_instrument, learns_instrument
from servoscope.learning.population import Population
from servoscope.learning.warm_up import fit_warm_up
from servoscope.models.loop import Loop
from servoscope.models.plants.axis import AxisPlant
from servoscope.signals import Recording
from servoscope.simulation import reference, simulate

MIN_MEMORIES = 10.0  # memories; a shorter baseline is warned about
MIN_SAMPLES_PER_COEFFICIENT = 20  # usable samples of every recording
SPEED_OVER = 0.05  # s over which a speed is measured here
REST_SPEED_SHARE = 0.02  # of the speed of motion, below which an axis stands still
MIN_INSTRUMENT_EIGENVALUE = 0.05  # below, the instrument says too little of the regressor to be worth its variance
MAX_SIMULATED_SAMPLES = 2e6  # samples behind a nominal baseline
MIN_EXPLAINED_SHARE = 0.9  # share of u's variance
ROUNDING_SHARE = 1e-9  # of the residual's variance: what is left below is rounding
MIN_PHYSICS_PROBABILITY = 1e-3  # probability below which the physics are not believed to hold

Progress = Callable[[str], None]


@with_one_blas_thread
def learn_baseline(
    loop: Loop,
    recordings: Sequence[Recording],
    progress: Progress = lambda _: None,
    accept_delay: bool = False,
    population: Population | None = None,
) -> Baseline:
    """Learn what healthy looks like.

    With several recordings their scatter counts; a population of like machines is a prior. NotEnoughError: too short or
    too little excitation; RecordingError: u and y are out of step, unless that is accepted.
    """
    if not recordings:
        raise NotEnoughError("no recording to learn from: give at least one healthy recording")
    progress("regressors")
    for rec in recordings:
        _check_signals(loop, rec)
        if (share := saturated_share(loop, rec)) > MAX_SATURATED_SHARE:
            raise NotEnoughError(
                f"{rec.name}: u is at a limit in {share:.0%} of the rows: lower the demand, or check input_limits"
            )
    pipeline, regressions, fit, notes = _tune(loop, recordings)
    covariates = None
    if loop.columns.covariates or loop.monitor.hidden_warm_up:
        progress("covariates")
        fit_them = fit_warm_up if loop.monitor.hidden_warm_up else fit_covariates
        covariates, regressions, fit, recordings = fit_them(pipeline, recordings, regressions, fit)
    progress("delay")
    delay_s, warnings = check_delay(pipeline.loop, recordings, accept_delay)
    name = pipeline.loop.monitor.estimator
    notes += [
        message("learning.simplified_estimator", estimator=name, reason=reason)
        for check, reason in estimators.exceptions(name).items()
        if check in ("mean", "covariance")
    ]
    notes += [*warnings, *(off.description for off in map(find_switched_off, recordings) if off is not None)]
    return _assemble_baseline(
        pipeline.loop,
        recordings,
        pipeline,
        regressions,
        fit,
        delay_s,
        notes,
        progress,
        covariates=covariates,
        population=population,
    )


def _check_signals(loop: Loop, recording: Recording) -> None:
    """Refuse a recording with stuck, wrapped or exchanged signals, of another sign or in another unit."""
    if (defect := find_signal_defect(recording)) is not None:
        raise RecordingError(f"{recording.name}: {defect.description}; or leave that part out")
    if loop.plant.has_physics:
        plain = loop.model_copy(update={"monitor": loop.monitor.model_copy(update={"two_stage": "none"})})
        misfit = describe_misfit(Pipeline.of(plain), nominal_theta(loop), recording)
        if misfit is not None:
            raise RecordingError(f"{recording.name}: {misfit}")


def still_speed(loop: Loop, recordings: Sequence[Recording]) -> float:
    """Return the speed below which the axis stands still: a small share of the speed at which it moves.

    At rest the controller may push as it likes against static friction, and u then says nothing of the plant. Where
    the loop can be simulated, rest is part of what is expected, and nothing is held (0).
    """
    if loop.monitor.update_when != "auto" or can_simulate(loop):
        return 0.0
    span = max(1, round(SPEED_OVER * loop.sample_rate))
    speeds = []
    for rec in recordings:
        source = rec.r if loop.plant.velocity_sign.of_reference else rec.y
        stretch = np.cumsum(rec.restart)
        together = stretch[span:] == stretch[:-span]
        moved = source[span:] if loop.plant.derivative else (source[span:] - source[:-span]) * loop.sample_rate / span
        speeds.append(np.abs(moved)[together])
    speed = np.concatenate(speeds)
    if not len(speed) or not speed.max() > 0.0:
        return 0.0
    moving = speed[speed > 0.1 * speed.max()]
    return REST_SPEED_SHARE * float(np.sqrt((moving**2).mean()))


def _tune_pipeline(loop: Loop, recordings: Sequence[Recording]) -> tuple[Pipeline, list[Regression], TuningFit]:
    pipeline = Pipeline.of(loop, two_stage.tune_stage_one(loop, recordings), still_speed(loop, recordings))
    regressions = [pipeline.regression(rec.r, rec.u, rec.y, rec.restart) for rec in recordings]
    fewest = MIN_SAMPLES_PER_COEFFICIENT * pipeline.bank.n
    for rec, g in zip(recordings, regressions, strict=True):
        if (usable := int(g.ok.sum())) < fewest:
            raise NotEnoughError(
                f"{rec.name}: only {usable} usable samples of at least {fewest} when filters have settled and rest is "
                "left out: record longer, lower rest_speed, or learn without it"
            )
    return pipeline, regressions, fit_tuning(pipeline, regressions)


def _tune(
    loop: Loop, recordings: Sequence[Recording]
) -> tuple[Pipeline, Sequence[Regression], TuningFit, list[Message]]:
    """Tune the recursion, with an instrument where noise in y biases least squares; the pipeline's loop tells."""
    plain = loop.model_copy(update={"monitor": loop.monitor.model_copy(update={"estimator": "akf"})})
    if not learns_instrument(loop):
        pipeline, regressions, fit = _tune_pipeline(loop, recordings)
        if fit.strength >= MIN_INSTRUMENT_EIGENVALUE:
            return pipeline, regressions, fit, []
        note = message("learning.weak_instrument", strength=fit.strength, least=MIN_INSTRUMENT_EIGENVALUE)
        return *_tune_pipeline(plain, recordings), [note]
    pipeline, regressions, fit = _tune_pipeline(plain, recordings)
    found, notes = learn_instrument(pipeline, recordings, fit)
    if found is None:
        return pipeline, regressions, fit, notes
    return found.pipeline, found.regressions, found.fit, notes


def nominal_baseline(loop: Loop, progress: Progress = lambda _: None, duration_s: float = 60.0) -> Baseline:
    """Compute the baseline from the plant's nominal parameters, as the paper does, instead of learning it.

    The recursion is tuned on a simulated healthy recording (the built-in profile at the paper's noise).

    Raises LoopError if the plant's nominal values or the controller are missing.
    """
    if not loop.plant.has_physics or loop.controller is None:
        raise LoopError(f"{loop.name}: a nominal baseline needs [controller] and the plant's nominal values")
    duration_s = min(duration_s, MAX_SIMULATED_SAMPLES / loop.sample_rate)
    healthy, _ = simulate(loop, reference("profile", duration_s, loop.sample_rate))
    pipeline, regressions, fit = _tune_pipeline(loop, [healthy])
    note = message("learning.nominal")
    return _assemble_baseline(loop, [healthy], pipeline, regressions, fit, loop.delay, [note], progress, exact=True)


def _assemble_baseline(
    loop: Loop,
    recordings: Sequence[Recording],
    pipeline: Pipeline,
    regressions: Sequence[Regression],
    fit: TuningFit,
    delay_s: float | None,
    notes: list[Message],
    progress: Progress,
    exact: bool = False,
    covariates: CovariateModel | None = None,
    population: Population | None = None,
) -> Baseline:
    calibration, m = CalibrationFactors(), len(recordings)
    theta_covariance, deviations_between = fit.covariance, fit.each
    error = np.diag((loop.monitor.model_error * fit.rms_eta / fit.tuning.scale) ** 2)
    theta, noise, model_theta, loudest = fit.tuning.theta, None, np.zeros(0), None
    ratios, ratios_std = dict[str, float](), dict[str, float]()
    ratios_covariance = np.zeros((0, 0))
    hypotheses: tuple[CusumHypothesis, ...] = ()
    expectations: list[Expectation] = []
    known: tuple[tuple[str, ...], FloatArray, FloatArray] | None = None
    if population is not None:
        member, note = population.describe(theta, theta_covariance + population.scatter / len(recordings))
        notes.append(note)
        population = population if member else None
    if can_simulate(loop):
        from scipy import special

        progress("healthy parameters")
        noise = split_residual_noise(pipeline, fit, regressions)
        expectations = [Expectation(pipeline, fit.tuning, noise, reference_path(rec)) for rec in recordings]
        if exact:
            theta = model_theta = expectations[0].batch_estimate(loop.plant)
        else:
            healthy = fit_healthy_plant(expectations, regressions, fit, nominal_theta(loop), fit.tuning.noise)
            # covariates are taken out of the regressions, not of the recordings
            innovations = None if covariates is not None else fit_innovations(loop, recordings, noise)
            if innovations is not None and innovations.contradicts(np.log(list(healthy.ratios.values()))):
                # what y does between the samples is part of the recursion's residual, as if it were noise
                known = innovations.names, innovations.x, innovations.covariance
                noise = innovations.noise
                if len(innovations.names) > len(loop.plant.parameters):
                    notes.append(message("learning.wrong_file", share=FILE_ERROR))
                healthy = describe_healthy_plant(expectations, regressions, fit, *known)
            # what the plant leaves of the residual is noise alone: its colour is known better now
            plant = loop.plant.scaled(healthy.ratios)
            gamma = sample_autocovariance(healthy.residuals, AR_ORDER)
            silent = not gamma[0] > ROUNDING_SHARE * fit.tuning.R  # simulated without noise, for example
            model = fit.tuning.noise if silent else yule_walker(gamma)
            if pipeline.stage_one is None and not silent:
                noises = fit_white_noise(residual_system(pipeline, plant), healthy.residuals, pipeline.stride)
                if prefers_white_noise(healthy.residuals, noises, model):
                    noise, loudest = noises.noise, noises.loudest
                    model = residual_noise_model(pipeline, plant, noise)
                    fit = replace(fit, tuning=replace(fit.tuning, noise=model))
            expectations = [replace(e, tuning=fit.tuning, noise=noise) for e in expectations]
            if known is not None:
                healthy = describe_healthy_plant(expectations, regressions, fit, *known)
            else:
                healthy = fit_healthy_plant(expectations, regressions, fit, healthy.true_theta, model)
            if population is not None:
                x = np.log(list(healthy.ratios.values()))
                shared = population.combine_ratios(tuple(healthy.ratios), x, healthy.covariance)
                if shared is not None:
                    healthy = describe_healthy_plant(expectations, regressions, fit, *shared)
            ratios, ratios_std, model_theta = healthy.ratios, healthy.std(), healthy.theta
            plant = loop.plant.scaled(ratios)
            # each reference has its own bias
            deviations_between = fit.each - np.array([e.batch_estimate(plant) for e in expectations])
            ratios_covariance = healthy.covariance
            if healthy.misfit <= special.chdtri(pipeline.bank.n, MIN_PHYSICS_PROBABILITY):
                # the physics hold: what they say is known better than the coefficients one by one
                theta, theta_covariance = model_theta, healthy.theta_covariance
                by_chance = homogeneity.scatter_probability(deviations_between, fit.each_covariance)
                # it takes the parameters for constant: where they scatter, healthy recordings would be alarms
                sequential = by_chance > homogeneity.SCATTER_BY_CHANCE and (population is None or population.sequential)
                if loudest and not loop.monitor.model_error and covariates is None and sequential:
                    progress("rehearsal")
                    calibration, hypotheses, warnings = design_sequential_test(
                        recordings, expectations, plant, healthy.theta, healthy.covariance, loudest
                    )
                    notes += warnings
            if healthy.misfit > 10.0 * pipeline.bank.n:
                notes.append(message("learning.physics_misfit", misfit=healthy.misfit, expected=pipeline.bank.n))
    axis: AxisModel | None = None
    if isinstance(loop.plant, AxisPlant):
        axis, warnings = fit_axis(loop, recordings)
        notes += warnings
        if axis is not None:  # scatter between recordings; a change within one is told from its own past
            error += np.diag(axis.scatter(pipeline.bank.names) ** 2)
    between = homogeneity.scatter(deviations_between, fit.each_covariance)
    own_scatter = homogeneity.between_covariance(deviations_between, fit.each_covariance)
    if population is not None:
        pooled = population.pooled_scatter(own_scatter, m)
        between = pooled * (1.0 + 1.0 / m)
        if not ratios:
            theta, theta_covariance = population.theta.combine(theta, theta_covariance + pooled / m)
            between = pooled  # what the mean of m recordings is off by is in the covariance of theta now
    outliers = homogeneity.find_outliers(deviations_between, fit.each_covariance + error)
    notes += homogeneity.describe_outliers(outliers, [rec.name for rec in recordings], pipeline.bank.names)
    tuning = replace(fit.tuning, theta=theta)
    plant = loop.plant.scaled(ratios) if ratios else loop.plant
    progress("features")
    features = None
    if covariates is None:  # features move with covariates too, and nothing says how
        features, warnings = learn_features(loop, recordings)
        notes += warnings
    limit = t2_threshold(loop, pipeline.bank.n, fit.dof, calibration, bool(hypotheses), features is not None)
    progress("promises")
    along = [
        None if covariates is None else CovariatePath.of(covariates, theta, rec.channels, pipeline.memory_samples)
        for rec in recordings
    ]
    estimates = [
        pipeline.estimate(tuning if path is None else replace(tuning, theta=path.start), rec)
        for rec, path in zip(recordings, along, strict=True)
    ]
    expected = [replace(e, tuning=tuning).healthy_path(plant, model_theta) for e in expectations] or [theta] * len(
        estimates
    )
    expected = [
        mean if path is None else mean + (path.expected(e.index) - theta)
        for mean, e, path in zip(expected, estimates, along, strict=True)
    ]
    deviations = [e.theta - mean for e, mean in zip(estimates, expected, strict=True)]
    paths = [(d[e.updates > 0], e.S[e.updates > 0]) for d, e in zip(deviations, estimates, strict=True)]
    shares = [e.Psi for e in estimates]
    between = homogeneity.cover_transients(between, shares)
    others = homogeneity.scatter_of_others(deviations_between, fit.each_covariance, shares)
    told = others if population is None else [between] * m
    factor, left_out = homogeneity.leave_one_out(paths, deviations_between, told, theta_covariance + error, limit)
    covariance = theta_covariance + factor * between + error
    notes += noise_notes(pipeline, fit, estimates, can_simulate(loop))
    excess, suggestion = detectability.baseline_misfit(estimates, deviations, covariance, fit)
    if fit.explained < MIN_EXPLAINED_SHARE:
        notes.append(message("learning.hardly_explained", share=fit.explained))
    duration = sum(rec.duration_s for rec in recordings)
    if excess > detectability.MAX_T2_PER_COEFFICIENT and loop.monitor.model_error < suggestion:
        notes.append(message("learning.model_error", excess=excess, model_error=suggestion))
    if duration < (least := MIN_MEMORIES * loop.monitor.memory):
        notes.append(message("learning.short", duration_s=duration, memory_s=loop.monitor.memory, least_s=least))
    supported = supported_budget(pipeline.bank.n, loop, fit.dof, excess)
    if supported > (budget := loop.monitor.false_alarms_per_year):
        notes.append(message("learning.budget", supported=supported, budget=budget))
    directions = fault_directions(loop, plant, theta)
    baseline = Baseline(
        loop=loop.to_dict(),
        sources=tuple(BaselineSource(name=r.name, samples=r.samples, duration_s=r.duration_s) for r in recordings),
        hash=digest(loop, [a for rec in recordings for a in (rec.t, rec.r, rec.u, rec.y)]),
        names=pipeline.bank.names,
        theta=tuple(theta),
        covariance=to_tuples(covariance),
        scale=tuple(tuning.scale),
        P_d=to_tuples(tuning.P_d),
        stage_one=pipeline.stage_one,
        R=tuning.R,
        noise_a=tuple(tuning.noise.a),
        noise_b=tuple(tuning.noise.b),
        noise_gamma=tuple(tuning.noise.gamma),
        noise_variance=tuning.noise.variance,
        noise=noise,
        ratios=ratios,
        ratios_std=ratios_std,
        ratios_covariance=to_tuples(ratios_covariance),
        model_theta=tuple(model_theta),
        dof=fit.dof,
        limit=limit,
        explained=fit.explained,
        still_speed=pipeline.still_speed,
        delay_s=delay_s,
        suggested_model_error=suggestion,
        supported_false_alarms_per_year=supported,
        loudest=loudest,
        rehearsed=calibration,
        members=hypotheses,
        promises=detectable_changes(loop, directions, estimates, covariance, limit),
        notes=tuple(notes),
        sensors=learn_sensors(loop, recordings),
        instrument=pipeline.instrument,
        features=features,
        left_out=tuple(left_out),
        motion=learn_motion(pipeline, recordings),
        axis=axis,
        covariates=covariates,
        scatter=to_tuples(own_scatter) if m > 1 else (),
    )
    progress("predictor")
    predictor = None if covariates is not None else fit_exact_predictor(baseline, recordings)
    if predictor is not None and predictor.misfit > 1.0:
        notes.append(message("learning.no_refit", misfit=predictor.misfit))
    return baseline.model_copy(update={"exact": predictor, "notes": tuple(notes)})
