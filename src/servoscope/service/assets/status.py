"""What users see of an asset and of the service: the status that is stored beside each checkpoint.

`model_validate` reads a stored status, of any version; `asset_status` returns what is stored of an asset.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from servoscope.baseline.records import RENEWALS, Occasion
from servoscope.core.messages import message, render
from servoscope.core.verdict import VerdictKind
from servoscope.isolation.candidate import FaultEstimate
from servoscope.machines.protocol import Machine
from servoscope.service.alarms import (
    FAULT_ALARM,
    AlarmDefinition,
    AssetSnapshot,
    LifecycleState,
    Ne107,
    Priority,
    evaluate_ne107,
)
from servoscope.service.assets.checkpoint import AssetState, StreamPosition
from servoscope.service.assets.examination_schedule import Announcement, ExaminationState, has_newer_size
from servoscope.service.assets.outlook import Outlook, OutlookWord, current_outlook
from servoscope.service.assets.reception import RECEPTION_OK, Reception, ReceptionState
from servoscope.service.assets.residual_history import EvaluationStatus
from servoscope.signals import quality

MIN_LEARN_S = 600.0  # length of a stretch that is enough to learn from [s], unless fewer samples are kept


class _StatusRecord(BaseModel):
    model_config = ConfigDict(frozen=True, populate_by_name=True)


class AlarmStatus(_StatusRecord):
    """An alarm; the service's own ones of version 0.1 have no priority and no cause."""

    state: LifecycleState
    since: float  # [UTC s]
    priority: Priority | None = None
    cause: str = ""
    until: float | None = None  # end of its shelving [UTC s]
    active: bool | None = None  # whether its condition is abnormal, whatever the state; None: of a version before 2.0
    ne107: Ne107 | None = None  # status that it gives to its asset


class LearningStatus(_StatusRecord):
    """How far an asset is in learning again after what was done to it; until then it is judged as before."""

    after: Occasion
    since: float  # [UTC s]
    confirmed: bool = False
    learned_s: float
    needed_s: float

    def sentence(self, cause: str) -> str:
        """Return how far it is, with what the earlier baseline finds."""
        key = "service.examination.confirmed" if self.confirmed else "service.examination.learning"
        minutes = {"learned": self.learned_s / 60.0, "needed": self.needed_s / 60.0}
        return render(message(key, after=self.after, found=cause, **minutes))


class AssetMetadata(_StatusRecord):
    """What never changes of an asset, and is needed to read its numbers."""

    group: str = ""
    source: str = ""  # its name in the service file
    loop: str | None = None
    plant: str | None = None
    baseline: str | None = None  # its hash
    point: str | None = None  # its operating point
    sample_rate_hz: float | None = None
    units: tuple[str, ...] = ()  # of y and u
    coefficient_units: tuple[str, ...] = ()
    faults: dict[str, str] = {}  # what their names mean
    checks: dict[str, tuple[str, ...]] = {}  # what to check on the machine: of the faults that are named now
    window_s: float | None = None  # what an examination covers
    pause_s: float = 0.0  # how long its source may pause
    coarse: tuple[str, float, float, int] | None = None  # `CoarseMonitoring` of its baseline


class AssetVerdict(_StatusRecord):
    """What is said of an asset."""

    verdict: VerdictKind
    summary: str
    since: float  # since when the verdict holds [UTC s]
    onset: float | None  # of the fault [UTC s]
    examined: float | None  # when it was examined last [UTC s]
    ne107: Ne107
    reasons: tuple[str, ...]  # for the status after NE 107
    sized: float | None = None  # when the size of the fault was found last [UTC s]; None: by the full diagnosis alone
    learning: LearningStatus | None = None  # after a repair


class AssetStatus(AssetVerdict, EvaluationStatus):
    """An asset as users see it, with its newest evaluation."""

    faults: tuple[FaultEstimate, ...] = ()  # by the last full diagnosis
    quality: dict[str, float]  # findings of data quality that hold now, and since when [UTC s]
    alarms: dict[str, AlarmStatus]  # those that are not normal
    pending_diagnoses: tuple[int, ...] = Field((), alias="awaited")  # numbers of their rows
    reception: ReceptionState = "followed"  # how its samples come in
    # when sound data last showed the fault, and the end of the window that named it [UTC s]
    fault_at: float | None = None
    diagnosed: float | None = None
    size: FaultEstimate | None = None  # of the fault by the newest examination, at `sized`
    # repaired, before: when something was done to it [UTC s], before which no sample counts, and its faults until then
    repaired: float | None = None
    before: tuple[FaultEstimate, ...] = ()
    outlook: Outlook | None = None  # when the fault reaches its limit; None: it has none, or nothing is known yet
    position: StreamPosition = Field(alias="counted")
    metadata: AssetMetadata = Field(AssetMetadata(), alias="about")

    @property
    def newest_sizes(self) -> tuple[tuple[FaultEstimate, ...], float | None]:
        """The newest sizes of its faults, and when they were found [UTC s], None where that is not known."""
        names = [fault.name for fault in self.faults]
        if self.size is not None and has_newer_size(names, self.size.name, self.sized, self.diagnosed):
            return (self.size,), self.sized
        return self.faults, self.diagnosed


class FloodCounts(_StatusRecord):
    """A flood of alarms: since when [UTC s], how many alarms there were, and how many are held back."""

    since: float | None
    counted: int
    held: int


class ServiceStatus(_StatusRecord):
    """The service itself as users see it."""

    service: Literal[True] = True
    flood: FloodCounts
    alarms: dict[str, AlarmStatus]


def read_status(stored: Mapping[str, Any]) -> AssetStatus | ServiceStatus:
    """Return a stored status as the record that it is."""
    return (ServiceStatus if stored.get("service") else AssetStatus).model_validate(stored)


def asset_metadata(
    machine: Machine, group: str, window_s: float, source: str = "", pause_s: float = 0.0
) -> dict[str, Any]:
    """Return the metadata of an asset that is this machine, as stored."""
    baseline, coarse = machine.loop_baseline, None
    if baseline is not None and baseline.revision.kind in RENEWALS:
        from servoscope.learning.coarse import coarse_monitoring  # it loads what learns

        coarse = coarse_monitoring(baseline)
    signals: dict[str, Any] = {} if machine.units is None else {"point": machine.point or None, "units": machine.units}
    signals |= ({"pause_s": pause_s} if pause_s else {}) | ({} if coarse is None else {"coarse": coarse})
    return AssetMetadata(
        group=group,
        source=source,
        loop=machine.name,
        plant=machine.kind,
        baseline=machine.hash,
        sample_rate_hz=machine.rate,
        coefficient_units=machine.coefficient_units,
        faults=dict(machine.fault_words),
        window_s=window_s,
        **signals,
    ).model_dump(mode="json", exclude_unset=True)


def checks_of_named(machine: Machine, faults: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the metadata that change: what to check for the faults that are named now, where there are some."""
    names = [fault["name"] for fault in faults]
    known = machine.fault_words if names else {}
    checks = {name: [render(check) for check in machine.checks(name)] if name in known else [] for name in names}
    return {"checks": checks} if checks else {}


def asset_summary(examination: ExaminationState, findings: Iterable[str], reception: Reception = RECEPTION_OK) -> str:
    """Return the last examination's sentence, unless data quality or what is wrong with the reception overrules it."""
    if reception.sentence:
        return reception.sentence
    if quality.limit_verdict(examination.verdict, findings) == examination.verdict:
        return examination.summary
    return render(message("service.examination.data_quality", findings=quality.describe_findings(findings)))


def asset_verdict(
    examination: ExaminationState, findings: Iterable[str], reception: Reception, announced: Announcement | None = None
) -> str:
    """Return the verdict that holds, with what data quality and the reception leave of the last examination's."""
    verdict = quality.limit_verdict(examination.verdict, findings)
    if verdict == "healthy" and reception != RECEPTION_OK:
        verdict = "undetermined"  # nobody knows what it does now
    if verdict == "undetermined" and examination.fault_at is not None:
        verdict = "fault"  # it was seen on sound data, and nothing has shown since that it has gone
    return "undetermined" if announced is not None and announced.confirmed else verdict


def asset_snapshot(
    state: AssetState,
    findings: tuple[str, ...],
    reception: Reception,
    outlook: OutlookWord,
    announced: Announcement | None = None,
) -> AssetSnapshot:
    """Return what the asset's alarms go by."""
    statistic, level = state.evaluation.peaks
    current = current_outlook(state.outlook, state.examination.faults)
    verdict = quality.limit_verdict(state.examination.verdict, findings)
    return AssetSnapshot(
        verdict="undetermined" if announced is not None and announced.confirmed else verdict,
        quality=findings,
        statistic=statistic,
        level=level,
        reception=reception,
        control=state.examination.control,
        cause=asset_summary(state.examination, findings),
        outlook=outlook,
        outlook_cause=current.summary if current is not None else "",
    )


def asset_status(
    state: AssetState,
    definitions: Mapping[str, AlarmDefinition],
    metadata: Mapping[str, Any],
    reception: Reception = RECEPTION_OK,
    announced: Announcement | None = None,
    kept_s: float = 0.0,
) -> dict[str, Any]:
    """Return the status of an asset as stored, an `AssetStatus`, whose values are checked where it is read.

    `metadata`: as stored; `announced`: after which it learns again; `kept_s`: how long samples are kept.
    """
    examination, findings = state.examination, quality.active_findings(state.quality)
    now = quality.limit_verdict(examination.verdict, findings)
    ne107 = evaluate_ne107(now, findings, [(definitions[name], alarm) for name, alarm in state.alarms.items()])
    named, outlook = examination.named, current_outlook(state.outlook, examination.faults)
    verdict = asset_verdict(examination, findings, reception, announced)
    summary = named if now == "fault" and named else asset_summary(examination, findings, reception)
    if verdict == "fault" and now != "fault":
        fault = named or render(message("service.examination.seen"))
        summary = render(message("service.examination.stands", fault=fault, t=examination.fault_at, since=summary))
    learning = None
    if announced is not None:
        needed_s = min(MIN_LEARN_S, kept_s)
        learned_s = min(max(state.position.t - announced.since, 0.0), needed_s)
        learning = LearningStatus(**announced._asdict(), learned_s=learned_s, needed_s=needed_s)
        summary = learning.sentence(summary)
    return {
        **state.evaluation.status.to_json(),
        "verdict": verdict,
        "summary": summary,
        "since": examination.since,
        "onset": examination.onset,
        "examined": examination.examined,
        **({"sized": examination.sized, "size": examination.size} if examination.size else {}),
        "ne107": ne107.ne107,
        "reasons": ne107.reasons,
        **({} if learning is None else {"learning": learning.model_dump(mode="json")}),
        "faults": examination.faults,
        "quality": findings,
        "alarms": {
            name: {
                "state": alarm.state.value,
                "since": alarm.since,
                "priority": definitions[name].priority,
                # the cause at the last sample would be, once the fault has gone, that all is well
                "cause": named if name == FAULT_ALARM and named else alarm.cause,
                "until": alarm.shelved_until,
                "active": alarm.active,
                "ne107": definitions[name].ne107,
            }
            for name, alarm in state.alarms.items()
            if alarm.state is not LifecycleState.NORMAL
        },
        "awaited": [window.number for window in state.pending_diagnoses],
        **({} if reception == RECEPTION_OK else {"reception": reception.state}),
        **({} if examination.fault_at is None else {"fault_at": examination.fault_at}),
        **({} if examination.diagnosed is None else {"diagnosed": examination.diagnosed}),
        **({} if examination.repaired is None else {"repaired": examination.repaired, "before": examination.before}),
        **({} if outlook is None else {"outlook": outlook.model_dump(mode="json", exclude_unset=True)}),
        "counted": vars(state.position),
        "about": metadata,
    }
