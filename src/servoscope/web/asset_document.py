"""An asset as a document: what it is, since when and what to check; then what its last full diagnosis rests on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from servoscope.core.messages import message, say, translate
from servoscope.diagnosis.change_words import change_messages
from servoscope.diagnosis.result import Diagnosis
from servoscope.report.diagnosis_document import DiagnosisContext, diagnosis_document, size_fact
from servoscope.report.document import HEADLINE, Document, Fact, Facts, Notes, Section
from servoscope.report.format_values import format_duration, format_probability
from servoscope.service.alarms import FAULT_ALARM
from servoscope.service.assets.status import AssetStatus
from servoscope.signals import quality


def status_headline(status: AssetStatus) -> str:
    """Return the verdict on an asset in one sentence, in the reader's language and clock."""
    headline = _verdict_headline(status)
    if status.learning is None or headline == status.summary:
        return headline
    return status.learning.sentence(headline)


def _verdict_headline(status: AssetStatus) -> str:
    faults, _ = status.newest_sizes
    if status.verdict == "fault" and faults and not faults[0].learned:
        since = message("diagnosis.since_date", t=status.onset or status.since, growth=None)
        return say("diagnosis.fault", point=None, changes=change_messages(faults), since=since, mimic=None)
    if status.verdict == "healthy" and FAULT_ALARM in status.alarms and status.alarms[FAULT_ALARM].cause:
        return say("report.headline.gone", fault=status.alarms[FAULT_ALARM].cause)
    if status.verdict == "healthy":
        return say("report.headline.healthy", point=None)
    if status.verdict == "undetermined" and status.quality and status.reception == "followed":
        return say("service.examination.data_quality", findings=quality.describe_findings(status.quality))
    return status.summary


def has_open_fault(status: AssetStatus) -> bool:
    """Return whether there is a fault, or one that has gone and that nobody has answered."""
    return status.verdict == "fault" or FAULT_ALARM in status.alarms


def asset_document(status: AssetStatus, diagnosis: Diagnosis | None, checks: Sequence[str], gone: str = "") -> Document:
    """Return the sections of an asset.

    `diagnosis`: its last full one, which says what else a fault could be; `gone`: its headline, where the fault has
    gone and its alarm is not answered.
    """
    headline, is_fault = status_headline(status), has_open_fault(status)
    if gone and status.verdict != "fault":
        headline = say("report.headline.gone", fault=gone)
    told = () if is_fault or status.summary == headline else (Notes((status.summary,)),)
    facts = Facts(tuple(_facts(status, diagnosis)))
    sections = [Section(headline, (*told, facts), HEADLINE)]
    if is_fault:
        texts = tuple(checks) or (say("report.check.waiting" if status.pending_diagnoses else "report.check.nothing"),)
        sections.append(Section("What to check", (Notes(texts, ordered=len(texts) > 1),), HEADLINE))
    else:
        sections.append(Section("What to do", (Notes((_next_step(status),)),), HEADLINE))
    if is_fault and diagnosis is not None:
        known = DiagnosisContext(words=status.metadata.faults)
        sections += [
            section for section in diagnosis_document(diagnosis, known) if section.title == "What else it could be"
        ]
    return tuple(section for section in sections if section.body)


def _next_step(status: AssetStatus) -> str:
    """Return what to do where there is no fault."""
    if status.verdict == "healthy":
        return say("report.check.healthy")
    kind = "reception" if status.reception != "followed" else "data_quality" if status.quality else "undetermined"
    return say(f"alarm.operator_action.{kind}")


def _facts(status: AssetStatus, diagnosis: Diagnosis | None) -> Iterator[Fact]:
    fault = status.verdict == "fault"
    # the verdict's own time may be later than the fault's, and does not move when somebody answers the alarm
    since = status.onset if fault and status.onset is not None else status.since
    lasted = say("report.lasting", duration=format_duration(max(status.position.t - since, 0.0)))
    yield Fact("Since when", say("report.date", t=since), (lasted,))
    faults, sized = status.newest_sizes
    for estimate in faults if fault else ():
        fact = size_fact(estimate)
        yield fact._replace(lines=(*fact.lines, *((say("report.sized", t=sized),) if sized is not None else ())))
    if fault and diagnosis is not None and diagnosis.probability is not None and diagnosis.faults:
        yield Fact("How sure", format_probability(diagnosis.probability), (say("report.among_pairs"),))
    elif fault and not faults:
        key = "report.check.waiting" if status.pending_diagnoses else "report.not_named"
        yield Fact("How large", translate("not known"), (say(key),))
    findings = quality.describe_findings(status.quality) if status.quality else ""
    yield Fact("Data", translate("sound") if not findings else say("report.quality", findings=findings))
    if fault and max(status.statistic or 0.0, status.level or 0.0) < 1.0:
        yield Fact("Now", say("report.quiet"), (say("report.quiet_reason"),))
