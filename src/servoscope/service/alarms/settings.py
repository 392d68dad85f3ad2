"""What is alarmed, from the section `[alarms]`: sources, delays, latching, priority, consequence and what to do."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, model_validator

from servoscope.assessment.assess import DOUBTS
from servoscope.core.messages import message, render
from servoscope.core.settings import Finite, NonNegative, Positive, Settings
from servoscope.core.settings_errors import describe_error
from servoscope.service.assets.reception import ALARMED_STATES, STATES
from servoscope.signals.quality import KINDS

StrictText = Annotated[str, Field(strict=True)]

AlarmSource = Literal[
    "verdict", "quality", "reception", "outlook", "statistic", "level", "control",
    "buffered", "connection", "left_out", "backlog",
]  # fmt: skip
Priority = Literal["low", "medium", "high", "critical"]
Ne107 = Literal["good", "maintenance_required", "out_of_specification", "function_check", "failure"]

PRIORITIES: tuple[Priority, ...] = ("low", "medium", "high", "critical")
ALARM_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
TROUBLE_SOURCES: tuple[AlarmSource, ...] = ("connection", "left_out", "backlog")  # in words, for each name of its kind
SERVICE_SOURCES: tuple[AlarmSource, ...] = ("buffered", *TROUBLE_SOURCES)  # sources of the service itself
SOURCE_WORDS: dict[str, tuple[str, ...]] = {
    "verdict": ("fault", "undetermined"), "quality": KINDS, "reception": STATES,
    "outlook": ("near", "reached"), "control": DOUBTS, **dict.fromkeys(TROUBLE_SOURCES, ("trouble",)),
}  # fmt: skip
ABNORMAL_WORDS: dict[str, tuple[str, ...]] = {  # where `when` says nothing
    "verdict": ("fault",), "quality": KINDS, "reception": ALARMED_STATES,
    "outlook": ("near", "reached"), "control": DOUBTS, **dict.fromkeys(TROUBLE_SOURCES, ("trouble",)),
}  # fmt: skip


class AlarmDefinition(Settings):
    """One alarm of an asset."""

    enabled: Annotated[bool, Field(strict=True)] = True  # whether there is this alarm at all
    # the ``verdict``, the findings of data ``quality``, how samples come in (``reception``), when a fault reaches its
    # limit (``outlook``, of assets that have a limit), the ``statistic`` T^2 or
    # the sequential test's ``level`` as multiples of their limits, or what the last minutes of ``control`` show
    # without a baseline (`servoscope assess`); of the service itself the share of the buffer that
    # waits to be stored, ``buffered``, the ``connection`` of each source and outlet, each asset that is ``left_out``,
    # and the ``backlog`` of each source of files
    source: AlarmSource
    # words of the source that are abnormal, where it has words; None: ``fault``, any finding, any trouble
    when: tuple[StrictText, ...] | None = None
    limit: Finite = 1.0  # value from which on a number is abnormal
    # how far below the limit the number has to fall to be normal again; in units of the number
    hysteresis: NonNegative = 0.0
    # on_delay_s, off_delay_s: how long the condition is abnormal before the alarm occurs, normal before it clears [s]
    on_delay_s: NonNegative = 0.0
    off_delay_s: NonNegative = 0.0
    # whether the alarm stays, after its condition has returned to normal, until it is reset
    latching: Annotated[bool, Field(strict=True)] = False
    # how urgent it is; what happens if nobody responds; what to do; within which time [s]
    priority: Priority = "medium"
    consequence: StrictText = ""
    operator_action: StrictText = ""
    response_time_s: Positive | None = None
    ne107: Ne107 = "maintenance_required"  # status after NAMUR NE 107 that it gives to the asset
    # names of other alarms, or findings of data quality, that suppress it by design while they stand
    suppressed_when: tuple[StrictText, ...] = ()

    @model_validator(mode="after")
    def _check_words(self) -> Self:
        known = SOURCE_WORDS.get(self.source)
        if known is None and self.when is not None:
            raise ValueError(f"when: source {self.source!r} is a number, give limit instead")
        for word in self.when or ():
            if known is not None and word not in known:
                raise ValueError(f"when: {word!r} is not a word of source {self.source!r}: {', '.join(known)}")
        if self.when == ():
            raise ValueError("when: must not be empty, leave it out for all")
        return self

    @property
    def abnormal_words(self) -> tuple[str, ...]:
        """Words of the source that are abnormal; empty where the source is a number."""
        return self.when if self.when is not None else ABNORMAL_WORDS.get(self.source, ())


class FloodSettings(Settings):
    """When the alarms of a fleet are a flood, and what is still announced in it."""

    # limit, period_s: a flood begins with more than `limit` new alarms within `period_s`
    limit: Annotated[int, Field(strict=True, ge=1)] = 10
    period_s: Positive = 600.0
    ends_below: Annotated[int, Field(strict=True, ge=1)] = 5  # it ends when there are fewer than this
    announced_from: Priority = "high"  # lowest priority that is announced in a flood; the others are held until it ends

    @model_validator(mode="after")
    def _check_hysteresis(self) -> Self:
        if self.ends_below > self.limit:
            raise ValueError(f"ends_below: must be at most limit ({self.limit})")
        return self


FAULT_ALARM = "fault"  # the alarm that diagnoses and fault-tolerant actions refer to
DEFAULT_ALARMS: dict[str, dict[str, Any]] = {  # a table of the same name changes keys, another name adds an alarm
    "fault": {
        "source": "verdict", "off_delay_s": 60.0, "latching": True,
        "priority": "high", "response_time_s": 3600.0, "ne107": "maintenance_required",
    },
    "undetermined": {
        "source": "verdict", "when": ("undetermined",), "on_delay_s": 3600.0, "suppressed_when": ("data_quality",),
        "priority": "low", "response_time_s": 86400.0, "ne107": "function_check",
    },
    "data_quality": {
        "source": "quality", "when": tuple(kind for kind in KINDS if kind != "waiting"),
        "on_delay_s": 10.0, "off_delay_s": 60.0,
        "priority": "medium", "response_time_s": 3600.0, "ne107": "out_of_specification",
    },
    "reception": {
        "source": "reception", "on_delay_s": 30.0, "off_delay_s": 10.0,
        "priority": "medium", "response_time_s": 3600.0, "ne107": "function_check",
    },
    "limit": {
        "source": "outlook", "off_delay_s": 86400.0,
        "priority": "medium", "response_time_s": 604800.0, "ne107": "maintenance_required",
    },
    "connection": {
        "source": "connection", "on_delay_s": 10.0, "off_delay_s": 60.0,
        "priority": "high", "response_time_s": 900.0, "ne107": "good",
    },
    "left_out": {
        "source": "left_out",
        "priority": "high", "response_time_s": 900.0, "ne107": "good",
    },
    "backlog": {
        "source": "backlog", "on_delay_s": 10.0, "off_delay_s": 60.0,
        "priority": "medium", "response_time_s": 3600.0, "ne107": "good",
    },
    "buffering": {
        "source": "buffered", "limit": 0.5, "hysteresis": 0.4, "on_delay_s": 10.0, "off_delay_s": 60.0,
        "priority": "high", "response_time_s": 900.0, "ne107": "good",
    },
}  # fmt: skip
for _name, _default in DEFAULT_ALARMS.items():
    _default |= {key: render(message(f"alarm.{key}.{_name}")) for key in ("consequence", "operator_action")}


def alarm_kind(alarm: str) -> str:
    """Return under which name an alarm is defined: those of connections and the like are ``NAME.WHOSE``."""
    return alarm.partition(".")[0]


class AlarmSettings(Settings):
    """The section `[alarms]`: keys of the flood, and one table per alarm, laid over `DEFAULT_ALARMS`."""

    flood: FloodSettings = FloodSettings()  # the table `[alarms.flood]`
    definitions: dict[str, AlarmDefinition]  # by name: all other tables of the section

    @model_validator(mode="before")
    @classmethod
    def _merge_defaults(cls, data: Any) -> Any:
        """Merge the section into the defaults; each alarm is validated here, so that errors name its table."""
        if not isinstance(data, Mapping) or "definitions" in data:
            return data
        tables: dict[str, Any] = {**DEFAULT_ALARMS, **data}
        flood = {"flood": tables.pop("flood")} if "flood" in tables else {}
        return {**flood, "definitions": {name: _parse_definition(name, table) for name, table in tables.items()}}

    @model_validator(mode="after")
    def _check_suppressors(self) -> Self:
        for name, definition in self.definitions.items():
            for word in definition.suppressed_when:
                if word not in {*self.definitions, *KINDS} - {name}:
                    raise ValueError(f"{name}: suppressed_when: no other alarm or finding is called {word!r}")
        return self

    @property
    def asset_alarms(self) -> dict[str, AlarmDefinition]:
        """The alarms that each asset has, by name."""
        definitions = [
            (n, definition)
            for n, definition in self.definitions.items()
            if definition.enabled and definition.source not in SERVICE_SOURCES
        ]
        # What suppresses comes before what is suppressed, so that both happen in the same step.
        return dict(sorted(definitions, key=lambda item: bool(item[1].suppressed_when)))

    @property
    def service_alarms(self) -> dict[str, AlarmDefinition]:
        """The alarms that the service has of itself, by name; each connection has one of its own."""
        return {
            name: definition
            for name, definition in self.definitions.items()
            if definition.enabled and definition.source in SERVICE_SOURCES
        }

    def find(self, alarm: str) -> AlarmDefinition:
        """Return the definition of an alarm."""
        return self.definitions[alarm_kind(alarm)]


def _parse_definition(name: str, table: Any) -> AlarmDefinition:
    if not ALARM_NAME.fullmatch(name):
        raise ValueError(f"{name!r} is no name for an alarm: a letter, then letters, digits, _ and -")
    if not isinstance(table, Mapping):
        raise ValueError(f"{name}: {table!r} is not a table of settings")
    try:
        return AlarmDefinition.model_validate({**DEFAULT_ALARMS.get(name, {}), **table})
    except ValidationError as error:
        raise ValueError(f"{name}.{describe_error(error, AlarmDefinition)}") from None
