"""What operators are notified of: alarms of all assets, fewer in a flood, and the service's own; as outbox rows."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from servoscope.core.errors import AlarmError, StateError
from servoscope.core.messages import message, render
from servoscope.core.settings_errors import suggest_name
from servoscope.service import actions
from servoscope.service.actions import ActionSettings, FaultToleranceState, OutboxEntry
from servoscope.service.actions.outbox import QUIET_STATES
from servoscope.service.alarms import (
    FAULT_ALARM,
    TROUBLE_SOURCES,
    AlarmSettings,
    AlarmSource,
    AlarmState,
    AlarmTransition,
    AssetSnapshot,
    FloodState,
    Notification,
    OperatorCommand,
    advance_flood,
    alarm_kind,
    initial_alarm_state,
    notify_transition,
    step_alarm,
)
from servoscope.service.asset_link import page_address
from servoscope.service.assets.examination import StoredDiagnosis
from servoscope.service.assets.records import StepResult, TableRow, audit_row, transition_row

VERSION = 1


class Notifier:
    """Decides what is sent to whom; its state is kept in the store like that of an asset, under the service's name."""

    def __init__(self, name: str, alarms: AlarmSettings, settings: ActionSettings) -> None:
        self.name, self._alarms, self._settings = name, alarms, settings
        self._flood, self._rows = FloodState(), 0
        self._service_alarms: dict[str, AlarmState] = {}
        self._tolerance: dict[str, FaultToleranceState] = {}

    def begin(self, rows: int) -> None:
        """Begin with a new state, behind so many rows."""
        self._rows = rows

    def resume(self, state: bytes) -> None:
        """Continue from what `checkpoint` made; raises StateError if it is of another version, or not whole."""
        hint = f"run --anew {self.name} begins with a new one, without floods and changes that are under way"
        digest, text = state[:32], state[32:]
        if hashlib.sha256(text).digest() != digest:
            raise StateError(f"{self.name}: its saved state is torn: restore the store from a copy, or {hint}")
        plain = json.loads(text)
        if plain["version"] != VERSION:
            raise StateError(f"{self.name}: its saved state is of another version: use that one, or {hint}")
        self._rows, self._flood = plain["rows"], FloodState.from_dict(plain["flood"])
        self._service_alarms = {name: AlarmState.from_dict(alarm) for name, alarm in plain["own"].items()}
        self._tolerance = {name: FaultToleranceState.from_dict(state) for name, state in plain["tolerance"].items()}

    def checkpoint(self) -> dict[str, Any]:
        """Return its row for the store."""
        plain = {
            "version": VERSION,
            "rows": self._rows,
            "flood": self._flood.to_dict(),
            "own": {name: service_alarm.to_dict() for name, service_alarm in self._service_alarms.items()},
            "tolerance": {
                name: fault_tolerance_state.to_dict() for name, fault_tolerance_state in self._tolerance.items()
            },
        }
        text = json.dumps(plain, allow_nan=False).encode()
        state = hashlib.sha256(text).digest() + text
        return {"asset": self.name, "sequence": self._rows, "state": state, "status": self.status}

    @property
    def status(self) -> dict[str, Any]:
        """What people are shown of the service itself."""
        flood = {"since": self._flood.since, "counted": self._flood.counted, "held": len(self._flood.held)}
        definitions = self._alarms.definitions  # a service file may have lost one of which a state is left
        alarms = {
            name: {
                "state": service_alarm.state.value,
                "since": service_alarm.since,
                "priority": definitions[kind].priority if (kind := alarm_kind(name)) in definitions else None,
                "cause": service_alarm.cause,
                "until": service_alarm.shelved_until,
            }
            for name, service_alarm in self._service_alarms.items()
        }
        return {"service": True, "flood": flood, "alarms": alarms}

    def notify(self, transitions: Iterable[AlarmTransition], details: Mapping[str, Any], now: float) -> list[TableRow]:
        """Take transitions of an asset, in the order of time; return rows for outbox and audit."""
        rows: list[TableRow] = []
        for transition in transitions:
            priority = self._alarms.find(transition.alarm).priority
            self._flood, notices = notify_transition(self._alarms.flood, self._flood, transition, priority)
            rows += self._notification_rows(notices, details, now)
        return rows

    def advance_time(self, t: float, now: float) -> list[TableRow]:
        """Advance the clock of the samples: a flood may end."""
        self._flood, notices = advance_flood(self._alarms.flood, self._flood, t)
        return self._notification_rows(notices, {}, now)

    def _notification_rows(
        self, notices: Iterable[Notification], details: Mapping[str, Any], now: float
    ) -> list[TableRow]:
        rows: list[TableRow] = []
        for notice in notices:
            if notice.transition is None or notice.priority is None:  # of a flood
                document = {"t": notice.time, "counted": notice.counted, "peak": notice.peak}
                rows.append(audit_row(notice.kind, document))
                entries = actions.flood_entries(self._settings, notice, now)
            else:
                transition = notice.transition
                sent = {**self._advice(transition.alarm), **details}
                entries = actions.transition_entries(self._settings, transition, notice.priority, now, sent)
            rows += map(self._outbox_row, entries)
        return rows

    def _advice(self, alarm: str) -> dict[str, Any]:
        return self._alarms.find(alarm).model_dump(include={"consequence", "operator_action", "response_time_s"})

    def notify_diagnosis(
        self, alarms: Mapping[str, AlarmState], diagnosis: StoredDiagnosis, t: float, now: float
    ) -> list[TableRow]:
        """Take a full diagnosis that is news, and the alarms of its asset; return rows for the outbox.

        There are none if operators were not notified of the alarm itself: it is shelved, or held in a flood.
        """
        alarm = alarms.get(FAULT_ALARM)
        if alarm is None or alarm.state in QUIET_STATES:
            return []
        held = ((held_alarm.transition.asset, held_alarm.transition.alarm) for held_alarm in self._flood.held)
        if (alarm.asset, FAULT_ALARM) in held:
            return []
        outcome = {"verdict": diagnosis.verdict, "diagnosis": diagnosis.summary, "onset": diagnosis.onset}
        details = {**self._advice(FAULT_ALARM), **outcome, "faults": diagnosis.document.get("faults", [])}
        details["checks"] = diagnosis.document.get("checks", [])
        priority = self._alarms.definitions[FAULT_ALARM].priority
        sent = actions.diagnosis_entries(self._settings, alarm, priority, t, now, diagnosis.summary, details)
        return [self._outbox_row(outbox_entry) for outbox_entry in sent]

    def check_service(
        self, fill_ratio: float, troubles: Mapping[AlarmSource, Mapping[str, str]], now: float
    ) -> StepResult:
        """Take how full the buffer is, and what is wrong, by its kind and name; advance the service's own alarms.

        An asset that is not left out any more has no trouble: its alarm clears.
        """
        definitions, transitions = self._alarms.service_alarms, list[AlarmTransition]()
        before, self._service_alarms = self._service_alarms, {}
        for name, definition in definitions.items():
            if definition.source in TROUBLE_SOURCES:
                words = {f"{name}.{whose}": why for whose, why in troubles.get(definition.source, {}).items()}
                if definition.source == "left_out":
                    over = [key for key, alarm in before.items() if alarm_kind(key) == name and alarm.state != "normal"]
                    words = dict.fromkeys(over, "") | words
                snapshots = {key: AssetSnapshot(trouble=why) for key, why in words.items()}
            else:
                cause = render(message("alarm.cause_buffer", share=fill_ratio))
                snapshots = {name: AssetSnapshot(buffered=fill_ratio, cause=cause)}
            for key, snapshot in snapshots.items():
                alarm = before.get(key) or initial_alarm_state(self.name, key, now)
                self._service_alarms[key], further = step_alarm(definition, alarm, snapshot, now)
                transitions += further
        return self._step_result(transitions)

    def execute(self, alarm: str, command: OperatorCommand, now: float) -> StepResult:
        """Execute a command on one of the service's own alarms.

        Raises AlarmError if there is no such alarm, or the command has no meaning in its state.
        """
        own = self._service_alarms
        if alarm not in own:
            raise AlarmError(f"{self.name}: has no alarm {alarm!r}, {suggest_name(alarm, own)}")
        own[alarm], transitions = step_alarm(self._alarms.find(alarm), own[alarm], command, now)
        return self._step_result(transitions)

    def _step_result(self, transitions: Sequence[AlarmTransition]) -> StepResult:
        rows = []
        for number, transition in enumerate(transitions, self._rows + 1):
            row = transition_row(transition, self._alarms.find(transition.alarm))
            rows.append(TableRow("transitions", {"number": number, **row}))
        self._rows += len(rows)
        return StepResult(rows, list(transitions))

    def try_sink(self, sink: str, who: str, now: float) -> list[TableRow]:
        """Return the rows with which somebody tries a sink; raises AlarmError where it may not be tried."""
        if sink not in self._settings.sinks or sink in self._settings.executing:
            raise AlarmError(f"{sink!r} cannot be tried: it is not in [actions], or changes a machine")
        return [self._outbox_row(actions.trial_entry(sink, self.name, who, now))]

    def accommodate_fault(self, asset: str, diagnosis: StoredDiagnosis | None, t: float, now: float) -> list[TableRow]:
        """Take a full diagnosis of an asset, or None when its fault is over; return rows about changes for it."""
        rows: list[TableRow] = []
        faults = (diagnosis.document or {}).get("faults", []) if diagnosis is not None else []
        for name, settings in self._settings.tolerance.items():
            if asset not in settings.assets or (diagnosis is not None and len(faults) != 1):
                continue
            ratio = faults[0]["ratio"] if faults and faults[0]["name"] == settings.fault else None
            key = f"{name}@{asset}"
            state = self._tolerance.get(key) or FaultToleranceState(settings.nominal)
            self._tolerance[key], change, entry = actions.accommodate_fault(name, settings, state, asset, ratio, t, now)
            if change is not None:
                rows.append(audit_row("change executed" if change.executed else "change recommended", change.to_dict()))
            if entry is not None:
                rows.append(self._outbox_row(entry))
        return rows

    def _outbox_row(self, entry: OutboxEntry) -> TableRow:
        """Return the row of an entry; the keys of two services on one store must differ."""
        key = actions.idempotency_key(self.name, entry.key)
        event = {**entry.event, "key": key, "service": self.name}
        sink, asset = self._settings.sinks.get(entry.sink), event.get("asset")
        if sink is not None and sink.address is not None:  # alarms of the service itself have no page of their own
            event["link"] = page_address(sink.address, asset if asset != self.name else None)
        return TableRow("outbox", {**entry.to_dict(), "key": key, "event": event, "outcome": ""})
