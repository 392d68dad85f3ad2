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
# what no healthy loop shows, whatever its reference does: `learn` warns of it, and alarms go by it unless they say more
POOR_CONTROL: tuple[Cause, ...] = ("stiction", "backlash")
MIN_SURE_PROBABILITY = 0.9  # of a cause that is warned of
