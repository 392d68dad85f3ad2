"""What is alarmed, from the section `[alarms]`: sources, delays, latching, priority, consequence and what to do."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, model_validator

from servoscope.complaints import describe
from servoscope.quality import KINDS
from servoscope.settings import Finite, NotNegative, Positive, Settings

__all__ = ["DEFAULTS", "FAULT", "PRIORITIES", "AlarmDefinition", "AlarmSettings", "FloodSettings", "Ne107", "Priority"]

Text = Annotated[str, Field(strict=True)]

Source = Literal["verdict", "quality", "statistic", "level", "buffered"]
Priority = Literal["low", "medium", "high", "critical"]
Ne107 = Literal["good", "maintenance_required", "out_of_specification", "function_check", "failure"]

PRIORITIES: tuple[Priority, ...] = ("low", "medium", "high", "critical")
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
OWN: tuple[Source, ...] = ("buffered",)  # sources of the service itself
WORDS: dict[str, tuple[str, ...]] = {"verdict": ("fault", "undetermined"), "quality": KINDS}


class AlarmDefinition(Settings):
    """One alarm of an asset.

    Parameters
    ----------
    enabled
        Whether there is this alarm at all.
    source
        What is watched: the ``verdict``, the findings of data ``quality``, the ``statistic`` T^2 or the sequential
        test's ``level`` as multiples of their limits, or what waits to be stored, ``buffered``, as a share of the
        buffer.
    when
        Words of the source that are abnormal, for ``verdict`` and ``quality``; None: ``fault``, and any finding.
    limit
        Value from which on a number is abnormal.
    hysteresis
        How far below the limit the number has to fall to be normal again; in units of the number.
    on_delay_s, off_delay_s
        How long the condition has to be abnormal before the alarm occurs, and normal before it clears [s].
    latching
        Whether the alarm stays, after its condition has returned to normal, until it is reset.
    priority, consequence, operator_action, response_time_s
        How urgent it is; what happens if nobody answers; what to do; within which time [s].
    ne107
        Status after NAMUR NE 107 that it gives to the asset.
    suppressed_when
        Names of other alarms, or findings of data quality, that suppress it by design while they stand.
    """

    enabled: Annotated[bool, Field(strict=True)] = True
    source: Source
    when: tuple[Text, ...] | None = None
    limit: Finite = 1.0
    hysteresis: NotNegative = 0.0
    on_delay_s: NotNegative = 0.0
    off_delay_s: NotNegative = 0.0
    latching: Annotated[bool, Field(strict=True)] = False
    priority: Priority = "medium"
    consequence: Text = ""
    operator_action: Text = ""
    response_time_s: Positive | None = None
    ne107: Ne107 = "maintenance_required"
    suppressed_when: tuple[Text, ...] = ()

    @model_validator(mode="after")
    def _words_of_the_source(self) -> Self:
        known = WORDS.get(self.source)
        if known is None and self.when is not None:
            raise ValueError(f"when: source {self.source!r} is a number, give limit instead")
        if known is not None and (strange := [word for word in self.when or () if word not in known]):
            raise ValueError(f"when: {strange[0]!r} is not a word of source {self.source!r}: {', '.join(known)}")
        if self.when == ():
            raise ValueError("when: must not be empty, leave it out for all")
        return self

    @property
    def words(self) -> tuple[str, ...]:
        """Words of the source that are abnormal; empty where the source is a number."""
        if self.when is not None:
            return self.when
        return {"verdict": ("fault",), "quality": KINDS}.get(self.source, ())


class FloodSettings(Settings):
    """When the alarms of a fleet are a flood, and what is still announced in it.

    Parameters
    ----------
    limit, period_s
        A flood begins with more than `limit` new alarms within `period_s`.
    ends_below
        It ends when there are fewer than this.
    announced_from
        Lowest priority that is announced in a flood; the others are held until it ends.
    """

    limit: Annotated[int, Field(strict=True, ge=1)] = 10
    period_s: Positive = 600.0
    ends_below: Annotated[int, Field(strict=True, ge=1)] = 5
    announced_from: Priority = "high"

    @model_validator(mode="after")
    def _ends_before_it_begins(self) -> Self:
        if self.ends_below > self.limit:
            raise ValueError(f"ends_below: must be at most limit ({self.limit})")
        return self


FAULT = "fault"  # the alarm that diagnoses and fault-tolerant actions go by
DEFAULTS: dict[str, dict[str, Any]] = {
    "fault": {
        "source": "verdict",
        "off_delay_s": 60.0,
        "latching": True,
        "priority": "high",
        "consequence": "the actuator wears or loses performance, and may fail",
        "operator_action": "look at the diagnosis, plan an inspection of what it names, then reset",
        "response_time_s": 3600.0,
        "ne107": "maintenance_required",
    },
    "undetermined": {
        "source": "verdict",
        "when": ("undetermined",),
        "on_delay_s": 3600.0,
        "priority": "low",
        "consequence": "a fault would not be noticed",
        "operator_action": "see whether the axis moves enough to be judged, and whether its data are sound",
        "response_time_s": 86400.0,
        "ne107": "function_check",
        "suppressed_when": ("data_quality",),
    },
    "data_quality": {
        "source": "quality",
        "when": tuple(kind for kind in KINDS if kind != "waiting"),
        "on_delay_s": 10.0,
        "off_delay_s": 60.0,
        "priority": "medium",
        "consequence": "the asset is not monitored; its verdict is undetermined",
        "operator_action": "check sensor, cable, clock and logging of the signal named",
        "response_time_s": 3600.0,
        "ne107": "out_of_specification",
    },
    "buffering": {
        "source": "buffered",
        "limit": 0.5,
        "hysteresis": 0.4,
        "on_delay_s": 10.0,
        "off_delay_s": 60.0,
        "priority": "high",
        "consequence": "results wait in memory; when the buffer is full the sources are stopped",
        "operator_action": "check the database: disk space, locks, connection",
        "response_time_s": 900.0,
        "ne107": "good",
    },
}  # a table of the same name changes keys of one of them, another name adds an alarm


class AlarmSettings(Settings):
    """The section `[alarms]`: keys of the flood, and one table per alarm, laid over `DEFAULTS`.

    Parameters
    ----------
    flood
        The table `[alarms.flood]`.
    definitions
        By name: all other tables of the section.
    """

    flood: FloodSettings = FloodSettings()
    definitions: dict[str, AlarmDefinition]

    @model_validator(mode="before")
    @classmethod
    def _over_defaults(cls, data: Any) -> Any:
        """Take the section as it is written; each alarm is validated here, so that complaints name its table."""
        if not isinstance(data, Mapping) or "definitions" in data:
            return data
        laid: dict[str, Any] = {name: dict(default) for name, default in DEFAULTS.items()}
        for name, table in data.items():
            if name != "flood":
                laid[name] = {**laid.get(name, {}), **table} if isinstance(table, Mapping) else table
        section = {key: value for key, value in data.items() if key == "flood"}
        return {**section, "definitions": {name: _definition(name, table) for name, table in laid.items()}}

    @model_validator(mode="after")
    def _suppressed_by_what_there_is(self) -> Self:
        known = {*self.definitions, *KINDS}
        for name, definition in self.definitions.items():
            strange = [word for word in definition.suppressed_when if word not in known or word == name]
            if strange:
                raise ValueError(f"{name}: suppressed_when: no other alarm or finding is called {strange[0]!r}")
        return self

    @property
    def of_asset(self) -> dict[str, AlarmDefinition]:
        """The alarms that each asset has, by name."""
        there = {name: one for name, one in self.definitions.items() if one.enabled and one.source not in OWN}
        # What suppresses stands before what is suppressed, so that both happen in the same step.
        return dict(sorted(there.items(), key=lambda item: bool(item[1].suppressed_when)))

    @property
    def of_service(self) -> dict[str, AlarmDefinition]:
        """The alarms that the service has of itself, by name."""
        return {name: one for name, one in self.definitions.items() if one.enabled and one.source in OWN}


def _definition(name: str, table: Any) -> AlarmDefinition:
    if not NAME.fullmatch(name):
        raise ValueError(f"{name!r} is no name for an alarm: a letter, then letters, digits, _ and -")
    if not isinstance(table, Mapping):
        raise ValueError(f"{name}: {table!r} is not a table of settings")
    try:
        return AlarmDefinition.model_validate(table)
    except ValidationError as error:
        raise ValueError(f"{name}.{describe(error, AlarmDefinition)}") from None
