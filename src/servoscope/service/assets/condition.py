"""The state of an asset as all views say it: in one sentence, since when, and how large its fault is."""

from __future__ import annotations

from typing import NamedTuple

from servoscope.core.messages import message, render, say
from servoscope.diagnosis.change_words import after_repair, change_messages, quantity_label, relative_changes
from servoscope.isolation.candidate import FaultEstimate
from servoscope.service.alarms import FAULT_ALARM
from servoscope.service.assets.status import AssetStatus
from servoscope.signals import quality


class AssetCondition(NamedTuple):
    """What holds of an asset now, in the language and the time zone of the reader."""

    sentence: str  # what it is, by the samples that count: after a repair those since
    headline: str  # the same, with how far it has learned again
    since: float  # of the fault its onset, else since when the verdict holds [UTC s]
    sizes: tuple[FaultEstimate, ...]  # of the faults that are there
    sized: float | None  # when they were found [UTC s]; None: not known
    is_open: bool  # whether there is a fault, or one that has gone by itself and that nobody has answered


def asset_condition(status: AssetStatus, gone: str = "") -> AssetCondition:
    """Return the state of an asset; `gone`: the headline of its last diagnosis, where its fault has gone."""
    is_fault, mended = status.verdict == "fault", status.verdict != "fault" and status.repaired is not None
    sizes, sized = status.newest_sizes if is_fault else ((), None)
    sentence = _repair_sentence(status) or _sentence(status, gone)
    if status.verdict == "healthy" and status.metadata.coarse is not None:
        fault, now, later, further = status.metadata.coarse
        values = {"fault": quantity_label(fault), "now": 100.0 * now, "later": 100.0 * later, "more": further}
        sentence = f"{sentence.rstrip('.')}. {say('service.examination.coarse', **values)}"
    return AssetCondition(
        sentence=sentence,
        headline=sentence
        if status.learning is None or sentence == status.summary
        else status.learning.sentence(sentence),
        since=status.onset if is_fault and status.onset is not None else status.since,
        sizes=sizes,
        sized=sized,
        is_open=is_fault or (FAULT_ALARM in status.alarms and not mended),
    )


def _sentence(status: AssetStatus, gone: str) -> str:
    faults, _ = status.newest_sizes
    if status.verdict == "fault" and faults and not faults[0].learned:
        since = message("diagnosis.since_date", t=status.onset or status.since, growth=None)
        return say("diagnosis.fault", point=None, changes=change_messages(faults), since=since, mimic=None)
    if status.verdict != "fault" and (gone or (status.verdict == "healthy" and _cause(status))):
        return say("report.headline.gone", fault=gone or _cause(status))
    if status.verdict == "healthy":
        return say("report.headline.healthy", point=None)
    if status.verdict == "undetermined" and status.quality and status.reception == "followed":
        return say("service.examination.data_quality", findings=quality.describe_findings(status.quality))
    return status.summary


def _cause(status: AssetStatus) -> str:
    return status.alarms[FAULT_ALARM].cause if FAULT_ALARM in status.alarms else ""


def _repair_sentence(status: AssetStatus) -> str:
    """Return what has become of the faults that a repair was for; empty: its samples say something else."""
    if status.repaired is None:
        return ""
    before = tuple(fault for fault in status.before if not fault.learned)
    if status.verdict == "fault":
        faults, _ = status.newest_sizes
        if not before or [fault.name for fault in faults] != [fault.name for fault in before]:
            return ""
        return say("service.examination.left", fault=_sentence(status, ""), changes=relative_changes(before))
    if status.verdict == "undetermined":
        is_waiting = status.since == status.repaired and status.reception == "followed" and not status.quality
        return say("service.examination.repaired", t=status.repaired) if is_waiting else ""
    return render(after_repair(before, status.size)) if before else ""
