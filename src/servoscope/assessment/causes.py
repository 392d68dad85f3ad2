"""The causes of poor control that one log can show."""

from __future__ import annotations

from typing import Literal, get_args

Cause = Literal[
    "stiction",
    "backlash",
    "too tight",
    "too sluggish",
    "oscillation from outside",
    "saturation",
    "quantisation",
    "frozen sensor",
    "manual",
    "good",
]
CAUSES: tuple[Cause, ...] = get_args(Cause)
# what no healthy loop should show: `learn` warns of it, and an alarm of the source ``control`` is for it
POOR_CONTROL: tuple[Cause, ...] = ("stiction", "backlash", "too tight", "oscillation from outside", "saturation")
MIN_ALARM_PROBABILITY = 0.9  # of such a cause
