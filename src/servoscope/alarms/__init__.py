"""Alarms after ISA-18.2 / IEC 62682: life-cycle, floods, and the status after NAMUR NE 107; pure, no clock of its own.

settings = AlarmSettings.model_validate(section)
states = {name: start(asset, name, now) for name in settings.of_asset}
states, transitions = advance(settings.of_asset, states, Snapshot(verdict="fault", cause="..."), now)
states["fault"], transitions = step(settings.of_asset["fault"], states["fault"], Command(...), now)
flood, notices = announce(settings.flood, flood, transition, settings.definitions[transition.alarm].priority)
"""

from servoscope.alarms.conditions import Condition, Snapshot, condition
from servoscope.alarms.definitions import (
    DEFAULTS,
    FAULT,
    PRIORITIES,
    AlarmDefinition,
    AlarmSettings,
    FloodSettings,
    Ne107,
    Priority,
)
from servoscope.alarms.flood import FloodState, Held, Notice, announce, pass_time
from servoscope.alarms.life import advance, start, step
from servoscope.alarms.records import AlarmState, Command, Transition
from servoscope.alarms.states import COMMANDS, TABLE, Event, State
from servoscope.alarms.status import Status, status

__all__ = [
    "COMMANDS",
    "DEFAULTS",
    "FAULT",
    "PRIORITIES",
    "TABLE",
    "AlarmDefinition",
    "AlarmSettings",
    "AlarmState",
    "Command",
    "Condition",
    "Event",
    "FloodSettings",
    "FloodState",
    "Held",
    "Ne107",
    "Notice",
    "Priority",
    "Snapshot",
    "State",
    "Status",
    "Transition",
    "advance",
    "announce",
    "condition",
    "pass_time",
    "start",
    "status",
    "step",
]
