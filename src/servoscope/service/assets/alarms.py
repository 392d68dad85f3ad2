"""The alarms of one asset, advanced by what its state says; nearly always nothing changes, and nothing is computed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from servoscope.core.errors import AlarmError
from servoscope.core.settings_errors import suggest_name
from servoscope.service.alarms import (
    AlarmSettings,
    AlarmStandstill,
    AlarmState,
    AlarmTransition,
    LifecycleState,
    OperatorCommand,
    advance_alarms,
    initial_alarm_state,
    next_event_time,
    step_alarm,
)
from servoscope.service.assets.checkpoint import AssetState, evolve
from servoscope.service.assets.examination_schedule import Announcement, ExaminationState
from servoscope.service.assets.outlook import OutlookWord, current_outlook
from servoscope.service.assets.reception import Reception
from servoscope.service.assets.status import asset_snapshot
from servoscope.signals import quality


class _AlarmInputs(NamedTuple):
    examination: ExaminationState
    findings: tuple[str, ...]
    reception: Reception
    outlook: OutlookWord
    announced: Announcement | None


class AssetAlarms:
    """Advances the alarms of an asset; `limited`: whether it has limits; `ahead_s`: how far a prognosis warns [s]."""

    def __init__(self, settings: AlarmSettings, ahead_s: float, *, limited: bool) -> None:
        alarms = settings.asset_alarms.items()
        self.definitions = {key: definition for key, definition in alarms if limited or definition.source != "outlook"}
        self.assesses = any(definition.source == "control" for definition in self.definitions.values())
        self._ahead_s = ahead_s
        self.announced: Announcement | None = None
        self._settled: AlarmStandstill | None = None
        self._by_numbers = any(definition.source in ("statistic", "level") for definition in self.definitions.values())

    def begin(self, asset: str, t: float, before: Mapping[str, AlarmState]) -> dict[str, AlarmState]:
        """Return the states at `t` [UTC s] of alarms that go on as `before`, or of which nothing is known."""
        self._settled = None
        return {name: before.get(name) or initial_alarm_state(asset, name, t) for name in self.definitions}

    def advance(
        self, state: AssetState, reception: Reception, t: float
    ) -> tuple[AssetState, tuple[AlarmTransition, ...]]:
        """Return the state with its alarms at time `t` [UTC s], and their transitions."""
        known = self._known(state, reception, t)
        since, until = self._standstill(state, known)
        if since <= t < until:
            return evolve(state, alarms_at=t), ()
        snapshot = asset_snapshot(state, known.findings, reception, known.outlook, known.announced)
        alarms, transitions = advance_alarms(self.definitions, state.alarms_now, snapshot, t)
        # after transitions a second step may do more, because alarms suppress each other
        still = not transitions and not self._by_numbers
        self._settled = AlarmStandstill(known, t, next_event_time(self.definitions, alarms)) if still else None
        return evolve(state, alarms=alarms, alarms_at=None), transitions

    def standing(self, alarms: Mapping[str, AlarmState]) -> list[tuple[str, str, str]]:
        """Return name, priority and state of each of these alarms that is not normal."""
        return [
            (name, self.definitions[name].priority, alarm.state.value)
            for name, alarm in alarms.items()
            if alarm.state is not LifecycleState.NORMAL
        ]

    def execute(
        self, state: AssetState, alarm: str, command: OperatorCommand
    ) -> tuple[AssetState, tuple[AlarmTransition, ...]]:
        """Return the state after an operator's command.

        Raises AlarmError if there is no such alarm, or the command has no meaning in its state.
        """
        if alarm not in self.definitions:
            raise AlarmError(f"{state.asset}: has no alarm {alarm!r}, {suggest_name(alarm, self.definitions)}")
        alarms, self._settled = state.alarms_now, None
        t = max(alarms[alarm].at, state.position.t)
        after, transitions = step_alarm(self.definitions[alarm], alarms[alarm], command, t)
        return evolve(state, alarms={**alarms, alarm: after}, alarms_at=None), transitions

    def standstill(self, state: AssetState, reception: Reception) -> tuple[float, float]:
        """Return from when and until when [UTC s] they stay as they are, if no more becomes known than in `state`."""
        if state.outlook is not None:  # how near its limit is changes with time
            return math.inf, -math.inf
        return self._standstill(state, self._known(state, reception, state.position.t))

    def _standstill(self, state: AssetState, known: _AlarmInputs) -> tuple[float, float]:
        settled = self._settled
        if settled is None or settled.known != known:
            return math.inf, -math.inf
        return settled.at if state.alarms_at is None else state.alarms_at, settled.until

    def _known(self, state: AssetState, reception: Reception, t: float) -> _AlarmInputs:
        outlook = current_outlook(state.outlook, state.examination.faults)  # of one that has gone nothing is left
        word = "far" if outlook is None else outlook.word(t, self._ahead_s)
        findings = tuple(quality.active_findings(state.quality))
        return _AlarmInputs(state.examination, findings, reception, word, self.announced)
