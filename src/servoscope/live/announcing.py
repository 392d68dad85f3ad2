"""What operators are told: alarms of all assets, thinned in a flood, and the service's own; rows for the outbox."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from typing import Any

from servoscope import actions
from servoscope.actions import ActionSettings, Outgoing, ToleranceState
from servoscope.alarms import (
    FAULT,
    AlarmSettings,
    AlarmState,
    Command,
    FloodState,
    Notice,
    Snapshot,
    State,
    Transition,
    advance,
    announce,
    pass_time,
    start,
    step,
)
from servoscope.complaints import instead
from servoscope.errors import AlarmError, StateError
from servoscope.live.examining import Told
from servoscope.live.rows import Outcome, Row, transition_row

__all__ = ["Announcer"]

VERSION = 1
UNTOLD = (State.NORMAL, State.SHELVED, State.SUPPRESSED, State.OUT_OF_SERVICE)


class Announcer:
    """Decides what goes out; its state is kept in the store like that of an asset, under the service's name.

    Parameters
    ----------
    name
        Of the service.
    alarms, settings
        The sections of the service file.
    """

    def __init__(self, name: str, alarms: AlarmSettings, settings: ActionSettings) -> None:
        self.name, self._alarms, self._settings = name, alarms, settings
        self._flood, self._rows = FloodState(), 0
        self._own: dict[str, AlarmState] = {}
        self._tolerance: dict[str, ToleranceState] = {}

    def begin(self, rows: int) -> None:
        """Begin with a new state behind so many rows."""
        self._rows = rows

    def resume(self, state: bytes) -> None:
        """Go on from what `checkpoint` made.

        Raises
        ------
        StateError
            If it is of another version, or not whole.
        """
        again = f"run --anew {self.name} begins with a new one, without floods and changes that are under way"
        digest, text = state[:32], state[32:]
        if hashlib.sha256(text).digest() != digest:
            raise StateError(f"{self.name}: its saved state is torn: restore the store from a copy, or {again}")
        plain = json.loads(text)
        if plain["version"] != VERSION:
            raise StateError(f"{self.name}: its saved state is of another version: use that one, or {again}")
        self._rows, self._flood = plain["rows"], FloodState.from_dict(plain["flood"])
        self._own = {name: AlarmState.from_dict(one) for name, one in plain["own"].items()}
        self._tolerance = {name: ToleranceState.from_dict(one) for name, one in plain["tolerance"].items()}

    def checkpoint(self) -> dict[str, Any]:
        """Return its row for the store."""
        plain = {
            "version": VERSION,
            "rows": self._rows,
            "flood": self._flood.to_dict(),
            "own": {name: one.to_dict() for name, one in self._own.items()},
            "tolerance": {name: one.to_dict() for name, one in self._tolerance.items()},
        }
        text = json.dumps(plain, allow_nan=False).encode()
        state = hashlib.sha256(text).digest() + text
        return {"asset": self.name, "sequence": self._rows, "state": state, "status": self.status}

    @property
    def status(self) -> dict[str, Any]:
        """What people are shown of the service itself."""
        flood = {"since": self._flood.since, "counted": self._flood.counted, "held": len(self._flood.held)}
        alarms = {name: {"state": one.state.value, "since": one.since} for name, one in self._own.items()}
        return {"service": True, "flood": flood, "alarms": alarms}

    def tell(self, transitions: Iterable[Transition], details: Mapping[str, Any], now: float) -> list[Row]:
        """Take transitions of an asset, in the order of time; return rows for outbox and audit."""
        rows: list[Row] = []
        for one in transitions:
            priority = self._alarms.definitions[one.alarm].priority
            self._flood, notices = announce(self._alarms.flood, self._flood, one, priority)
            rows += self._sent(notices, details, now)
        return rows

    def pass_time(self, t: float, now: float) -> list[Row]:
        """Let time pass by the clock of the samples: a flood may end."""
        self._flood, notices = pass_time(self._alarms.flood, self._flood, t)
        return self._sent(notices, {}, now)

    def _sent(self, notices: Iterable[Notice], details: Mapping[str, Any], now: float) -> list[Row]:
        rows: list[Row] = []
        for notice in notices:
            if notice.transition is None or notice.priority is None:  # of a flood
                words = {"t": notice.time, "counted": notice.counted, "peak": notice.peak}
                rows.append(Row("audit", {"who": "servoscope", "what": notice.kind, "document": words}))
                rows += map(self._posted, actions.outgoing_flood(self._settings, notice, now))
                continue
            one = notice.transition
            found = actions.outgoing(self._settings, one, notice.priority, now, {**self._advice(one.alarm), **details})
            rows += map(self._posted, found)
        return rows

    def _advice(self, alarm: str) -> dict[str, Any]:
        definition = self._alarms.definitions[alarm]
        return {
            "consequence": definition.consequence,
            "operator_action": definition.operator_action,
            "response_time_s": definition.response_time_s,
        }

    def diagnosed(self, alarms: Mapping[str, AlarmState], told: Told, t: float, now: float) -> list[Row]:
        """Take a full diagnosis that is news, and the alarms of its asset; return rows for the outbox.

        Nobody is told of it whom the alarm itself was kept from: put away, or held back in a flood.
        """
        alarm = alarms.get(FAULT)
        if alarm is None or alarm.state in UNTOLD or any(one.whose == (alarm.asset, FAULT) for one in self._flood.held):
            return []
        faults = told.document.get("faults", [])
        words = {"verdict": told.verdict, "diagnosis": told.summary, "onset": told.onset, "faults": faults}
        priority, details = self._alarms.definitions[FAULT].priority, {**self._advice(FAULT), **words}
        found = actions.outgoing_diagnosis(self._settings, alarm, priority, t, now, told.summary, details)
        return [self._posted(one) for one in found]

    def watch(self, buffered: float, now: float) -> Outcome:
        """Take how full the buffer is, as a share, and let the service's own alarms follow."""
        definitions = self._alarms.of_service
        known = {name: self._own.get(name) or start(self.name, name, now) for name in definitions}
        seen = Snapshot(buffered=buffered, cause=f"{buffered:.0%} of the buffer waits for the store")
        self._own, transitions = advance(definitions, known, seen, now)
        return self._outcome(list(transitions))

    def obey(self, alarm: str, command: Command, now: float) -> Outcome:
        """Carry out a command on one of the service's own alarms.

        Raises
        ------
        AlarmError
            If there is no such alarm, or the command has no meaning in its state.
        """
        if alarm not in self._own:
            raise AlarmError(f"{self.name}: has no alarm {alarm!r}, {instead(alarm, self._own)}")
        self._own[alarm], transitions = step(self._alarms.definitions[alarm], self._own[alarm], command, now)
        return self._outcome(list(transitions))

    def _outcome(self, transitions: list[Transition]) -> Outcome:
        return Outcome([self._row(one) for one in transitions], transitions)

    def _row(self, one: Transition) -> Row:
        self._rows += 1
        return Row("transitions", {"number": self._rows, **transition_row(one, self._alarms.definitions[one.alarm])})

    def respond(self, asset: str, told: Told | None, t: float, now: float) -> list[Row]:
        """Take a full diagnosis of an asset, or None when its fault is over; return what is changed about it."""
        rows: list[Row] = []
        faults = (told.document or {}).get("faults", []) if told is not None else []
        for name, settings in self._settings.tolerance.items():
            if asset not in settings.assets or (told is not None and len(faults) != 1):
                continue
            ratio = faults[0]["ratio"] if faults and faults[0]["name"] == settings.fault else None
            key = f"{name}@{asset}"
            state = self._tolerance.get(key) or actions.begin(settings)
            self._tolerance[key], change, out = actions.respond(name, settings, state, asset, ratio, t, now)
            if change is not None:
                what = "change executed" if change.executed else "change recommended"
                rows.append(Row("audit", {"who": "servoscope", "what": what, "document": change.to_dict()}))
            rows += [self._posted(out)] if out is not None else []
        return rows

    def _posted(self, one: Outgoing) -> Row:
        """Return the row of the outbox for something that goes out; services on one store must not mix theirs up."""
        key = actions.key_of(self.name, one.key)
        event = {**one.event, "key": key, "service": self.name}
        return Row("outbox", {**one.to_dict(), "key": key, "event": event, "outcome": ""})
