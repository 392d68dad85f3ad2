"""What the interface takes: bodies and queries, from which OpenAPI describes requests."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, model_validator

from servoscope.baseline.records import Occasion
from servoscope.core.verdict import VerdictKind

T = TypeVar("T")
Text = Annotated[str, Field(max_length=1000)]
Id = Annotated[str, Field(min_length=1, max_length=150)]
UtcSeconds = Annotated[float, Field(allow_inf_nan=False, ge=-1e11, le=1e11)]  # [UTC s]
RelativeSeconds = Annotated[float, Field(allow_inf_nan=False, ge=-1e12, le=1e12)]
RowCount = Annotated[int, Field(ge=1, le=10_000)]
RowConditions = Annotated[dict[Annotated[str, Field(max_length=200)], Text], Field(max_length=20)]
NoiseStd = Annotated[float, Field(allow_inf_nan=False, ge=0.0, le=1e9)]
SignalExpression = Annotated[str, Field(min_length=1, max_length=500)]
CommandName = Literal["acknowledge", "reset", "shelve", "unshelve", "remove_from_service", "return_to_service"]
# kinds of motion, never a file: it would be one of the server's
ReferenceKind = Literal["profile", "multisine", "trapezoid", "steps", "chirp"]


class ApiRequest(BaseModel):
    """A request; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)


class LoginRequest(ApiRequest):
    """Name and password."""

    user: Annotated[str, Field(min_length=1, max_length=64)]
    password: Annotated[str, Field(min_length=1, max_length=1000)]


class CommandRequest(ApiRequest):
    """The reason for a command and, for shelving, how long [s]."""

    why: Text = ""
    for_s: Annotated[float, Field(gt=0.0, le=366.0 * 86400.0, allow_inf_nan=False)] | None = None


class AssetQuery(ApiRequest):
    """An asset, or a service; None: all of them."""

    asset: Text | None = None

    @property
    def assets(self) -> list[str]:
        """Its name; empty: all of them."""
        return [self.asset] if self.asset is not None else []


class LiveQuery(AssetQuery):
    """An asset, or all of them; `since`: the mark of what is known already, else all are sent first."""

    since: Annotated[str, Field(max_length=100)] = ""


class FleetQuery(ApiRequest):
    """Which assets to list, and which page of them; without `limit` all."""

    search: Text = ""
    group: Text | None = None
    verdict: VerdictKind | None = None
    limit: Annotated[int, Field(ge=1, le=1000)] | None = None
    offset: Annotated[int, Field(ge=0, le=10**9)] = 0

    def page(self, rows: list[T]) -> list[T]:
        """Return the rows of the page."""
        return rows[self.offset :][: self.limit]


class TimeQuery(ApiRequest):
    """A time from, and before [UTC s]."""

    since: UtcSeconds | None = Field(None, alias="from")
    until: UtcSeconds | None = Field(None, alias="to")

    @property
    def span(self) -> tuple[float | None, float | None]:
        """Both ends."""
        return self.since, self.until


class HistoryQuery(TimeQuery):
    """A time, in how many parts."""

    points: Annotated[int, Field(ge=10, le=5000)] = 500


class SizeQuery(HistoryQuery):
    """A time, in how many parts, of faults or of coefficients."""

    of: Literal["faults", "coefficients"] = "faults"


class TrendQuery(ApiRequest):
    """Of which fault or coefficient (None: the only fault), until which ratio to healthy, and from when on [UTC s]."""

    name: Id | None = None
    limit: Annotated[float, Field(allow_inf_nan=False, ge=-1e9, le=1e9)]
    since: UtcSeconds | None = Field(None, alias="from")


class NoteRequest(ApiRequest):
    """What was done to an asset and when [UTC s]; `anew`: its trend begins there."""

    t: UtcSeconds
    text: Annotated[str, Field(min_length=1, max_length=200)]
    anew: bool = False
    kind: Literal["note", "confirmed"] | Occasion = "note"


class RelearningRequest(ApiRequest):
    """What to learn an asset's baseline from: its samples of a time [UTC s], and what was done before."""

    since: UtcSeconds | None = Field(None, alias="from")
    until: UtcSeconds | None = Field(None, alias="to")
    after: Occasion | None = None
    why: Annotated[str, Field(max_length=200)] = ""
    accept_change: bool = False


class TakeRequest(ApiRequest):
    """The preview whose baseline is put in force; None: one step back, for a reason."""

    learning: Id | None = None
    why: Annotated[str, Field(max_length=200)] = ""


class RowQuery(TimeQuery):
    """The newest rows of a time."""

    last: RowCount = 200


class AuditQuery(RowQuery, AssetQuery):
    """The newest rows of an asset, or of all."""


class TransitionQuery(AuditQuery):
    """The newest transitions of one alarm, or of all."""

    alarm: Text | None = None


class DiagnosisQuery(AuditQuery):
    """The newest diagnoses with this verdict and origin."""

    verdict: VerdictKind | None = None
    grounds: Literal["examination", "full", "upload"] | None = None
    last: RowCount = 100


class SignalQuery(ApiRequest):
    """How many seconds, at most, until when [UTC s] (None: the newest sample), and with how many points."""

    until: UtcSeconds | None = Field(None, alias="to")
    seconds: Annotated[float, Field(gt=0.0, le=3600.0, allow_inf_nan=False)] = 30.0
    points: Annotated[int, Field(ge=10, le=20_000)] = 1000


class UploadQuery(ApiRequest):
    """The name of the file."""

    name: Annotated[str, Field(min_length=1, max_length=255)]


class JobQuery(ApiRequest):
    """How long to wait for the job to end [s]."""

    wait: Annotated[float, Field(ge=0.0, le=30.0, allow_inf_nan=False)] = 0.0


class ColumnMapping(ApiRequest):
    """The columns of the signals; those left out stay as in the loop."""

    time: SignalExpression | None = None
    reference: SignalExpression | None = None
    input: SignalExpression | None = None
    output: SignalExpression | None = None
    time_unit: Literal["s", "ms", "us", "ns", "min"] | None = None
    segment: Annotated[list[SignalExpression], Field(max_length=20)] | None = None

    def to_update(self) -> dict[str, Any]:
        """Return what replaces the loop's columns; only time may be set to None: samples without time stamps."""
        columns = self.model_dump(exclude_unset=True)
        return {key: value for key, value in columns.items() if value is not None or key == "time"}


class LoopRef(ApiRequest):
    """A loop: the text of its file, an example, or the one of a baseline: its id, in a job the path of its file."""

    toml: Annotated[str, Field(max_length=100_000)] | None = None
    baseline: Id | None = None
    example: Literal["reference-rig"] | None = None

    @model_validator(mode="after")
    def _check_exactly_one(self) -> Self:
        if sum(value is not None for value in (self.toml, self.baseline, self.example)) != 1:
            raise ValueError("give exactly one of toml, baseline, example")
        return self

    @property
    def files(self) -> tuple[str, ...]:
        """What a job reads for it."""
        return (self.baseline,) if self.baseline is not None else ()


class RecordingSelection(ApiRequest):
    """A part of an upload, and what its columns mean."""

    columns: ColumnMapping | None = None
    where: RowConditions = Field(default_factory=dict)
    from_s: RelativeSeconds | None = None
    to_s: RelativeSeconds | None = None


class InspectionRequest(RecordingSelection):
    """An upload to inspect."""

    upload: Id
    loop: LoopRef | None = None


class ProposalRequest(ApiRequest):
    """An upload to propose a loop file for; without columns by the names that the file has."""

    upload: Id
    columns: ColumnMapping | None = None


class DiagnosisRequest(RecordingSelection):
    """An upload to diagnose with a baseline."""

    upload: Id
    baseline: Id
    point: Text | None = None


class HealthyRecording(ApiRequest):
    """A healthy recording, perhaps at an operating point."""

    upload: Id
    point: Annotated[str, Field(pattern=r"^\w[\w-]*$", max_length=100)] | None = None


class LearningRequest(ApiRequest):
    """Healthy recordings to learn from."""

    loop: LoopRef
    recordings: Annotated[list[HealthyRecording], Field(min_length=1, max_length=100)]
    columns: ColumnMapping | None = None
    where: RowConditions = Field(default_factory=dict)
    compare: Id | None = None
    accept_change: bool = False
    population: Annotated[list[Id], Field(max_length=200)] = Field(default_factory=list)  # baselines of like machines


class BaselineRequest(ApiRequest):
    """A name for what was learned."""

    name: Annotated[str, Field(pattern=r"^\w[\w.-]*$", max_length=100)]
    learning: Id


class DesignRequest(ApiRequest):
    """A loop to study before deployment."""

    loop: LoopRef
    recordings: Annotated[list[Id], Field(max_length=20)] = Field(default_factory=list)
    columns: ColumnMapping | None = None
    reference: ReferenceKind = "profile"
    after_s: Annotated[float, Field(gt=0.0, le=3600.0, allow_inf_nan=False)] = 30.0
    noise_u_std: NoiseStd | None = None
    noise_y_std: NoiseStd | None = None


class CheckRequest(ApiRequest):
    """What to check on an asset for a fault; no text: as the loop or the plant says it."""

    fault: Id
    texts: Annotated[list[Annotated[str, Field(min_length=1, max_length=300)]], Field(max_length=10)]
