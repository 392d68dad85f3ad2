"""Whether a baseline is one that a machine can have: signs of its coefficients, and what the motion explains of u."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import RecordingError
from servoscope.core.messages import Message, message
from servoscope.learning.inspection.rules import MIN_EXPLAINED_SHARE
from servoscope.signals import Recording
from servoscope.signals.readers.wrap import find_wrap

# what turns motion into force or flow can have no other sign; stiffness and offset can, as gravity does
POSITIVE_COEFFICIENTS = (
    "inertia",
    "viscous_friction",
    "viscous_friction_forward",
    "viscous_friction_backward",
    "coulomb_friction",
    "velocity_forward",
    "velocity_backward",
)
MAX_NEGATIVE_STDS = 3.0  # standard deviations below 0
ROUNDING = 1e-12  # of the variance of u: less is not left unexplained
MAX_NEGATIVE_SHARE = 0.1  # share of u (rms) that a negative coefficient carries, which no scatter excuses


def check_wraps(recordings: Sequence[Recording]) -> None:
    """Refuse recordings in which u or y wraps; raises RecordingError, which says how to declare it."""
    for recording in recordings:
        for name, x in (("u", recording.u), ("y", recording.y)):
            if (period := find_wrap(x)) is not None:
                raise RecordingError(
                    f"{recording.name}: {name} jumps by {period:.6g}, the range in which it wraps: write COLUMN %"
                    f" {period:.16g} for its column, in --columns or [columns]"
                )


def negative_coefficients(baseline: Baseline) -> list[tuple[str, float, float]]:
    """Return names, values and standard deviations of coefficients that are negative and cannot be."""
    tuning, std = baseline.recursion, np.sqrt(np.diag(baseline.covariance_array()))
    rms_eta = math.sqrt(tuning.R / max(1.0 - baseline.detectability.explained, ROUNDING))
    return negative_values(baseline.names, np.array(baseline.theta), std, np.array(tuning.scale) / rms_eta)


def negative_values(
    names: Sequence[str], theta: FloatArray, std: FloatArray, scale: FloatArray
) -> list[tuple[str, float, float]]:
    """Return those of n coefficients that are negative and cannot be; `scale` (n,): rms of a column over that of u."""
    return [
        (name, value, deviation)
        for name, value, deviation, share in zip(names, theta.tolist(), std.tolist(), theta * scale, strict=True)
        if name in POSITIVE_COEFFICIENTS
        and (value + MAX_NEGATIVE_STDS * deviation < 0.0 or share < -MAX_NEGATIVE_SHARE)
    ]


def describe_negative(below: Sequence[tuple[str, float, float]], names: Sequence[str]) -> Message:
    """Say which of the coefficients `names` are negative and cannot be, and what may be the cause."""
    told = [
        message("learning.negative", name=name, value=value, deviation=deviation) for name, value, deviation in below
    ]
    all_below = len(below) > 1 and len(below) == sum(name in POSITIVE_COEFFICIENTS for name in names)
    advice = "learning.negative_all" if all_below else "learning.negative_some"
    return message("learning.implausible", coefficients=told, advice=message(advice))


def check_plausibility(baseline: Baseline, force: bool) -> list[Message]:
    """Refuse a baseline that no machine has; with `force`, return what is odd as notes instead.

    Raises RecordingError, which says what is odd and what to do.
    """
    odd = []
    # an instrument sees through noise of y that leaves more of u than the motion explains
    if baseline.detectability.explained < MIN_EXPLAINED_SHARE and baseline.recursion.instrument is None:
        odd.append(message("learning.unexplained", share=baseline.detectability.explained))
    if below := negative_coefficients(baseline):
        odd.append(describe_negative(below, baseline.names))
    if odd and not force:
        names = ", ".join(source.name for source in baseline.sources[:3])
        raise RecordingError(f"{names}: {message('learning.no_baseline', reasons=odd)}")
    return odd
