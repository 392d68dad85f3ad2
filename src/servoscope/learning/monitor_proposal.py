"""The settings of the monitor in a proposed loop file: cutoff, memory, frequencies, and whether rest is left out."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from servoscope.core import number_format
from servoscope.core.errors import NotEnoughError
from servoscope.core.messages import message
from servoscope.learning.hold import LikelierHold
from servoscope.learning.inspection import Inspection
from servoscope.learning.inspection.rules import MIN_MEMORIES, advised_rest_speed
from servoscope.learning.loop_proposal import ProposalLine, quoted
from servoscope.learning.plant_proposal import why_not_learned
from servoscope.models.loop import Loop, MonitorSettings
from servoscope.signals import Recording

MAX_MEMORY_S, MIN_PERIODS = 5.0, 5.0  # of the estimator; periods of the cutoff that it holds at least


def monitor_settings(recording: Recording, bands: Sequence[float]) -> dict[str, object]:
    """Return cutoff, memory and frequencies; the cutoff is the middle one of the logs' `bands` [Hz]."""
    resampled = next((defect.text.values["cutoff"] for defect in recording.defects if defect.kind == "resampled"), None)
    # the largest of two digits that the recommendation allows
    cutoff = number_format.round_down(
        min(float(np.median(bands)), resampled if isinstance(resampled, float) else math.inf)
    )
    memory = max(MIN_PERIODS / cutoff, min(MAX_MEMORY_S, recording.duration_s / MIN_MEMORIES))
    frequencies = [f for f in MonitorSettings().frequencies if f <= cutoff] or [float(f"{cutoff / 2.0:.2g}")]
    return {"cutoff": cutoff, "memory": number_format.round_down(memory), "frequencies": frequencies}


def monitor_lines(monitor: Mapping[str, object], duration_s: float) -> list[ProposalLine]:
    """Return the lines of these settings; `duration_s`: of the first log."""
    reasons = {"cutoff": {}, "memory": {"length": duration_s}, "frequencies": dict[str, float]()}
    return [
        ProposalLine("monitor", key, repr(monitor[key]), message(f"init.{key}", **values))
        for key, values in reasons.items()
    ]


def hold_lines(likelier: LikelierHold | None) -> list[ProposalLine]:
    """Return the line on how u runs between the samples, where the logs show it."""
    if likelier is None:
        return []
    return [ProposalLine("", "hold", quoted(likelier.hold), message(f"init.hold_{likelier.hold}", gain=likelier.gain))]


def hold_at_rest(
    inspected: Inspection, monitor: dict[str, object], loop: Callable[[], Loop], recordings: Sequence[Recording]
) -> list[ProposalLine]:
    """Add to the settings of the monitor that rest is left out, where that helps and leaves enough; return the lines.

    `loop` returns the loop with these settings.
    """
    if (advised := advised_rest_speed(inspected, loop())) is None:
        return []
    speed = float(f"{advised:.2g}")
    monitor |= {"update_when": "moving", "rest_speed": speed}
    try:
        why_not_learned(loop(), recordings)
    except NotEnoughError:
        del monitor["update_when"], monitor["rest_speed"]
        return []
    return [
        ProposalLine("monitor", "update_when", '"moving"', message("init.update_when")),
        ProposalLine("monitor", "rest_speed", repr(speed), message("init.rest_speed")),
    ]
