"""How far theta is from healthy over a whole stretch of a recording: least squares instead of the recursion."""

from __future__ import annotations

import contextlib

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.expectation import Expectation, reference_path
from servoscope.baseline.pressure_model import PIECE_S
from servoscope.baseline.residual_model import StretchFit
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import NotEnoughError, RecordingError
from servoscope.detection.onset import Onset
from servoscope.diagnosis.pressure_evidence import pressure_inputs
from servoscope.evidence.examination import Examination
from servoscope.fit.instrumental_fit import InstrumentalFit, fit_with_instrument
from servoscope.fit.tuning import fit_tuning
from servoscope.isolation.signature import Signature
from servoscope.isolation.signatures import fault_signatures

MAX_STRETCH_SAMPLES = 200_000  # of a stretch; more add nothing but memory
MIN_ONSET_GAIN = 1.5  # of T^2 by rows from the onset on, over that of all rows: a change from the first sample has none
HALF_STRETCH_TOLERANCE = 0.05  # stated relative deviation, up to which half a stretch is enough


def stretch_begin(baseline: Baseline, low_s: float, high_s: float) -> float:
    """Return from when on a recording is taken for changed, by the 95 % interval of its onset [s].

    Directions are learned and compared from the earliest onset on: cutting a motion elsewhere turns them more than some
    healthy samples do. A fit by an instrument, whose deviation is small, may have nothing from before the change.
    """
    return low_s if baseline.recursion.instrument is None else high_s


def estimate_batch_deviation(exam: Examination, from_s: float, to_s: float = np.inf) -> tuple[FloatArray, FloatArray]:
    """Return theta minus its healthy expectation over from_s <= t < to_s, (n,), and the covariance of its noise (n, n).

    Raises NotEnoughError if the stretch is too short or does not excite all coefficients.
    """
    baseline, name = exam.baseline, exam.recording.name
    if baseline.recursion.instrument is not None:
        return _deviation_by_instrument(exam, from_s, to_s)
    try:
        rec = exam.recording.part(from_s, to_s)
        tuning = fit_tuning(exam.pipeline, [exam.pipeline.regression(rec.r, rec.u, rec.y, rec.restart)])
    except RecordingError as error:
        raise NotEnoughError(f"{name}, from {from_s:.4g} s on: {error}") from None
    expected = np.array(baseline.theta)
    if exam.noise is not None:  # the bias that this reference has under any plant
        bias = Expectation(exam.pipeline, exam.tuning, exam.noise, reference_path(rec)).batch_estimate(baseline.plant)
        expected = expected + bias - np.array(baseline.healthy.theta)
    return tuning.each[0] - expected, tuning.each_covariance[0]


def _deviation_by_instrument(exam: Examination, from_s: float, to_s: float) -> tuple[FloatArray, FloatArray]:
    """Return what `estimate_batch_deviation` does, with an instrument of the changed plant itself.

    The second half of the stretch speaks where it knows enough: a gradual change is over by then, as a rule.
    """
    fit, end_s = _fit_stretch(exam, from_s, to_s), min(to_s, float(exam.recording.t[-1]))
    with contextlib.suppress(NotEnoughError):
        half = _fit_stretch(exam, 0.5 * (from_s + end_s), to_s)
        fit = half if half.deviation <= HALF_STRETCH_TOLERANCE else fit
    return fit.fit.tuning.theta - np.array(exam.baseline.theta), fit.fit.covariance


def _fit_stretch(exam: Examination, from_s: float, to_s: float) -> InstrumentalFit:
    """Return the fit of a stretch by an instrument; NotEnoughError where it cannot be trusted."""
    baseline, name = exam.baseline, exam.recording.name
    assert baseline.recursion.instrument is not None
    try:
        rec = exam.recording.part(from_s, to_s)
        estimate = fit_with_instrument(
            exam.pipeline, [rec], baseline.recursion.instrument.source, np.array(baseline.theta)
        )
    except (RecordingError, np.linalg.LinAlgError) as error:
        raise NotEnoughError(f"{name}, from {from_s:.4g} s on: {error}") from None
    if estimate is None or not estimate.trusted:
        raise NotEnoughError(f"{name}, from {from_s:.4g} s on: noise in y hides the coefficients, record longer")
    return estimate


def isolation_inputs(exam: Examination, onset: Onset, at: int) -> tuple[list[Signature], FloatArray, FloatArray]:
    """Return what isolation compares after an alarm: signatures, the deviation (n,) and its covariance (n, n).

    Learned faults whose directions are close are separated better by the whole stretch since the onset than by the last
    memory of it, so a baseline that has some uses it; not where signatures are simulated, which are the recursion's.
    With a learned instrument it is used too: the recursion's is of the healthy plant, which large changes leave behind.
    And so it is where healthy recordings show how such fits scatter: what no term explains repeats with the motion.
    """
    recording, e, last = exam.recording, exam.estimates, int(exam.estimates.index[at])
    first, whole, healthy = exam.memory_start(at), None, np.array(exam.baseline.theta)
    if (exam.baseline.learned or exam.baseline.recursion.instrument is not None) and exam.noise is None:
        begin = max(
            stretch_begin(exam.baseline, onset.low_s, onset.high_s),
            float(recording.t[max(last - MAX_STRETCH_SAMPLES, 0)]),
        )
        # where it is not enough, the recursion, which starts from healthy, needs no more than the alarm did
        with contextlib.suppress(NotEnoughError):
            whole = estimate_batch_deviation(exam, begin, float(recording.t[last]) + 0.5 / recording.sample_rate)
    known = exam.baseline.covariance_array()
    recursive = e.theta[at] - exam.expected[at], e.S[at] * max(1.0, float(e.power[at])) + known
    if whole is not None:
        whole = whole[0], whole[1] + known
    elif exam.pressures is not None:
        begin = onset.sample // round(PIECE_S * recording.sample_rate)
        return pressure_inputs(exam.pressures, exam.baseline.plant, begin)
    elif (fit := _surest_fit(exam, onset, last)) is not None:
        whole, healthy = fit[:2], fit.healthy
    deviation, covariance = whole or recursive
    expectation = exam.expectation(first, last + 1) if exam.noise is not None else None
    recalled = recording.rows(slice(first, last + 1))
    baseline = exam.baseline.model_copy(update={"theta": tuple(healthy.tolist())})
    settled = whole is not None
    signatures = fault_signatures(baseline, recalled, expectation, max(onset.sample - first, 0), settled)
    model_error = exam.model_error(slice(at, at + 1))[0]
    return signatures, deviation, covariance + model_error


def _surest_fit(exam: Examination, onset: Onset, last: int) -> StretchFit | None:
    """Return a fit to the rows from an onset to the last one, or to all rows where that is surer; None: neither.

    Fits that are compared by motion serve where the recursion raised no alarm: the change may have been there from the
    first sample on.
    """
    recording, model = exam.recording, exam.baseline.residual
    if model is None or (model.like is not None and exam.recursion_alarm.any()):
        return None
    begin = onset.sample
    if last - begin < exam.pipeline.memory_samples:  # such an onset is hardly known: all of its interval counts
        begin = round((onset.low_s - float(recording.t[0])) * recording.sample_rate)
    theta, rows = np.array(exam.baseline.theta), slice(begin, last + 1)
    fit, whole = model.deviation_of_rows(exam.pipeline, recording, rows, theta, exam.along), exam.whole_fit
    if fit is None or not np.isfinite(fit.deviation).all():
        fit = None
    if model.like is None or whole is None or not np.isfinite(whole.deviation).all():
        return fit
    if fit is not None and fit.t2 > MIN_ONSET_GAIN * whole.t2:
        return fit
    return whole._replace(covariance=np.array(model.like.covariance))
