"""How far theta is from healthy over a whole stretch of a recording: least squares instead of the recursion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servoscope.candidates import candidates_of
from servoscope.detection import Onset
from servoscope.errors import NotEnoughError, RecordingError
from servoscope.examination import Examination
from servoscope.isolation import Signature
from servoscope.plants import FloatArray
from servoscope.signatures import Expectation, course
from servoscope.tuning import fit

LONGEST = 500_000  # samples of a stretch; more of them say no more


@dataclass(frozen=True, eq=False)
class Steady:
    """theta minus its healthy expectation, shape (n,), and the covariance of its noise, shape (n, n)."""

    deviation: FloatArray
    covariance: FloatArray


def steady(x: Examination, from_s: float, to_s: float = np.inf) -> Steady:
    """Return the deviation over the samples from_s <= t < to_s; the noise is that of the stretch itself.

    Raises
    ------
    NotEnoughError
        If the stretch is too short or does not excite all coefficients.
    """
    baseline, name = x.baseline, x.recording.name
    try:
        rec = x.recording.part(from_s, to_s)
        found = fit(x.pipeline, [x.pipeline.regression(rec.r, rec.u, rec.y, rec.restart)])
    except RecordingError as error:
        raise NotEnoughError(f"{name}, from {from_s:.4g} s on: {error}") from None
    expected = np.array(baseline.theta)
    if x.noise is not None:  # the bias that this reference has under any plant
        bias = Expectation(x.pipeline, x.tuning, x.noise, course(rec)).batch(baseline.plant)
        expected = expected + bias - np.array(baseline.model_theta)
    return Steady(found.each[0] - expected, found.each_covariance[0])


def isolation_inputs(x: Examination, since: Onset, at: int) -> tuple[list[Signature], FloatArray, FloatArray]:
    """Return what isolation compares after an alarm: signatures, the deviation (n,) and its covariance (n, n).

    Labels that point nearly the same way are told apart by the whole stretch since the onset better than by the last
    memory of it, so it is taken where a baseline has labels; not where curves are simulated, which are those of the
    recursion.

    Parameters
    ----------
    since
        Onset of the change.
    at
        Evaluation that is explained.
    """
    recording, e, last = x.recording, x.estimates, int(x.estimates.index[at])
    first = x.recalled(at)
    C, settled = x.baseline.cov(), False
    deviation, covariance = e.theta[at] - x.expected[at], e.S[at] * max(1.0, float(e.power[at]))
    if x.baseline.learned and x.noise is None:
        begin = max(since.likely_s, float(recording.t[max(last - LONGEST, 0)]))
        try:
            whole = steady(x, begin, float(recording.t[last]) + 0.5 / recording.sample_rate)
        except NotEnoughError:
            pass  # the recursion, which starts from healthy, needs no more than the alarm did
        else:
            deviation, covariance, settled = whole.deviation, whole.covariance, True
    expectation = x.expectation(first, last + 1) if x.noise is not None else None
    recalled = recording.rows(slice(first, last + 1))
    signatures = candidates_of(x.baseline, recalled, expectation, max(since.sample - first, 0), settled)
    return signatures, deviation, covariance + C
