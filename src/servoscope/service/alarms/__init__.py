"""Alarms after ISA-18.2 / IEC 62682: life-cycle, floods, and the status after NAMUR NE 107; pure, no clock of its own.

settings = AlarmSettings.model_validate(section)
alarms = settings.asset_alarms
states = {name: initial_alarm_state(asset, name, now) for name in alarms}
states, transitions = advance_alarms(alarms, states, AssetSnapshot(verdict="fault", cause="..."), now)
states["fault"], transitions = step_alarm(alarms["fault"], states["fault"], OperatorCommand(...), now)
flood, notices = notify_transition(settings.flood, flood, transition, settings.definitions[transition.alarm].priority)
"""

from servoscope.service.alarms.conditions import AssetSnapshot, Condition, evaluate_condition
from servoscope.service.alarms.flood import FloodState, HeldAlarm, Notification, advance_flood, notify_transition
from servoscope.service.alarms.lifecycle import (
    AlarmStandstill,
    Ne107Status,
    advance_alarms,
    evaluate_ne107,
    initial_alarm_state,
    next_event_time,
    step_alarm,
)
from servoscope.service.alarms.records import (
    COMMANDS,
    TRANSITION_TABLE,
    AlarmState,
    AlarmTransition,
    LifecycleEvent,
    LifecycleState,
    OperatorCommand,
)
from servoscope.service.alarms.settings import (
    DEFAULT_ALARMS,
    FAULT_ALARM,
    PRIORITIES,
    TROUBLE_SOURCES,
    AlarmDefinition,
    AlarmSettings,
    AlarmSource,
    FloodSettings,
    Ne107,
    Priority,
    alarm_kind,
)

__all__ = [
    "COMMANDS", "DEFAULT_ALARMS", "FAULT_ALARM", "PRIORITIES", "TRANSITION_TABLE", "TROUBLE_SOURCES",
    "AlarmDefinition", "AlarmSettings", "AlarmSource", "AlarmStandstill", "AlarmState", "AlarmTransition",
    "AssetSnapshot", "Condition", "FloodSettings", "FloodState", "HeldAlarm", "LifecycleEvent", "LifecycleState",
    "Ne107", "Ne107Status", "Notification", "OperatorCommand", "Priority", "advance_alarms", "advance_flood",
    "alarm_kind", "evaluate_condition", "evaluate_ne107", "initial_alarm_state", "next_event_time",
    "notify_transition", "step_alarm",
]  # fmt: skip
