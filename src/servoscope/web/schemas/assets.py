"""What the interface answers of assets and alarms: the status that the store keeps of each, with derived values."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, get_args

from pydantic import Field

from servoscope.estimation.frequency_response import CHI2_95_2DOF, ResponseRow
from servoscope.prognosis.series import NORMAL_95
from servoscope.report.document import to_json
from servoscope.service.alarms import FAULT_ALARM, TRANSITION_TABLE, LifecycleEvent, LifecycleState
from servoscope.service.alarms.records import UNACKNOWLEDGED_STATES
from servoscope.service.assets.condition import asset_condition
from servoscope.service.assets.outlook import Outlook
from servoscope.service.assets.status import AlarmStatus, AssetStatus, AssetVerdict, FloodCounts, ServiceStatus
from servoscope.web.asset_document import asset_document
from servoscope.web.schemas.requests import CommandName
from servoscope.web.schemas.responses import (
    ApiResponse,
    DiagnosisRow,
    FaultCheck,
    JsonObject,
    NullableFloats,
    SignalColumns,
)
from servoscope.web.statuses import alarm_rank, severity
from servoscope.web.stored_diagnosis import read_diagnosis, stored_headline

COMMAND_NAMES: tuple[CommandName, ...] = get_args(CommandName)


class AlarmRow(AlarmStatus, ApiResponse):
    """An alarm that is not normal, with the commands that are possible in its state."""

    asset: str
    alarm: str
    commands: list[CommandName]

    @property
    def rank(self) -> int:
        """How urgent its priority is, from 1; 0 without one."""
        return alarm_rank(self.priority)

    @property
    def unacknowledged(self) -> bool:
        """Whether it waits for an operator."""
        return self.state in UNACKNOWLEDGED_STATES


class AlarmDetail(AlarmRow):
    """An alarm with its advice from the service file."""

    consequence: str | None
    operator_action: str | None
    response_time_s: float | None
    checks: list[FaultCheck]
    diagnosis: DiagnosisRow | None


class AlarmList(ApiResponse):
    """Alarms, the most urgent first; `mark`: as in the list of assets."""

    now: float
    mark: str
    alarms: list[AlarmDetail]
    flood: FloodCounts | None


class TransitionRow(ApiResponse):
    """A line of an alarm's history."""

    asset: str
    number: int
    t: float
    alarm: str
    before: str
    after: str
    event: str = ""
    priority: str | None = None
    cause: str
    who: str

    @classmethod
    def from_stored(cls, row: Mapping[str, Any]) -> TransitionRow:
        """Return a row of the store."""
        return cls.model_validate({**row["document"], **row})


class TransitionList(ApiResponse):
    """Lines of the alarms' history, the newest last."""

    transitions: list[TransitionRow]


class CommandResult(ApiResponse):
    """The outcome of a command; None while the service does not run."""

    asset: str
    alarm: str
    command: str
    who: str
    outcome: str | None


class FaultSize(ApiResponse):
    """A fault's size: a parameter as a multiple of its healthy value, with its 95 % interval."""

    name: str
    words: str
    parameter: str
    ratio: float
    low: float
    high: float


class OutlookRow(Outlook, ApiResponse):
    """When a fault reaches its limit."""

    t: float = Field(exclude=True)


class AssetRow(AssetVerdict, ApiResponse):
    """An asset in the list of the fleet."""

    asset: str
    group: str
    source: str
    quality: list[str]
    statistic: float | None
    level: float | None
    deviation: float | None
    alarms: list[AlarmRow]
    sizes: list[FaultSize]
    outlook: OutlookRow | None
    heard: bool
    pause_s: float
    t: float
    at: float
    severity: float

    @classmethod
    def from_status(cls, name: str, at: float, status: AssetStatus) -> AssetRow:
        """Return the row of an asset whose status was stored at a time [UTC s]."""
        condition = asset_condition(status)
        alarms = status_alarms(name, status)
        derived = {
            "asset": name,
            "summary": condition.headline,
            "group": status.metadata.group,
            "source": status.metadata.source,
            "quality": list(status.quality),
            "deviation": relative_residual(status),
            "alarms": alarms,
            "sizes": fault_sizes(status),
            "sized": condition.sized,
            "outlook": status.outlook.model_dump() if status.outlook else None,
            "learning": status.learning,
            "heard": status.reception == "followed" and "silent" not in status.quality,
            "pause_s": status.metadata.pause_s,
            "t": status.position.t,
            "at": at,
            "severity": severity(status),
        }
        return cls.model_validate({**dict(status), **derived})


class ServiceRow(ApiResponse):
    """A service: its flood of alarms, and its own ones."""

    service: str
    flood: FloodCounts
    alarms: list[AlarmRow]

    @classmethod
    def from_status(cls, name: str, status: ServiceStatus) -> ServiceRow:
        """Return the row of a service."""
        return cls(service=name, flood=status.flood, alarms=status_alarms(name, status))


class FleetStatus(ApiResponse):
    """Assets, the most urgent first.

    `configured`: how many the service file has; `total`: how many are like what was asked for, on all pages; `mark`:
    what ``/live?since=`` sends the changes since.
    """

    now: float
    configured: int
    total: int
    mark: str
    assets: list[AssetRow]
    groups: list[str]
    services: list[ServiceRow]


class IfrfEstimate(ApiResponse):
    """The iFRF at one frequency, the healthy one, and a 95 % ellipse: semi-axes and angle."""

    frequency_hz: float
    real: float
    imag: float
    nominal_real: float
    nominal_imag: float
    ellipse: list[float] | None

    @classmethod
    def from_row(cls, row: ResponseRow) -> IfrfEstimate:
        """Return the estimate with the ellipse of its covariance."""
        mean, difference = (row.real_variance + row.imag_variance) / 2.0, row.real_variance - row.imag_variance
        half = math.hypot(difference / 2.0, row.covariance)
        axes = [math.sqrt(CHI2_95_2DOF * max(variance, 0.0)) for variance in (mean + half, mean - half)]
        return cls(**row._asdict(), ellipse=[*axes, 0.5 * math.atan2(2.0 * row.covariance, difference)])


class CoefficientInterval(ApiResponse):
    """A coefficient with its 95 % interval, and its healthy value."""

    name: str
    value: float
    std: float
    low: float
    high: float
    nominal: float
    unit: str


class AssetFacts(ApiResponse):
    """What never changes of an asset."""

    loop: str | None
    plant: str | None
    sample_rate_hz: float | None
    baseline: str | None
    point: str | None
    units: dict[str, str] | None


class AssetDetail(AssetRow):
    """An asset with all that is known of it now."""

    now: float
    exceeded: bool | None
    responses: list[IfrfEstimate]
    parameters: list[CoefficientInterval]
    counted: dict[str, int | float]
    about: AssetFacts
    baseline: str | None
    awaited: tuple[int, ...]
    diagnosis: DiagnosisRow | None
    sections: list[JsonObject]
    checks: list[FaultCheck]
    window_s: float | None

    @classmethod
    def build(
        cls,
        name: str,
        at: float,
        status: AssetStatus,
        *,
        baseline: str | None,
        row: Mapping[str, Any] | None,
        checks: list[FaultCheck],
    ) -> AssetDetail:
        """Return an asset with the id of its baseline, the row of its last full diagnosis, and what to check."""
        full = read_diagnosis(row["document"]) if row is not None else None
        texts = [text for check in checks for text in check.texts]
        metadata = status.metadata
        return cls(
            **dict(AssetRow.from_status(name, at, status)),
            now=time.time(),
            exceeded=status.exceeded if status.t is not None else None,
            responses=[IfrfEstimate.from_row(row) for row in status.responses],
            parameters=coefficient_intervals(status),
            counted={key: x for key, x in asdict(status.position).items() if key not in ("digest", "rows")},
            about=AssetFacts.model_validate({**dict(metadata), "units": signal_units(metadata.units)}),
            baseline=baseline,
            awaited=status.pending_diagnoses,
            diagnosis=DiagnosisRow.from_stored(row) if row is not None else None,
            sections=to_json(asset_document(status, full, texts, stored_headline(row) if row is not None else "")),
            checks=checks,
            window_s=metadata.window_s,
        )


class ResidualSeries(ApiResponse):
    """The iFRF's residual at one frequency over time, and the size of the healthy response."""

    frequency_hz: float
    real: NullableFloats
    imag: NullableFloats
    healthy: NullableFloats


class ResidualHistory(ApiResponse):
    """Statistics and residuals over a time."""

    asset: str
    from_: float = Field(serialization_alias="from")
    to: float
    bucket_s: float
    rows: int
    t: list[float]
    statistic: list[float]
    level: list[float]
    residuals: list[ResidualSeries]


class RecentSignals(SignalColumns):
    """The last seconds as measured."""

    asset: str
    sequence: int | None
    samples: int
    units: dict[str, str] | None


def alarm_rows(asset: str, alarms: Mapping[str, AlarmStatus]) -> list[AlarmRow]:
    """Return the alarms of a status that are not normal."""
    return [
        AlarmRow(
            asset=asset,
            alarm=name,
            commands=[
                command for command in COMMAND_NAMES if (alarm.state, LifecycleEvent(command)) in TRANSITION_TABLE
            ],
            **dict(alarm),
        )
        for name, alarm in alarms.items()
        if alarm.state is not LifecycleState.NORMAL
    ]


def status_alarms(name: str, status: AssetStatus | ServiceStatus) -> list[AlarmRow]:
    """Return the alarms of a status that are not normal; that of a fault says of it what the headline does."""
    rows = alarm_rows(name, status.alarms)
    if not isinstance(status, AssetStatus) or status.verdict != "fault":
        return rows
    condition = asset_condition(status)
    # its alarm's state is younger once somebody has answered
    fault = {"since": condition.since, "cause": condition.sentence}
    return [row.model_copy(update=fault) if row.alarm == FAULT_ALARM else row for row in rows]


def fault_sizes(status: AssetStatus) -> list[FaultSize]:
    """Return the sizes of the faults of a status; none while data quality overrules it."""
    words = status.metadata.faults
    return [
        FaultSize(
            name=fault.name,
            words=words.get(fault.name, fault.name),
            parameter=fault.parameter,
            ratio=fault.ratio,
            low=fault.interval[0],
            high=fault.interval[1],
        )
        for fault in asset_condition(status).sizes
    ]


def coefficient_intervals(status: AssetStatus) -> list[CoefficientInterval]:
    """Return the coefficients of the newest evaluation."""
    units = itertools.chain(status.metadata.coefficient_units, itertools.repeat(""))
    return [
        CoefficientInterval(
            name=name,
            value=value,
            std=std,
            low=value - NORMAL_95 * std,
            high=value + NORMAL_95 * std,
            nominal=nominal,
            unit=unit,
        )
        for (name, value, std, nominal), unit in zip(status.parameters, units, strict=False)
    ]


def relative_residual(status: AssetStatus) -> float | None:
    """Return the iFRF's largest residual as a share of the healthy response."""
    shares = [
        math.hypot(real, imaginary) / healthy
        for _, real, imaginary, healthy in status.residual
        if real is not None and imaginary is not None and healthy
    ]
    return max(shares, default=None)


def signal_units(units: Sequence[str]) -> dict[str, str] | None:
    """Return the units of signals and response by name, from those of y and u; None where they are not known."""
    if not units:
        return None
    y, u = units
    return {"r": y, "u": u, "y": y, "response": f"{u or 'u'}/{y or 'y'}"}
