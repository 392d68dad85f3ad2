"""What the interface answers of sessions, assets and alarms; what OpenAPI says of answers comes from here."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from servoscope.access import Role
from servoscope.web.asked import CommandName, Verdict

__all__ = [
    "AdvisedAlarm",
    "Alarm",
    "Alarms",
    "AssetDetail",
    "AssetRow",
    "Audit",
    "Commanded",
    "DiagnosisRow",
    "Entry",
    "Fleet",
    "Flood",
    "ParameterNow",
    "Problem",
    "ResidualColumns",
    "ResidualHistory",
    "ResponseNow",
    "Said",
    "ServiceRow",
    "SessionSaid",
    "Signals",
    "Size",
    "Transition",
    "Transitions",
]

Numbers = list[float | None]


class Said(BaseModel):
    """What is answered."""

    model_config = ConfigDict(populate_by_name=True)


class Problem(Said):
    """An error after RFC 9457."""

    type: str
    title: str
    status: int
    detail: str
    instance: str | None = None
    errors: list[dict[str, str]] | None = None


class SessionSaid(Said):
    """Who asks, and what changing requests must repeat."""

    login_required: bool
    user: str | None
    role: Role | None
    csrf: str | None
    expires: float | None
    version: str


class Alarm(Said):
    """An alarm that is not normal, with the commands that mean something now."""

    asset: str
    alarm: str
    state: str
    since: float
    priority: str | None
    cause: str
    until: float | None
    commands: list[CommandName]


class AdvisedAlarm(Alarm):
    """An alarm with what the service file says of it."""

    consequence: str | None
    operator_action: str | None
    response_time_s: float | None


class Flood(Said):
    """A flood of alarms: since when, how many, and how many are held back."""

    since: float | None
    counted: int
    held: int


class Alarms(Said):
    """Alarms, the most urgent first."""

    now: float
    alarms: list[AdvisedAlarm]
    flood: Flood | None


class Size(Said):
    """A fault's size: a parameter as a multiple of its healthy value, with its 95 % interval."""

    name: str
    words: str
    parameter: str
    ratio: float
    low: float
    high: float


class AssetRow(Said):
    """An asset as the fleet shows it."""

    asset: str
    group: str
    verdict: Verdict
    summary: str
    since: float
    onset: float | None
    examined: float | None
    ne107: str
    reasons: list[str]
    quality: list[str]
    statistic: float | None
    level: float | None
    deviation: float | None
    alarms: list[Alarm]
    sizes: list[Size]
    t: float
    at: float
    severity: float


class ServiceRow(Said):
    """What a service says of itself."""

    service: str
    flood: Flood
    alarms: list[Alarm]


class Fleet(Said):
    """All assets."""

    now: float
    assets: list[AssetRow]
    groups: list[str]
    services: list[ServiceRow]


class ResponseNow(Said):
    """The inverse response at one frequency, the healthy one, and a 95 % ellipse: semi-axes and angle."""

    frequency_hz: float
    real: float
    imag: float
    nominal_real: float
    nominal_imag: float
    ellipse: list[float] | None


class ParameterNow(Said):
    """A coefficient with its 95 % interval, and what a healthy loop would show."""

    name: str
    value: float
    std: float
    low: float
    high: float
    nominal: float
    unit: str


class DiagnosisRow(Said):
    """A diagnosis in a line."""

    id: str
    asset: str | None
    number: int | None
    t: float
    grounds: str
    verdict: Verdict
    summary: str
    onset: float | None
    recording: str | None


class AssetDetail(AssetRow):
    """An asset with all that is known of it now."""

    now: float
    exceeded: bool | None
    responses: list[ResponseNow]
    parameters: list[ParameterNow]
    counted: dict[str, int | float]
    about: dict[str, Any]
    baseline: str | None
    awaited: list[int]
    diagnosis: DiagnosisRow | None
    window_s: float | None


class ResidualColumns(Said):
    """The residual at one frequency over time, and the size of the healthy response."""

    frequency_hz: float
    real: Numbers
    imag: Numbers
    healthy: Numbers


class ResidualHistory(Said):
    """Statistics and residuals over a time."""

    asset: str
    from_: float = Field(alias="from")
    to: float
    bucket_s: float
    rows: int
    t: list[float]
    statistic: list[float]
    level: list[float]
    residuals: list[ResidualColumns]


class Signals(Said):
    """The last seconds as measured; None where nothing was."""

    asset: str
    sequence: int | None
    samples: int
    units: dict[str, str] | None
    t: Numbers
    r: Numbers
    u: Numbers
    y: Numbers


class Transition(Said):
    """A line of an alarm's history."""

    asset: str
    number: int
    t: float
    alarm: str
    before: str
    after: str
    event: str
    priority: str | None
    cause: str
    who: str


class Transitions(Said):
    """Lines of the alarms' history, the newest last."""

    transitions: list[Transition]


class Commanded(Said):
    """What became of a command; no outcome while the service does not run."""

    asset: str
    alarm: str
    command: str
    who: str
    outcome: str | None


class Entry(Said):
    """A line of the audit."""

    id: int
    at: float
    who: str
    asset: str
    what: str
    document: dict[str, Any]


class Audit(Said):
    """Lines of the audit, the newest last."""

    entries: list[Entry]
