"""When the last minutes are examined, and what that makes of the verdict.

The recursion watches every sample, against the baseline's own coefficients. An examination compares the last minutes
with what a healthy loop would have shown under the reference that really ran; it costs milliseconds. So there is one
from time to time, and one at once when the recursion and the verdict disagree; while they go on disagreeing, the time
between them doubles. A new fault is looked at in full some seconds later (`servoscope.diagnose`), and again each time
it has become twice as old: it may have grown, and another may have come.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from servoscope.live.config import DiagnosisSettings
from servoscope.live.examining import Examined

__all__ = ["Judged", "Window", "ask_in_full", "judge", "phase_of"]

FIRST_DOUBT_S = 1.0  # until a disagreement is examined for the second time
DAY_S = 86400.0  # between two full diagnoses of a fault that stands, at most


@dataclass(frozen=True)
class Window:
    """A full diagnosis that is wanted: number of its row, first sequence, end [UTC s], and why."""

    number: int
    first: int
    until: float
    why: str


@dataclass(frozen=True)
class Judged:
    """What is remembered between two examinations.

    Parameters
    ----------
    verdict, summary, since, onset
        Of the last examination; since when it says so, and since when the fault is there [UTC s].
    examined
        When that was [UTC s]; None: never.
    due
        When the next one is [UTC s].
    doubts, retry
        How often the recursion disagreed in vain, and when it is heard again [UTC s].
    faults
        What the last full diagnosis says of the fault that is there: name, parameter, ratio, interval.
    named
        What the last full diagnosis that named something, or the first, says of this fault, or of the last one.
    again
        From when on a fault that stands is diagnosed in full once more [UTC s].
    """

    due: float
    verdict: str = "undetermined"
    summary: str = "Undetermined: nothing was examined yet."
    since: float = 0.0
    onset: float | None = None
    examined: float | None = None
    doubts: int = 0
    retry: float = 0.0
    faults: list[dict[str, Any]] = field(default_factory=list)
    named: str = ""
    again: float = 0.0


def phase_of(asset: str) -> float:
    """Return where in the period an asset's examinations lie, 0 to 1: so that a fleet's are spread over it."""
    return zlib.crc32(asset.encode()) / 2.0**32


def judge(
    state: Judged,
    settings: DiagnosisSettings,
    t: float,
    exceeded: bool,
    look: Callable[[], Examined],
    phase: float = 0.0,
) -> tuple[Judged, Examined | None]:
    """Carry the verdict to a time.

    Parameters
    ----------
    state
        As it was; it stays valid.
    settings
        How often, and over which window.
    t
        Now [UTC s].
    exceeded
        Whether the recursion is above a limit.
    look
        Examines the last minutes.
    phase
        Of `phase_of`.

    Returns
    -------
    Judged, Examined or None
        The new state, and the examination if there was one.
    """
    if state.examined is not None and t < state.examined:  # the clock was set back
        state = replace(state, due=t, retry=t, again=t)
    disagrees = exceeded != (state.verdict == "fault")
    if not disagrees:
        state = replace(state, doubts=0)
    if t < state.due and not (disagrees and t >= state.retry):
        return state, None
    found = look()
    if exceeded == (found.verdict == "fault"):
        state = replace(state, doubts=0, retry=t + FIRST_DOUBT_S)
    else:
        wait = min(FIRST_DOUBT_S * 2.0**state.doubts, settings.every_s)
        state = replace(state, doubts=min(state.doubts + 1, 30), retry=t + wait)
    same = found.verdict == state.verdict
    since = state.since if same else t
    every = settings.every_s
    # the asset's own next turn, half a period away at least
    due = every * (math.floor((t + every / 2.0) / every - phase) + 1.0 + phase)
    if found.recovering:
        due = min(due, t + settings.window_s)
    return (
        replace(
            state,
            due=due,
            verdict=found.verdict,
            summary=found.summary,
            since=since,
            # a window that is above its limits throughout says nothing of the beginning, which an earlier one has seen
            onset=state.onset if same and state.onset is not None else found.onset,
            examined=t,
            faults=state.faults if found.verdict == "fault" else [],
            named=state.named if same or found.verdict != "fault" else "",
        ),
        found,
    )


def ask_in_full(state: Judged, window_s: float, t: float) -> tuple[Judged, bool]:
    """Return whether a full diagnosis is due after an examination, and the state that remembers it.

    Parameters
    ----------
    state
        Behind the examination.
    window_s
        Length of the window [s]; a fault that fills it is diagnosed better than one that has just come.
    t
        Now [UTC s].
    """
    if state.verdict != "fault" or (t < state.again and t != state.since):
        return state, False
    return replace(state, again=t + min(max(t - state.since, window_s), DAY_S)), True
