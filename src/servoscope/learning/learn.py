"""Healthy recordings -> Baseline, in steps: each returns a small record of what it found."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from servoscope.assessment.assess import DOUBTS, judge
from servoscope.baseline.axis_model import AxisModel, AxisMoves
from servoscope.baseline.baseline import Baseline
from servoscope.baseline.records import BaselineSource, ExactPredictorFit, HealthyScatter, digest
from servoscope.core.arrays import to_tuples
from servoscope.core.blas import with_one_blas_thread
from servoscope.core.errors import BaselineError, LoopError, NotEnoughError
from servoscope.core.messages import Message, message
from servoscope.estimation import estimators
from servoscope.evidence.features import MIN_RECORDINGS, are_expected
from servoscope.evidence.kind import HealthyRecordings
from servoscope.evidence.kinds import learn_evidence
from servoscope.evidence.population import Population
from servoscope.evidence.residual import MIN_RECORDINGS as MIN_RECORDINGS_OF_RESIDUAL
from servoscope.evidence.signals import find_switched_off
from servoscope.isolation.ml.validity import fit_exact_predictor
from servoscope.learning.axis_fit import fit_axis
from servoscope.learning.delay import check_delay
from servoscope.learning.detectability import learn_detectability
from servoscope.learning.healthy_plant import PlantKnowledge, learn_plant, learn_sequential_test
from servoscope.learning.pressures import learn_pressures
from servoscope.learning.recursion import (
    check_signals,
    describe_recursion,
    form_healthy_recordings,
    leave_out_defects,
    tune_pipeline,
)
from servoscope.learning.scatter import follow_recordings, learn_scatter, learn_thresholds, widen_scatter
from servoscope.models.loop import Loop
from servoscope.models.plants.axis import AxisPlant
from servoscope.signals import Recording
from servoscope.simulation import reference, simulate

MAX_SIMULATED_SAMPLES = 2e6  # samples behind a nominal baseline

Progress = Callable[[str], None]


def doubt_healthy(recording: Recording) -> Message | None:
    """Return what a recording shows by itself that forbids learning from it, if it does."""
    verdict, reason = judge(recording, recording.name)
    return message("learning.doubt", recording=recording.name, reason=reason) if verdict in DOUBTS else None


@with_one_blas_thread
def learn_baseline(
    loop: Loop,
    recordings: Sequence[Recording],
    progress: Progress = lambda _: None,
    accept_delay: bool = False,
    population: Population | None = None,
    earlier: Baseline | None = None,
) -> Baseline:
    """Learn what healthy looks like.

    With several recordings their scatter counts; a population of like machines is a prior, and so is the scatter of an
    earlier baseline of this machine. NotEnoughError: too short or too little excitation; RecordingError: u and y are
    out of step, unless that is accepted.
    """
    if not recordings:
        raise NotEnoughError("no recording to learn from: give at least one healthy recording")
    progress("regressors")
    try:
        recordings, left_out = leave_out_defects(loop, recordings)
        for rec in recordings:
            check_signals(loop, rec)
        if loop.columns.covariates or loop.monitor.hidden_warm_up:
            progress("covariates")
        healthy = form_healthy_recordings(loop, recordings, population)
        progress("delay")
        delay_s, notes = check_delay(healthy.loop, healthy.recordings, accept_delay)
        name = healthy.loop.monitor.estimator
        simplified = [
            message("learning.simplified_estimator", estimator=name, reason=reason)
            for check, reason in estimators.exceptions(name).items()
            if check in ("mean", "covariance")
        ]
        doubts = [doubt for rec in recordings if (doubt := doubt_healthy(rec)) is not None]
        off = [defect.description for defect in map(find_switched_off, healthy.recordings) if defect is not None]
        healthy = replace(healthy, notes=[*left_out, *healthy.notes, *simplified, *notes, *doubts, *off])
        progress("healthy parameters")
        return _assemble_baseline(healthy, learn_plant(healthy), delay_s, progress, earlier)
    except np.linalg.LinAlgError as error:
        names = ", ".join(rec.name for rec in recordings[:3])
        raise NotEnoughError(
            f"{names}: the motion does not distinguish the coefficients ({error}): record a motion with more "
            "excitation, or take a plant with fewer of them"
        ) from None


def nominal_baseline(loop: Loop, progress: Progress = lambda _: None, duration_s: float = 60.0) -> Baseline:
    """Compute the baseline from the plant's nominal parameters, as the paper does, instead of learning it.

    The recursion is tuned on a simulated healthy recording (the built-in profile at the paper's noise).

    Raises LoopError if the plant's nominal values or the controller are missing.
    """
    if not loop.plant.has_physics or loop.controller is None:
        raise LoopError(f"{loop.name}: a nominal baseline needs [controller] and the plant's nominal values")
    duration_s = min(duration_s, MAX_SIMULATED_SAMPLES / loop.sample_rate)
    simulated, _ = simulate(loop, reference("profile", duration_s, loop.sample_rate))
    pipeline, regressions, fit = tune_pipeline(loop, [simulated])
    note = message("learning.nominal")
    healthy = HealthyRecordings(loop, [simulated], pipeline, regressions, fit, notes=[note])
    return _assemble_baseline(healthy, learn_plant(healthy, exact=True), loop.delay, progress)


def _learn_axis(healthy: HealthyRecordings, earlier: Baseline | None) -> tuple[AxisModel | None, list[Message]]:
    if not isinstance(healthy.loop.plant, AxisPlant):
        return None, []
    model = healthy.covariates
    logged = model is not None and model.warm_up is None
    moves = AxisMoves(covariates=model, names=healthy.pipeline.bank.names) if logged and model is not None else None
    axis, notes = fit_axis(healthy.loop, healthy.recordings, moves)
    if axis is not None and earlier is not None and earlier.axis is not None:
        axis = axis.with_scatter(earlier.axis)
    return axis, notes


def _richer_baseline(earlier: Baseline | None, healthy: HealthyRecordings) -> Baseline | None:
    """Return an earlier baseline that knows the scatter of more recordings than these; None where there is none."""
    own = healthy.pipeline.bank.names
    if earlier is not None and earlier.names != own:
        names = ", ".join(earlier.names), ", ".join(own)
        raise BaselineError(f"the earlier or like baseline has coefficients {names[0]}, this loop {names[1]}")
    return earlier if earlier is not None and len(healthy.recordings) < earlier.scatter_from else None


def _assemble_baseline(
    healthy: HealthyRecordings,
    plant: PlantKnowledge,
    delay_s: float | None,
    progress: Progress,
    earlier: Baseline | None = None,
) -> Baseline:
    loop, recordings, pipeline = healthy.loop, healthy.recordings, healthy.pipeline
    progress("rehearsal")
    before = _richer_baseline(earlier, healthy)
    scatters = before is not None and not before.thresholds.hypotheses
    calibration, hypotheses, test_notes = learn_sequential_test(healthy, plant, scatters)
    axis, axis_notes = _learn_axis(healthy, before)
    scatter = learn_scatter(healthy, plant, None if axis is None else axis.scatter(pipeline.bank.names), before)
    thresholds = learn_thresholds(healthy, calibration, hypotheses, are_expected(loop, recordings))
    progress("promises")
    paths = follow_recordings(healthy, plant, scatter.theta)
    covariance, left_out, transient = widen_scatter(healthy, plant, scatter, paths, thresholds.statistic)
    transient = transient if earlier is not None else 0.0 * transient
    detectability, limits = learn_detectability(healthy, plant, paths, scatter, covariance, transient, thresholds)
    notes = [*healthy.notes, *plant.notes, *test_notes, *axis_notes, *scatter.notes, *limits]
    between = to_tuples(scatter.own) if len(recordings) > 1 else ()
    baseline = Baseline(
        loop=loop.to_dict(),
        sources=tuple(BaselineSource(name=r.name, samples=r.samples, duration_s=r.duration_s) for r in recordings),
        hash=digest(loop, [a for rec in recordings for a in (rec.t, rec.r, rec.u, rec.y)]),
        names=pipeline.bank.names,
        theta=tuple(scatter.theta),
        covariance=to_tuples(covariance),
        recursion=describe_recursion(pipeline, plant.fit.tuning),
        healthy=plant.describe(),
        scatter=HealthyScatter(
            between=between,
            left_out=tuple(left_out),
            carried=tuple(scatter.carried),
            carried_from=0 if before is None else before.scatter_from,
            transient=tuple(transient) if transient.any() else (),
        ),
        thresholds=thresholds,
        detectability=detectability,
        delay_s=delay_s,
        notes=tuple(notes),
        axis=axis,
        covariates=healthy.covariates,
    )
    progress("predictor")
    draft = _with_exact_predictor(baseline, recordings)
    progress("features")
    return _with_pressures(_carry_features(learn_evidence(healthy, draft), before), healthy)


def _with_pressures(baseline: Baseline, healthy: HealthyRecordings) -> Baseline:
    """Learn the pressures where they are logged, and promise what they or a fit to whole recordings detect."""
    model, residual = learn_pressures(healthy), baseline.residual
    notes, sizes = baseline.notes, [] if model is None else [model.detectable_changes]
    if model is None and healthy.loop.plant.channels:
        notes = (*notes, message("learning.no_pressures", needed=MIN_RECORDINGS_OF_RESIDUAL))
    if residual is not None and residual.halves:
        sizes.append(residual.detectable_changes(baseline.fault_directions, np.array(residual.halves)))
    changes = []
    for change in baseline.detectability.changes:
        known = [change.change or np.inf, *(own.get(change.parameter, np.inf) for own in sizes)]
        changes.append(change.model_copy(update={"change": min(filter(np.isfinite, known), default=None)}))
    detectability = baseline.detectability.model_copy(update={"changes": tuple(changes)})
    return baseline.model_copy(update={"pressures": model, "detectability": detectability, "notes": notes})


def _carry_features(baseline: Baseline, before: Baseline | None) -> Baseline:
    """Return a baseline with the features' scatter of an earlier one, and a note that its scatter counts."""
    if before is None:
        return baseline
    features = None if baseline.features is None else baseline.features.with_scatter(before.features)
    lacks = message("learning.carried_features", needed=MIN_RECORDINGS) if before.features and not features else None
    carried = message("learning.carried", known=before.scatter_from, own=len(baseline.sources), lacks=lacks)
    return baseline.model_copy(update={"features": features, "notes": (*baseline.notes, carried)})


def _with_exact_predictor(baseline: Baseline, recordings: Sequence[Recording]) -> Baseline:
    exact = _fit_exact_predictor(baseline, recordings)
    if exact is None or exact.misfit <= 1.0:
        return baseline.model_copy(update={"exact": exact})
    names = baseline.logged_covariates
    note = (
        message("learning.no_refit_along", names=names) if names else message("learning.no_refit", misfit=exact.misfit)
    )
    return baseline.model_copy(update={"exact": exact, "notes": (*baseline.notes, note)})


def _fit_exact_predictor(baseline: Baseline, recordings: Sequence[Recording]) -> ExactPredictorFit | None:
    """With covariates each recording has the plant at its own, and the noise is that of the loudest one."""
    model = baseline.covariates
    if model is None:
        return fit_exact_predictor(baseline, recordings)
    if model.warm_up is not None:
        return None
    means = [{name: float(np.nanmean(rec.channels[name])) for name in model.names} for rec in recordings]
    fits = [fit_exact_predictor(baseline.at(c), [rec]) for c, rec in zip(means, recordings, strict=True)]
    known = [fit for fit in fits if fit is not None]
    if len(known) < len(fits):
        return None
    loudest = max(known, key=lambda fit: fit.noise.u_std / fit.noise.y_std)
    return loudest.model_copy(update={"misfit": max(fit.misfit for fit in known)})
