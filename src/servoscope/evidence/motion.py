"""A motion that the healthy recordings do not hold: what was seen of it, what was not, and what that means."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from servoscope.baseline.motion import QUANTITIES, learn_motion
from servoscope.baseline.plant_fit import share_at_limits
from servoscope.core import outofcore
from servoscope.core.messages import Message, message
from servoscope.detection.trace import UNSEEN_EXCESS
from servoscope.evidence.examination import Examination
from servoscope.evidence.kind import EvidenceKind, Finding

MIN_SATURATED_SHARE = 0.05  # share of the samples with u at a limit that is worth telling


def _judge(exam: Examination) -> Iterator[Finding]:
    """Yield that y never moves, that an alarm came under a motion never seen, or that one was withheld for it."""
    if np.ptp(outofcore.extremes(exam.recording.y)) == 0.0:  # without the noise that every likelihood divides by
        yield Finding.throughout(exam, "undetermined", "motion", message("warning.no_motion"))
    elif not exam.apparent_alarm.any() or exam.baseline.extrapolates:
        return
    elif exam.motion is None:
        yield Finding.throughout(exam, "doubt", "motion", message("warning.motion_not_stored"))
    else:
        yield from _doubt_motion(exam)


def _doubt_motion(exam: Examination) -> Iterator[Finding]:
    alarm = exam.alarm if exam.alarm.any() else exam.apparent_alarm
    ratio = np.where(alarm, np.maximum(exam.statistic / exam.baseline.thresholds.statistic, exam.estimates.level), -1.0)
    at = int(np.argmax(ratio))
    withheld = not exam.alarm.any()
    if not withheld and exam.motion_excess(slice(at, at + 1))[0] < UNSEEN_EXCESS:
        return
    values = {"quantities": _describe_quantities(exam, at), "saturated": _describe_saturation(exam)}
    key = "warning.motion_withheld" if withheld else "warning.motion_unseen"
    yield Finding.throughout(exam, "doubt", "motion", message(key, **values))


def _describe_quantities(exam: Examination, at: int) -> tuple[Message, ...]:
    """Return the quantities that are outside, each with its value and with what the baseline holds."""
    seen = exam.baseline.limited_motion
    assert exam.motion is not None and seen is not None
    row, unit = slice(at, at + 1), exam.baseline.plant.units[0]
    excess, (values, _) = exam.motion.excess(seen, row)[0], exam.motion.quantities(row)
    worst = float(np.abs(excess).max())
    findings = []
    for k in np.flatnonzero(np.abs(excess) >= min(UNSEEN_EXCESS, worst)):
        least, most = (np.array(x)[:, 1, k] for x in (seen.least, seen.most))
        y = values[0, :, 1, k]
        window = int(np.argmax(y / most if excess[k] > 0.0 else -y / np.maximum(least, np.finfo(np.float64).tiny)))
        findings.append(
            message(
                f"motion.{QUANTITIES[k]}",
                value=float(y[window]),
                low=float(least[window]),
                high=float(most[window]),
                unit=unit or "y",
            )
        )
    return tuple(findings)


def _describe_saturation(exam: Examination) -> Message | None:
    share = share_at_limits(exam.baseline.loop, exam.recording)
    return message("motion.saturated", share=share) if share > MIN_SATURATED_SHARE else None


MOTION = EvidenceKind("motion", lambda healthy, _: (learn_motion(healthy.pipeline, healthy.recordings), ()), _judge)
