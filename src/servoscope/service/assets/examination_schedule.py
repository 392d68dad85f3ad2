"""When the last minutes are examined, and what the verdict is after that.

The recursion tests every sample against the baseline's own coefficients. An examination compares the last minutes with
what a healthy loop would have shown under the reference that was really applied; it takes milliseconds. There is one
from time to time, each asset at its own place in the period, and one at once when the recursion and the verdict
disagree; while they go on disagreeing, the time between two of them doubles. A new fault is diagnosed in full some
seconds later (`servoscope.diagnose`), and again each time it has become twice as old.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from servoscope.baseline.records import RENEWALS, Occasion
from servoscope.core.messages import message, render
from servoscope.core.verdict import VerdictKind
from servoscope.diagnosis.change_words import after_repair
from servoscope.diagnosis.schedule import DiagnosisSchedule
from servoscope.isolation.candidate import FaultEstimate
from servoscope.service.assets.examination import StoredDiagnosis
from servoscope.service.config import DiagnosisSettings

FIRST_RETRY_S = 1.0  # until a disagreement is examined for the second time
# of the assets of a process that begin together: 3 % of a core at 3 ms each, beside samples that may need all the rest
FIRST_PER_S = 10.0
# of a fault, once it has gone
GONE: dict[str, Any] = {"onset": None, "faults": [], "fault_at": None, "diagnosed": None, "size": {}, "sized": None}
DAY_S = 86400.0  # between two full diagnoses of a fault that lasts, at most


class Announcement(NamedTuple):
    """What was done to an asset, after which its baseline is learned again."""

    after: Occasion
    since: float  # [UTC s]
    confirmed: bool = False  # whether somebody has said that what has changed since is no fault


def has_newer_size(faults: Sequence[str], sized_fault: str | None, sized: float | None, named: float | None) -> bool:
    """Return whether the size of an examination at `sized` is that of the only fault, named at `named` or before."""
    return list(faults) == [sized_fault] and (sized or 0.0) >= (named or 0.0)


@dataclass(frozen=True)
class PendingDiagnosis:
    """A full diagnosis that is due: number of its row, first sequence, end of its window [UTC s], and the reason."""

    number: int
    first: int
    until: float
    why: str


@dataclass(frozen=True)
class ExaminationState:
    """What is kept between two examinations; times are [UTC s]."""

    due: float  # the next one
    verdict: VerdictKind = "undetermined"  # of the last one
    summary: str = field(default_factory=lambda: render(message("service.examination.none")))
    since: float = 0.0  # since when the verdict holds
    onset: float | None = None  # since when the fault is there
    examined: float | None = None  # the last one; None: there was none
    doubts: int = 0  # how many examinations in a row have not confirmed the recursion
    retry: float = 0.0  # until when it is not examined again for that reason
    faults: list[dict[str, Any]] = field(default_factory=list)  # by the last full diagnosis of this fault
    named: str = ""  # the summary of its last full diagnosis that named a fault, or of the first one
    again: float = 0.0  # when a fault that lasts is diagnosed in full once more
    # fault_at, diagnosed: when sound data last showed the fault, and the end of the window that last named it. A fault
    # stands until something shows that it has gone; None: there is none
    fault_at: float | None = None
    diagnosed: float | None = None
    # size, sized: the newest size of the fault, by an examination, and when that was [UTC s]; {}: no such size yet
    size: dict[str, Any] = field(default_factory=dict)
    sized: float | None = None
    control: str | None = None  # what the samples show by themselves, "" for nothing; None: not assessed
    # repaired, before: when something was done to the machine, before which no sample is examined [UTC s], and the
    # faults that were known then
    repaired: float | None = None
    before: list[dict[str, Any]] = field(default_factory=list)

    @property
    def newest_faults(self) -> list[dict[str, Any]]:
        """Its faults with their newest sizes."""
        names = [fault["name"] for fault in self.faults]
        is_newer = has_newer_size(names, self.size.get("name"), self.sized, self.diagnosed)
        return [self.size] if is_newer else self.faults

    def to_json(self) -> dict[str, Any]:
        """Return its fields as a checkpoint keeps them, those of a repair only after one."""
        kept = vars(self)
        return kept if self.repaired is not None else {k: v for k, v in kept.items() if k not in ("repaired", "before")}

    def window_begin(self, t: float, window_s: float) -> float:
        """Return from when on samples are examined at `t` [UTC s]."""
        return max(t - window_s, -math.inf if self.repaired is None else self.repaired)

    @classmethod
    def begin(cls, t: float, settings: DiagnosisSettings, phase: float, assets: int = 1) -> ExaminationState:
        """Return the state at the first sample, at `t` [UTC s], of one of so many assets that may begin together.

        It is first examined after a window, within another one; within more where these would be more than
        `FIRST_PER_S`, up to a period, that is at its place in it.
        """
        whole, every = t + settings.window_s, settings.every_s
        span = max(settings.window_s, min(assets / FIRST_PER_S, every))
        return cls(due=whole + span * ((phase - whole / every) % 1.0), since=t)


def examination_phase(asset: str) -> float:
    """Return where in the period an asset's examinations lie, 0 to 1: so that a fleet's are spread over it."""
    return zlib.crc32(asset.encode()) / 2.0**32


def rest_period(state: ExaminationState) -> tuple[float, float]:
    """Return from when and until when [UTC s] `update_examination` changes nothing if the recursion agrees."""
    if state.doubts:
        return math.inf, -math.inf
    return state.since if state.examined is None else state.examined, state.due


def is_at_rest(state: ExaminationState, t: float, exceeded: bool) -> bool:
    """Return whether `update_examination` changes nothing at time `t` [UTC s]: nearly always."""
    since, until = rest_period(state)
    return since <= t < until and exceeded == (state.verdict == "fault")


def update_examination(
    state: ExaminationState,
    settings: DiagnosisSettings,
    t: float,
    exceeded: bool,
    examine: Callable[[], StoredDiagnosis],
    phase: float = 0.0,
    *,
    sound: bool = True,
) -> tuple[ExaminationState, StoredDiagnosis | None]:
    """Return the state at time `t` [UTC s], and the result of the examination if one was due.

    `exceeded`: whether the recursion is above a limit; `sound`: whether the data are good enough to show a fault.
    """
    if state.examined is None and t < state.since:  # the clock was set back: the first one is as far away as before
        state = replace(state, due=t + (state.due - state.since), since=t)
    elif state.examined is not None and t < state.examined:
        state = replace(state, due=t, retry=t, again=t)
    disagrees = exceeded != (state.verdict == "fault")
    if not disagrees and state.doubts:
        state = replace(state, doubts=0)
    if t < state.due and not (disagrees and t >= state.retry):
        return state, None
    result = examine()
    if exceeded == (result.verdict == "fault"):
        state = replace(state, doubts=0, retry=t + FIRST_RETRY_S)
    else:
        wait = min(FIRST_RETRY_S * 2.0**state.doubts, settings.every_s)
        state = replace(state, doubts=min(state.doubts + 1, 30), retry=t + wait)
    unchanged = result.verdict == state.verdict
    every = settings.every_s
    # the asset's own next turn, half a period away at least
    due = every * (math.floor((t + every / 2.0) / every - phase) + 1.0 + phase)
    # nothing to be seen, of a machine that is off for example, is no repair
    faulty, unseen = result.verdict == "fault", result.verdict == "undetermined" and not result.recovering
    stands = unseen and state.fault_at is not None
    if result.recovering or stands or (unseen and state.repaired is not None):  # somebody waits for the answer
        due = min(due, t + settings.window_s)
    new = replace(
        state,
        due=due,
        verdict=result.verdict,
        summary=_summary(result, state.before),
        since=state.since if unchanged else t,
        # the onset has left a window that is above its limits throughout; an earlier examination has found it
        onset=state.onset if (unchanged or stands) and state.onset is not None else result.onset,
        examined=t,
        faults=state.faults if faulty or stands else [],
        named=state.named if unchanged or not faulty or state.fault_at is not None else "",
        fault_at=t if faulty and sound else state.fault_at if faulty or stands else None,
        diagnosed=state.diagnosed if faulty or stands else None,
        size=result.size.model_dump(mode="json") if result.size else state.size if faulty or stands else {},
        control=result.control,
        sized=t if result.size else state.sized if faulty or stands else None,
    )
    return new, result


def _summary(result: StoredDiagnosis, before: Sequence[Mapping[str, Any]]) -> str:
    if result.verdict != "healthy" or not before:
        return result.summary
    return render(after_repair([FaultEstimate.model_validate(fault) for fault in before], result.size))


def schedule_full_diagnosis(
    state: ExaminationState, schedule: DiagnosisSchedule, t: float
) -> tuple[ExaminationState, bool]:
    """Return the state after an examination at `t` [UTC s], and whether that calls for a full diagnosis."""
    if state.verdict != "fault" or (t < state.again and t != state.since):
        return state, False
    return replace(state, again=schedule.next_alarm(state.since, t, DAY_S)), True


def restart_after(
    state: ExaminationState, settings: DiagnosisSettings, announced: Announcement | None
) -> ExaminationState:
    """Return the state after what was done to the machine: its fault is past, and the samples since decide."""
    if announced is None or announced.after not in RENEWALS or announced.since <= (state.repaired or -math.inf):
        return state
    since = announced.since
    due = since + settings.window_s
    return replace(
        state,
        due=due,
        retry=due,
        doubts=0,
        verdict="undetermined",
        summary=render(message("service.examination.repaired", t=since)),
        since=since,
        **GONE,
        repaired=since,
        before=state.newest_faults if announced.after == "repair" else [],
    )


def accept_diagnosis(
    examination: ExaminationState,
    window: PendingDiagnosis,
    diagnosis: StoredDiagnosis,
    *,
    first: bool,
    exceeded: bool = True,
) -> tuple[ExaminationState, StoredDiagnosis]:
    """Return the state with a full diagnosis, and that with the onset that is known.

    `first`: whether it is the first of this fault; `exceeded`: whether the recursion is above a limit now. If it is
    not, a later window that is healthy withdraws the fault.
    """
    if not first:
        diagnosis = diagnosis.with_onset(examination.onset)
    # not of a fault before this one; a later window that names nothing keeps the name
    if diagnosis.verdict == "fault" and (examination.verdict != "fault" or window.until > examination.since):
        faults = diagnosis.document.get("faults", [])
        # what has gone meanwhile keeps its name only, as if the diagnosis had come before
        stands = examination.verdict == "fault" or examination.fault_at is not None
        if faults or not examination.named:
            until = window.until if stands else examination.diagnosed
            examination = replace(examination, named=diagnosis.summary, diagnosed=until)
            if examination.sized is not None and examination.sized <= window.until:
                # older than what the diagnosis says; whether it was found depends on when an earlier one came back
                examination = replace(examination, size={}, sized=None)
        if stands:
            onset = diagnosis.onset if first and diagnosis.onset is not None else examination.onset
            examination = replace(examination, faults=faults or examination.faults, onset=onset)
    elif diagnosis.verdict == "undetermined" and not examination.named:
        # a sensor that is stuck, for example: nothing that would stand was found
        examination = replace(examination, fault_at=None)
    elif diagnosis.verdict == "healthy" and not exceeded and window.until > (examination.fault_at or math.inf):
        examination = replace(examination, verdict="healthy", summary=diagnosis.summary, since=window.until, **GONE)
    return examination, diagnosis


def fault_names(faults: Iterable[Mapping[str, Any]]) -> set[str]:
    """Return which faults are named."""
    return {str(fault["name"]) for fault in faults}
