"""What the interface takes: bodies and queries; what OpenAPI says of requests comes from here."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

__all__ = [
    "Asked",
    "AskedDesign",
    "AskedDiagnosis",
    "AskedInspection",
    "AskedLearning",
    "ColumnsAsked",
    "CommandName",
    "Healthy",
    "Login",
    "LoopRef",
    "NewBaseline",
    "OfAlarmRows",
    "OfAlarms",
    "OfAudit",
    "OfDiagnoses",
    "OfFleet",
    "OfHistory",
    "OfJob",
    "OfLive",
    "OfRows",
    "OfSignals",
    "OfUpload",
    "Part",
    "Reasons",
    "Verdict",
]

MOST_ROWS = 10_000
Text = Annotated[str, Field(max_length=1000)]
Moment = Annotated[float, Field(allow_inf_nan=False, ge=-1e11, le=1e11)]  # [UTC s]
Last = Annotated[int, Field(ge=1, le=MOST_ROWS)]
CommandName = Literal["acknowledge", "reset", "shelve", "unshelve", "remove_from_service", "return_to_service"]
Verdict = Literal["healthy", "fault", "undetermined"]
Id = Annotated[str, Field(min_length=1, max_length=150)]
Where = Annotated[dict[Annotated[str, Field(max_length=200)], Text], Field(max_length=20)]
Seconds = Annotated[float, Field(allow_inf_nan=False, ge=-1e12, le=1e12)]
Noise = Annotated[float, Field(allow_inf_nan=False, ge=0.0, le=1e9)]
Signal = Annotated[str, Field(min_length=1, max_length=500)]
# kinds of motion, never a file: it would be one of the server's
Motion = Literal["profile", "multisine", "trapezoid", "steps", "chirp"]


class Asked(BaseModel):
    """What is asked: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)


class Login(Asked):
    """Name and password."""

    user: Annotated[str, Field(min_length=1, max_length=64)]
    password: Annotated[str, Field(min_length=1, max_length=1000)]


class Reasons(Asked):
    """Why, and for shelving for how long [s]."""

    why: Text = ""
    for_s: Annotated[float, Field(gt=0.0, le=366.0 * 86400.0, allow_inf_nan=False)] | None = None


class OfFleet(Asked):
    """Which assets."""

    search: Text = ""
    group: Text | None = None
    verdict: Verdict | None = None


class OfLive(Asked):
    """Of which asset; None: of all."""

    asset: Text | None = None


class OfAlarms(Asked):
    """Of which asset, or service; None: of all."""

    asset: Text | None = None


class OfHistory(Asked):
    """From, and before, a time [UTC s], in so many parts."""

    since: Moment | None = Field(None, alias="from")
    until: Moment | None = Field(None, alias="to")
    points: Annotated[int, Field(ge=10, le=5000)] = 500


class OfRows(Asked):
    """From, and before, a time [UTC s]; the newest so many."""

    since: Moment | None = Field(None, alias="from")
    until: Moment | None = Field(None, alias="to")
    last: Last = 200


class OfAudit(OfRows):
    """Of one asset, or of all."""

    asset: Text | None = None


class OfAlarmRows(OfAudit):
    """Of one alarm, or of all."""

    alarm: Text | None = None


class OfSignals(Asked):
    """How many seconds, at most, and with how many points."""

    seconds: Annotated[float, Field(gt=0.0, le=3600.0, allow_inf_nan=False)] = 30.0
    points: Annotated[int, Field(ge=10, le=20_000)] = 1000


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
