"""Whether a baseline is one that a machine can have: signs of its coefficients, and what the motion explains of u."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from servoscope.baseline.baseline import Baseline
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
    shares = np.array(baseline.theta) * np.array(tuning.scale)
    shares *= math.sqrt(max(1.0 - baseline.detectability.explained, 0.0) / tuning.R)
    return [
        (name, value, deviation)
        for name, value, deviation, share in zip(baseline.names, baseline.theta, std.tolist(), shares, strict=True)
        if name in POSITIVE_COEFFICIENTS
        and (value + MAX_NEGATIVE_STDS * deviation < 0.0 or share < -MAX_NEGATIVE_SHARE)
    ]


def check_plausibility(baseline: Baseline, force: bool) -> list[Message]:
    """Refuse a baseline that no machine has; with `force`, return what is odd as notes instead.

    Raises RecordingError, which says what is odd and what to do.
    """
    odd = []
    # an instrument sees through noise of y that leaves more of u than the motion explains
    if baseline.detectability.explained < MIN_EXPLAINED_SHARE and baseline.recursion.instrument is None:
        odd.append(message("learning.unexplained", share=baseline.detectability.explained))
    below = [
        message("learning.negative", name=name, value=value, deviation=deviation)
        for name, value, deviation in negative_coefficients(baseline)
    ]
    if below:
        all_below = len(below) > 1 and len(below) == sum(name in POSITIVE_COEFFICIENTS for name in baseline.names)
        advice = "learning.negative_all" if all_below else "learning.negative_some"
        odd.append(message("learning.implausible", coefficients=below, advice=message(advice)))
    if odd and not force:
        names = ", ".join(source.name for source in baseline.sources[:3])
        raise RecordingError(f"{names}: {message('learning.no_baseline', reasons=odd)}")
    return odd
