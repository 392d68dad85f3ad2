"""An asset as a document: what it is, since when and what to check; then what its last full diagnosis rests on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from servoscope.core.messages import say, translate
from servoscope.diagnosis.result import Diagnosis
from servoscope.report.diagnosis_document import DiagnosisContext, diagnosis_document, size_fact
from servoscope.report.document import HEADLINE, Document, Fact, Facts, Notes, Section
from servoscope.report.format_values import format_duration, format_probability
from servoscope.service.alarms import FAULT_ALARM
from servoscope.service.assets.condition import AssetCondition, asset_condition
from servoscope.service.assets.status import AssetStatus
from servoscope.signals import quality


def asset_document(status: AssetStatus, diagnosis: Diagnosis | None, checks: Sequence[str], gone: str = "") -> Document:
    """Return the sections of an asset.

    `diagnosis`: its last full one, which says what else a fault could be; `gone`: its headline, where the fault has
    gone and its alarm is not answered.
    """
    condition = asset_condition(status, gone)
    headline, is_fault = condition.headline, condition.is_open
    told = () if is_fault or status.summary in (headline, condition.sentence) else (Notes((status.summary,)),)
    facts = Facts(tuple(_facts(status, condition, diagnosis)))
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
        if status.metadata.coarse is not None and FAULT_ALARM not in status.alarms:
            return say("report.check.coarse", more=status.metadata.coarse[-1])
        return say("report.check.answer" if FAULT_ALARM in status.alarms else "report.check.healthy")
    if status.repaired is not None and status.reception == "followed" and not status.quality:
        return say("report.check.repaired", minutes=(status.metadata.window_s or 0.0) / 60.0)
    kind = "reception" if status.reception != "followed" else "data_quality" if status.quality else "undetermined"
    return say(f"alarm.operator_action.{kind}")


def _facts(status: AssetStatus, condition: AssetCondition, diagnosis: Diagnosis | None) -> Iterator[Fact]:
    fault, faults, sized = status.verdict == "fault", condition.sizes, condition.sized
    lasted = say("report.lasting", duration=format_duration(max(status.position.t - condition.since, 0.0)))
    yield Fact("Since when", say("report.date", t=condition.since), (lasted,))
    for estimate in faults:
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
