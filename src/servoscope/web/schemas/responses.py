"""What the interface answers of sessions, jobs, uploads, diagnoses, baselines, studies, notifications and sizes."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field

from servoscope.core.messages import MessageField
from servoscope.core.verdict import VerdictKind
from servoscope.design.operating_limits import OperatingLimit
from servoscope.prognosis.forecast import Prognosis
from servoscope.service.access import Role
from servoscope.service.renewal import LearningProgress
from servoscope.web.schemas.requests import NoteRequest
from servoscope.web.stored_diagnosis import stored_headline

JsonObject = dict[str, Any]  # a document of another package, passed on as it is
NullableFloats = list[float | None]
StorageKind = Literal["uploads", "baselines", "diagnoses", "learnings", "designs"]


class ApiResponse(BaseModel):
    """An answer."""

    model_config = ConfigDict(json_schema_serialization_defaults_required=True)  # no field is ever left out


class Problem(ApiResponse):
    """An error after RFC 9457."""

    type: str
    title: str
    status: int
    detail: str
    instance: str | None = None
    errors: list[dict[str, str]] | None = None


class SessionResponse(ApiResponse):
    """The user, and the token that changing requests must repeat."""

    login_required: bool
    password_login: bool
    single_sign_on: None  # always null since 2.0: a proxy signs users in before a page loads
    user: str | None
    role: Role | None
    csrf: str | None
    expires: float | None
    version: str


class AuditEntry(ApiResponse):
    """A line of the audit."""

    id: int
    at: float
    who: str
    asset: str
    what: str
    document: JsonObject


class AuditList(ApiResponse):
    """Lines of the audit, the newest last."""

    entries: list[AuditEntry]


class JobResponse(ApiResponse):
    """A job: how far it is, and its result."""

    id: str
    kind: str
    state: Literal["queued", "running", "done", "failed"] = "queued"
    step: str | None = None
    created: float
    finished: float | None = None
    result: JsonObject | None = None
    problem: JsonObject | None = None


class StorageRecord(ApiResponse):
    """Something that the server keeps in a folder of its own."""

    kind: ClassVar[StorageKind]

    id: str
    at: float = Field(default_factory=time.time)
    who: str


class UploadRow(StorageRecord):
    """An upload in a line."""

    kind = "uploads"

    name: str
    bytes: int


class TablePreview(ApiResponse):
    """The first rows of a file."""

    columns: list[str]
    rows: list[list[float | str | None]]


class FilePreview(ApiResponse):
    """What a file holds: its columns, first rows, and what the columns may mean."""

    rows: int
    columns: list[JsonObject]
    preview: TablePreview
    mapping: JsonObject
    axes: dict[str, JsonObject] = {}  # the mapping of each, where the names show several


class UploadDetail(UploadRow, FilePreview):
    """An upload with its columns and first rows."""


class UploadList(ApiResponse):
    """Uploads, the newest last, and the suffixes of files that this server reads."""

    uploads: list[UploadRow]
    suffixes: list[str]


class SignalColumns(ApiResponse):
    """Signals as columns; None where nothing was measured."""

    t: NullableFloats
    r: NullableFloats
    u: NullableFloats
    y: NullableFloats


class BaselineRef(ApiResponse):
    """The baseline of a diagnosis."""

    id: str | None
    name: str
    hash: str


class UploadDiagnosis(StorageRecord):
    """A diagnosis of an upload."""

    kind = "diagnoses"

    baseline: BaselineRef
    upload: str | None = None
    verdict: VerdictKind
    summary: str
    recording: str


class DiagnosisRow(ApiResponse):
    """A diagnosis in a line."""

    id: str
    asset: str | None = None
    number: int | None = None
    t: float
    grounds: str
    verdict: VerdictKind
    summary: str
    onset: float | None = None
    recording: str | None = None

    @classmethod
    def from_stored(cls, row: Mapping[str, Any]) -> DiagnosisRow:
        """Return a diagnosis of a followed asset, a row of the store."""
        said = stored_headline(row)
        return cls.model_validate({**row, "summary": said, "id": f"{row['asset']}@{row['number']}"})


class DiagnosisList(ApiResponse):
    """Diagnoses, the newest last."""

    diagnoses: list[DiagnosisRow]


class DiagnosisDetail(DiagnosisRow):
    """A diagnosis with its document; uploads have signals, trace and report too."""

    document: JsonObject
    sections: list[JsonObject]
    began: float | None = None
    who: str | None = None
    baseline: BaselineRef | None
    units: dict[str, str] | None
    signals: JsonObject | None = None
    trace: JsonObject | None = None
    arm: JsonObject | None = None  # how it is drawn
    signature: list[JsonObject] = []
    report: str | None = None
    upload: str | None = None


class BaselineFacts(ApiResponse):
    """What a baseline's file says."""

    loop: str
    hash: str
    points: list[str]
    columns: JsonObject | None = None
    units: dict[str, str] | None = None
    recordings: int
    duration_s: float


class BaselineRecord(StorageRecord, BaselineFacts):
    """A baseline that was saved here."""

    kind = "baselines"


class BaselineRow(BaselineFacts):
    """A baseline in a line."""

    id: str
    name: str
    origin: Literal["service", "saved"]
    assets: list[str] = []
    at: float | None = None
    who: str | None = None


class BaselineList(ApiResponse):
    """All baselines."""

    baselines: list[BaselineRow]


class BaselineDetail(BaselineRow):
    """A baseline with what was learned."""

    summary: JsonObject


class LearningRow(StorageRecord):
    """A baseline that was learned, and is not saved yet."""

    kind = "learnings"

    uploads: list[str]


class RelearningState(LearningProgress, ApiResponse):
    """How far an asset is in learning `after` what was noted at `since` [UTC s], and which baseline is in force."""

    offers: list[MessageField]


class LoopRow(ApiResponse):
    """A loop: where it comes from, and what its signals are."""

    ref: dict[str, str]
    name: str
    plant: str
    sample_rate_hz: float
    controller: bool
    columns: JsonObject
    units: dict[str, str] | None
    toml: str | None


class LoopList(ApiResponse):
    """Loops that come with the program, and those of baselines."""

    loops: list[LoopRow]


class DesignRow(StorageRecord):
    """A study in a line."""

    kind = "designs"

    loop: str
    reference: str


class DesignList(ApiResponse):
    """Studies, the newest last."""

    designs: list[DesignRow]


class DesignDetail(DesignRow):
    """A study before deployment."""

    study: JsonObject


class FaultCheck(ApiResponse):
    """What to check for a fault; `who` wrote it for this asset `at` [UTC s]; None: nobody, loop or plant say it."""

    fault: str
    label: str
    texts: list[str]
    who: str | None = None
    at: float | None = None


class NotificationOutlet(ApiResponse):
    """A webhook, command, message or mail of the service file."""

    name: str
    kind: str  # webhook, command, mqtt or email
    target: str
    may_test: bool  # not what changes a machine
    last: JsonObject | None  # newest notification: t, event, attempts, and outcome, empty before the first attempt


class NotificationOutlets(ApiResponse):
    """All of them."""

    outlets: list[NotificationOutlet]


class SizeCurve(ApiResponse):
    """A fault or coefficient over time, as a ratio to healthy, with its 95 % intervals."""

    name: str
    kind: Literal["full", "live", "coefficient"]
    t: list[float]
    value: list[float]
    low: list[float]
    high: list[float]
    healthy: list[float]


class SizeHistory(ApiResponse):
    """How faults and coefficients of an asset have changed; of each of `points` equal parts of the time one value."""

    asset: str
    curves: list[SizeCurve]


class Note(NoteRequest, ApiResponse):
    """What somebody noted about an asset."""

    model_config = ConfigDict(extra="ignore")  # of later versions

    who: str
    kind: str = "note"  # type: ignore[assignment]


class NoteList(ApiResponse):
    """Notes in the order of time."""

    notes: list[Note]


class Forecast(Prognosis, ApiResponse):
    """A prognosis of an asset, with its sentences as text."""

    asset: str
    # headline, reasons, effects: in the sentences
    headline: MessageField = Field(exclude=True)
    reasons: tuple[MessageField, ...] = Field((), exclude=True)
    effects: dict[str, tuple[float, float, float]] = Field({}, exclude=True)


class LimitList(ApiResponse):
    """Limits by fault."""

    limits: list[OperatingLimit]
