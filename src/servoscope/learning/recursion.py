"""The first step of learning: recordings that can be learned from -> regressors and the tuning of the recursion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from servoscope.baseline.plant_fit import MAX_SATURATED_SHARE, can_simulate, saturated_share
from servoscope.baseline.records import RecursionTuning
from servoscope.core.arrays import to_tuples
from servoscope.core.errors import NotEnoughError, RecordingError
from servoscope.core.messages import Message, message
from servoscope.estimation import two_stage
from servoscope.estimation.filter_bank import nominal_theta
from servoscope.estimation.pipeline import Pipeline, Regression, Tuning
from servoscope.evidence.covariates import MIN_SAMPLES_PER_COEFFICIENT, fit_covariates
from servoscope.evidence.kind import HealthyRecordings
from servoscope.evidence.population import Population
from servoscope.evidence.signals import describe_misfit, find_signal_defect
from servoscope.evidence.warm_up import fit_warm_up
from servoscope.fit.tuning import TuningFit, fit_tuning
from servoscope.learning.instrument import learn_instrument, learns_instrument
from servoscope.models.loop import Loop
from servoscope.models.lti import settling_samples
from servoscope.signals import Recording

SPEED_OVER = 0.05  # s over which a speed is measured here
REST_SPEED_SHARE = 0.02  # of the speed of motion, below which an axis stands still
MIN_INSTRUMENT_EIGENVALUE = 0.05  # below, the instrument says too little of the regressor to be worth its variance


def leave_out_defects(loop: Loop, recordings: Sequence[Recording]) -> tuple[list[Recording], list[Message]]:
    """Return the recordings in which no signal is stuck or wraps, and a note for each of the others.

    Raises RecordingError where all have such a defect.
    """
    defects = [find_signal_defect(recording, loop.delay) for recording in recordings]
    known = [(rec, defect) for rec, defect in zip(recordings, defects, strict=True) if defect is not None]
    if len(known) == len(recordings):
        recording, defect = known[0]
        raise RecordingError(f"{recording.name}: {defect.description}; or leave that part out")
    notes = [message("learning.defect", recording=rec.name, reason=defect.description) for rec, defect in known]
    return [rec for rec, defect in zip(recordings, defects, strict=True) if defect is None], notes


def check_signals(loop: Loop, recording: Recording) -> None:
    """Refuse a recording with exchanged signals, of another sign or unit, or with u at its limits."""
    if loop.plant.has_physics:
        plain = loop.model_copy(update={"monitor": loop.monitor.model_copy(update={"two_stage": "none"})})
        misfit = describe_misfit(Pipeline.of(plain), nominal_theta(loop), recording)
        if misfit is not None:
            raise RecordingError(f"{recording.name}: {misfit}")
    if (share := saturated_share(loop, recording)) > MAX_SATURATED_SHARE:
        raise NotEnoughError(
            f"{recording.name}: u is at a limit in {share:.0%} of the rows: lower the demand, or check input_limits"
        )


def form_healthy_recordings(
    loop: Loop, recordings: Sequence[Recording], population: Population | None = None
) -> HealthyRecordings:
    """Tune the recursion to recordings, and take out of them what covariates or a warm-up move."""
    pipeline, regressions, fit, notes = _tune(loop, recordings)
    covariates = None
    if loop.columns.covariates or loop.monitor.hidden_warm_up:
        fit_them = fit_warm_up if loop.monitor.hidden_warm_up else fit_covariates
        covariates, regressions, fit, recordings = fit_them(pipeline, recordings, regressions, fit)
    healthy = HealthyRecordings(pipeline.loop, recordings, pipeline, regressions, fit, covariates, notes=notes)
    return healthy if population is None else _among(healthy, population)


def _among(healthy: HealthyRecordings, population: Population) -> HealthyRecordings:
    """Return the recordings of a machine that is one of a population, or that is said to be none of it."""
    theta, C = healthy.fit.tuning.theta, healthy.fit.covariance
    member, note = population.describe(theta, C + population.scatter / len(healthy.recordings))
    return replace(healthy, population=population if member else None, notes=[*healthy.notes, note])


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


def tune_pipeline(loop: Loop, recordings: Sequence[Recording]) -> tuple[Pipeline, list[Regression], TuningFit]:
    """Return the pipeline, the regressors of the recordings, and the recursion's tuning to them."""
    pipeline = Pipeline.of(loop, two_stage.tune_stage_one(loop, recordings), still_speed(loop, recordings))
    regressions = [pipeline.regression(rec.r, rec.u, rec.y, rec.restart) for rec in recordings]
    fewest = MIN_SAMPLES_PER_COEFFICIENT * pipeline.bank.n
    for rec, g in zip(recordings, regressions, strict=True):
        if (usable := int(g.ok.sum())) < fewest:
            raise NotEnoughError(
                f"{rec.name}: only {usable} usable samples of at least {fewest} {_what_to_change(loop)}"
            )
    return pipeline, regressions, fit_tuning(pipeline, regressions)


def _what_to_change(loop: Loop) -> str:
    """Return what took the samples of a recording away, and which keys of the loop file change that."""
    rate = loop.sample_rate
    settled = f"when filters have settled for {settling_samples(loop.cutoff, 4, 1.0 / rate) / rate:.3g} s"
    longer = "record longer, raise cutoff"
    match loop.monitor.update_when:
        case "moving":
            return f"{settled} and rest is left out: {longer}, lower rest_speed, or learn without it"
        case "auto":
            return f'{settled} and rest is left out: {longer}, or write update_when = "always" under [monitor]'
    return f"{settled}: {longer}"


def _tune(
    loop: Loop, recordings: Sequence[Recording]
) -> tuple[Pipeline, Sequence[Regression], TuningFit, list[Message]]:
    """Tune the recursion, with an instrument where noise in y biases least squares; the pipeline's loop tells."""
    plain = loop.model_copy(update={"monitor": loop.monitor.model_copy(update={"estimator": "akf"})})
    if not learns_instrument(loop):
        pipeline, regressions, fit = tune_pipeline(loop, recordings)
        if fit.strength >= MIN_INSTRUMENT_EIGENVALUE:
            return pipeline, regressions, fit, []
        note = message("learning.weak_instrument", strength=fit.strength, least=MIN_INSTRUMENT_EIGENVALUE)
        return *tune_pipeline(plain, recordings), [note]
    pipeline, regressions, fit = tune_pipeline(plain, recordings)
    instrumental_fit, notes = learn_instrument(pipeline, recordings, fit)
    if instrumental_fit is None:
        return pipeline, regressions, fit, notes
    return instrumental_fit.pipeline, instrumental_fit.regressions, instrumental_fit.fit, notes


def describe_recursion(pipeline: Pipeline, tuning: Tuning) -> RecursionTuning:
    """Return what a baseline keeps of a pipeline and its tuning."""
    return RecursionTuning(
        scale=tuple(tuning.scale),
        P_d=to_tuples(tuning.P_d),
        R=tuning.R,
        noise_a=tuple(tuning.noise.a),
        noise_b=tuple(tuning.noise.b),
        noise_gamma=tuple(tuning.noise.gamma),
        noise_variance=tuning.noise.variance,
        stage_one=pipeline.stage_one,
        instrument=pipeline.instrument,
        still_speed=pipeline.still_speed,
    )
