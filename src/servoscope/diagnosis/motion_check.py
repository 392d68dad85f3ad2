"""A motion that the healthy recordings do not hold: what was seen of it, what was not, and what that means."""

from __future__ import annotations

import numpy as np

from servoscope.baseline.motion import QUANTITIES
from servoscope.baseline.plant_fit import share_at_limits
from servoscope.core.messages import Message, message
from servoscope.detection.trace import UNSEEN_EXCESS
from servoscope.diagnosis.examine import Examination
from servoscope.diagnosis.result import DiagnosisWarning
from servoscope.diagnosis.warnings import warning_throughout

MIN_SATURATED_SHARE = 0.05  # share of the samples with u at a limit that is worth telling


def motion_warnings(exam: Examination) -> list[DiagnosisWarning]:
    """Return a warning where an alarm came under a motion never seen, or one was withheld for it."""
    if not exam.apparent_alarm.any() or exam.baseline.extrapolates:
        return []
    if exam.motion is None:
        return [warning_throughout(exam, "motion", message("warning.motion_not_stored"))]
    alarm = exam.alarm if exam.alarm.any() else exam.apparent_alarm
    ratio = np.where(alarm, np.maximum(exam.statistic / exam.baseline.thresholds.statistic, exam.estimates.level), -1.0)
    at = int(np.argmax(ratio))
    withheld = not exam.alarm.any()
    if not withheld and exam.motion_excess(slice(at, at + 1))[0] < UNSEEN_EXCESS:
        return []
    values = {"quantities": _describe_quantities(exam, at), "saturated": _describe_saturation(exam)}
    key = "warning.motion_withheld" if withheld else "warning.motion_unseen"
    return [warning_throughout(exam, "motion", message(key, **values))]


def _describe_quantities(exam: Examination, at: int) -> tuple[Message, ...]:
    """Return the quantities that are outside, each with its value and with what the baseline holds."""
    seen = exam.baseline.limited_motion
    assert exam.motion is not None and seen is not None
    one, unit = slice(at, at + 1), exam.baseline.plant.units[0]
    excess, (values, _) = exam.motion.excess(seen, one)[0], exam.motion.quantities(one)
    worst = float(np.abs(excess).max())
    found = []
    for k in np.flatnonzero(np.abs(excess) >= min(UNSEEN_EXCESS, worst)):
        least, most = (np.array(x)[:, 1, k] for x in (seen.least, seen.most))
        y = values[0, :, 1, k]
        window = int(np.argmax(y / most if excess[k] > 0.0 else -y / np.maximum(least, np.finfo(np.float64).tiny)))
        found.append(
            message(
                f"motion.{QUANTITIES[k]}",
                value=float(y[window]),
                low=float(least[window]),
                high=float(most[window]),
                unit=unit or "y",
            )
        )
    return tuple(found)


def _describe_saturation(exam: Examination) -> Message | None:
    share = share_at_limits(exam.baseline.loop, exam.recording)
    return message("motion.saturated", share=share) if share > MIN_SATURATED_SHARE else None
