"""What the interface takes and answers: uploads, jobs, diagnoses, baselines, designs."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from servoscope.web.models import Asked, DiagnosisRow, Moment, Said, Text

__all__ = [
    "AskedDesign",
    "AskedDiagnosis",
    "AskedInspection",
    "AskedLearning",
    "Baseline",
    "BaselineRow",
    "Baselines",
    "Design",
    "Designs",
    "Diagnoses",
    "Diagnosis",
    "JobSaid",
    "LoopRef",
    "Loops",
    "NewBaseline",
    "OfDiagnoses",
    "OfJob",
    "OfUpload",
    "Upload",
    "Uploads",
]

Id = Annotated[str, Field(min_length=1, max_length=150)]
Where = Annotated[dict[Annotated[str, Field(max_length=200)], Text], Field(max_length=20)]
Seconds = Annotated[float, Field(allow_inf_nan=False, ge=-1e12, le=1e12)]
Noise = Annotated[float, Field(allow_inf_nan=False, ge=0.0, le=1e9)]
Signal = Annotated[str, Field(min_length=1, max_length=500)]
# kinds of motion, never a file: it would be one of the server's
Motion = Literal["profile", "multisine", "trapezoid", "steps", "chirp"]


class ColumnsAsked(Asked):
    """Where the signals stand; what is left out stays as in the loop."""

    time: Signal | None = None
    reference: Signal | None = None
    input: Signal | None = None
    output: Signal | None = None
    time_unit: Literal["s", "ms", "us", "ns", "min"] | None = None
    segment: Annotated[list[Signal], Field(max_length=20)] | None = None

    def given(self) -> dict[str, Any]:
        """Return what was said; only the time may be said to be none."""
        said = self.model_dump(exclude_unset=True)
        return {key: value for key, value in said.items() if value is not None or key == "time"}


class LoopRef(Asked):
    """A loop: the text of its file, the one of a baseline, or an example; exactly one of them."""

    toml: Annotated[str, Field(max_length=100_000)] | None = None
    baseline: Id | None = None
    example: Literal["reference-rig"] | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if sum(value is not None for value in (self.toml, self.baseline, self.example)) != 1:
            raise ValueError("give exactly one of toml, baseline, example")
        return self


class Part(Asked):
    """Which part of an upload, and what its columns mean."""

    columns: ColumnsAsked | None = None
    where: Where = Field(default_factory=dict)
    from_s: Seconds | None = None
    to_s: Seconds | None = None


class AskedInspection(Part):
    """An upload to inspect."""

    upload: Id
    loop: LoopRef | None = None


class AskedDiagnosis(Part):
    """An upload to diagnose, with a baseline."""

    upload: Id
    baseline: Id
    point: Text | None = None


class Healthy(Asked):
    """A healthy recording, perhaps at an operating point."""

    upload: Id
    point: Annotated[str, Field(pattern=r"^\w[\w-]*$", max_length=100)] | None = None


class AskedLearning(Asked):
    """Healthy recordings to learn from."""

    loop: LoopRef
    recordings: Annotated[list[Healthy], Field(min_length=1, max_length=100)]
    columns: ColumnsAsked | None = None
    where: Where = Field(default_factory=dict)
    compare: Id | None = None
    accept_change: bool = False


class NewBaseline(Asked):
    """A name for what was learned."""

    name: Annotated[str, Field(pattern=r"^\w[\w.-]*$", max_length=100)]
    learning: Id


class AskedDesign(Asked):
    """A loop to study before deployment."""

    loop: LoopRef
    recordings: Annotated[list[Id], Field(max_length=20)] = Field(default_factory=list)
    columns: ColumnsAsked | None = None
    reference: Motion = "profile"
    after_s: Annotated[float, Field(gt=0.0, le=3600.0, allow_inf_nan=False)] = 30.0
    noise_u_std: Noise | None = None
    noise_y_std: Noise | None = None


class OfUpload(Asked):
    """What the file is called."""

    name: Annotated[str, Field(min_length=1, max_length=255)]


class OfJob(Asked):
    """How long to wait for its end [s]."""

    wait: Annotated[float, Field(ge=0.0, le=30.0, allow_inf_nan=False)] = 0.0


class OfDiagnoses(Asked):
    """Of which asset, verdict, grounds and time; the newest so many."""

    asset: Text | None = None
    verdict: Literal["healthy", "fault", "undetermined"] | None = None
    grounds: Literal["examination", "full", "upload"] | None = None
    since: Moment | None = Field(None, alias="from")
    until: Moment | None = Field(None, alias="to")
    last: Annotated[int, Field(ge=1, le=10_000)] = 100


class JobSaid(Said):
    """A job: how far it is, and what came of it."""

    id: str
    kind: str
    state: Literal["queued", "running", "done", "failed"]
    step: str | None
    created: float
    finished: float | None
    result: dict[str, Any] | None
    problem: dict[str, Any] | None


class UploadRow(Said):
    """An upload in a line."""

    id: str
    name: str
    bytes: int
    at: float
    who: str


class Upload(UploadRow):
    """An upload with its columns, first rows, and what they may mean."""

    rows: int
    columns: list[dict[str, Any]]
    preview: dict[str, Any]
    mapping: dict[str, Any]


class Uploads(Said):
    """Uploads, the newest last."""

    uploads: list[UploadRow]


class Diagnoses(Said):
    """Diagnoses, the newest last."""

    diagnoses: list[DiagnosisRow]


class Diagnosis(DiagnosisRow):
    """A diagnosis with all that it says."""

    document: dict[str, Any]
    words: dict[str, str]
    began: float | None
    who: str | None
    baseline: dict[str, Any] | None
    units: dict[str, str] | None
    signals: dict[str, Any] | None
    trace: dict[str, Any] | None
    report: str | None


class BaselineRow(Said):
    """A baseline in a line."""

    id: str
    name: str
    origin: Literal["service", "saved"]
    loop: str
    hash: str
    points: list[str]
    assets: list[str]
    recordings: int
    duration_s: float
    at: float | None
    who: str | None


class Baselines(Said):
    """All baselines."""

    baselines: list[BaselineRow]


class Baseline(BaselineRow):
    """A baseline with what was learned."""

    summary: dict[str, Any]
    units: dict[str, str] | None


class Loops(Said):
    """Loops that come with the program, and those of baselines."""

    loops: list[dict[str, Any]]


class DesignRow(Said):
    """A study in a line."""

    id: str
    loop: str
    reference: str
    at: float
    who: str


class Designs(Said):
    """Studies, the newest last."""

    designs: list[DesignRow]


class Design(DesignRow):
    """A study before deployment."""

    study: dict[str, Any]
