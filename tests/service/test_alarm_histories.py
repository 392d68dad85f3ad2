"""Random histories of alarms: what holds in all of them, and slow, obvious counterparts of delays and floods."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace

import hypothesis.strategies as st
import pytest
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from servoscope.core.errors import AlarmError
from servoscope.service.alarms import (
    COMMANDS,
    PRIORITIES,
    AlarmDefinition,
    AlarmState,
    AlarmTransition,
    AssetSnapshot,
    FloodSettings,
    FloodState,
    LifecycleEvent,
    LifecycleState,
    OperatorCommand,
    Priority,
    advance_flood,
    initial_alarm_state,
    notify_transition,
    step_alarm,
)
from servoscope.service.alarms.records import UNACKNOWLEDGED_STATES

PUT_AWAY = (LifecycleState.SHELVED, LifecycleState.SUPPRESSED, LifecycleState.OUT_OF_SERVICE)
VERDICTS = st.sampled_from(["healthy", "fault", "undetermined"])
SECONDS = st.integers(0, 12).map(float)


class AlarmLife(RuleBasedStateMachine):
    """One alarm, and a twin of it that is never told of time alone."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 1000.0
        self.definition = AlarmDefinition(source="verdict", on_delay_s=5.0, off_delay_s=7.0, suppressed_when=("clock",))
        self.alarm = self.twin = initial_alarm_state("a", "fault", self.now)
        self.told: list[AlarmTransition] = []
        self.twins: list[AlarmTransition] = []
        self.seen: list[tuple[float, str]] = []

    @precondition(lambda self: not self.told)
    @rule()
    def latch(self) -> None:
        self.definition = self.definition.model_copy(update={"latching": True})

    @rule(verdict=VERDICTS, suppressed=st.booleans(), later=SECONDS)
    def observe(self, verdict: str, suppressed: bool, later: float) -> None:
        self.now += later
        seen = AssetSnapshot(verdict, ("clock",) if suppressed else ())
        self.seen.append((self.now, verdict))
        self._do(seen)

    @rule(event=st.sampled_from(COMMANDS), later=SECONDS, hold=st.integers(1, 30))
    def command(self, event: LifecycleEvent, later: float, hold: int) -> None:
        self.now += later
        self._do(OperatorCommand(event, "ann", until=self.now + hold if event is LifecycleEvent.SHELVE else None))

    @rule(later=SECONDS)
    def pass_time(self, later: float) -> None:
        self.now += later
        self.alarm, transitions = step_alarm(self.definition, self.alarm, None, self.now)
        self.told += transitions

    @rule()
    def save_and_load(self) -> None:
        self.alarm = AlarmState.from_dict(json.loads(json.dumps(self.alarm.to_dict())))

    def _do(self, given: AssetSnapshot | OperatorCommand) -> None:
        try:
            self.alarm, transitions = step_alarm(self.definition, self.alarm, given, self.now)
        except AlarmError:
            with pytest.raises(AlarmError):
                step_alarm(self.definition, self.twin, given, self.now)
            return
        self.twin, twins = step_alarm(self.definition, self.twin, given, self.now)
        self.told += transitions
        self.twins += twins
        assert (self.alarm, self.told) == (self.twin, self.twins)

    @invariant()
    def state_and_flags_agree(self) -> None:
        one = self.alarm
        if one.state not in PUT_AWAY:
            assert one.active == (one.state in (LifecycleState.UNACKNOWLEDGED, LifecycleState.ACKNOWLEDGED))
            assert not one.suppressed
        assert one.state is not LifecycleState.SUPPRESSED or one.suppressed
        assert (one.shelved_until is not None) == (one.state is LifecycleState.SHELVED)
        assert one.shelved_until is None or one.shelved_until > one.at
        assert (
            one.state not in (LifecycleState.LATCHED_UNACKNOWLEDGED, LifecycleState.LATCHED_ACKNOWLEDGED) or one.latched
        )
        assert not (one.state is LifecycleState.NORMAL and one.latched)

    @invariant()
    def history_is_a_chain(self) -> None:
        assert [one.sequence for one in self.told] == list(range(1, self.alarm.sequence + 1))
        states = [LifecycleState.NORMAL, *(one.after for one in self.told)]
        assert [one.before for one in self.told] == states[:-1]
        assert self.alarm.state is states[-1]
        times = [one.time for one in self.told]
        assert times == sorted(times)
        assert all(time <= self.now for time in times)

    @invariant()
    def nothing_that_waits_for_an_operator_goes_by_itself(self) -> None:
        for one in self.told:
            if one.before in UNACKNOWLEDGED_STATES and one.after not in (*UNACKNOWLEDGED_STATES, *PUT_AWAY):
                assert (one.event, one.who) == (LifecycleEvent.ACKNOWLEDGE, "ann")
            if one.before is LifecycleState.LATCHED_ACKNOWLEDGED and one.after is LifecycleState.NORMAL:
                assert (one.event, one.who) == (LifecycleEvent.RESET, "ann")

    @invariant()
    def the_condition_behind_the_delays_is_what_a_slow_version_says(self) -> None:
        active, since, last = False, 0.0, ""
        for (time, verdict), (until, _) in itertools.pairwise([*self.seen, (self.alarm.at, "")]):
            since, last = (since, last) if verdict == last else (time, verdict)
            delay = {"fault": self.definition.on_delay_s, "healthy": self.definition.off_delay_s}
            if verdict in delay and since + delay[verdict] <= until:
                active = verdict == "fault"
        assert self.alarm.active == active


AlarmLife.TestCase.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)
TestAlarmLife = AlarmLife.TestCase


class Flood(RuleBasedStateMachine):
    """Alarms of a fleet: each new one is told at once, or held and told later, or answered before: none is lost."""

    def __init__(self) -> None:
        super().__init__()
        self.settings = FloodSettings(limit=4, period_s=20.0, ends_below=3, announced_from="high")
        self.flood = FloodState()
        self.now = 0.0
        self.sequence = 0
        self.new: list[float] = []
        self.slow = False
        self.told = self.told_late = self.answered = 0

    @rule(which=st.integers(0, 5), later=st.integers(0, 6))
    def occur(self, which: int, later: int) -> None:
        self.now += later
        self._take(
            which, LifecycleState.NORMAL, LifecycleState.UNACKNOWLEDGED, LifecycleEvent.OCCUR, PRIORITIES[which % 4]
        )
        self._slowly()
        self.new.append(self.now)
        self.slow = self.slow or self._recent() > self.settings.limit

    @rule(which=st.integers(0, 5))
    def acknowledge(self, which: int) -> None:
        self._take(
            which,
            LifecycleState.UNACKNOWLEDGED,
            LifecycleState.ACKNOWLEDGED,
            LifecycleEvent.ACKNOWLEDGE,
            PRIORITIES[which % 4],
        )

    @rule(which=st.integers(0, 5))
    def clear(self, which: int) -> None:
        self._take(
            which, LifecycleState.UNACKNOWLEDGED, LifecycleState.RETURNED, LifecycleEvent.CLEAR, PRIORITIES[which % 4]
        )

    @rule(later=st.integers(0, 25))
    def wait(self, later: int) -> None:
        self.now += later
        self.flood, notices = advance_flood(self.settings, self.flood, self.now)
        self.told_late += sum(one.counted for one in notices if one.kind == "held")
        self._slowly()

    @rule()
    def save_and_load(self) -> None:
        self.flood = FloodState.from_dict(json.loads(json.dumps(self.flood.to_dict())))

    def _take(
        self, which: int, before: LifecycleState, after: LifecycleState, event: LifecycleEvent, priority: Priority
    ) -> None:
        self.sequence += 1
        one = AlarmTransition(self.now, f"asset {which}", "fault", self.sequence, before, after, event, "", "system")
        held = {h.transition.asset: h.count for h in self.flood.held}
        self.flood, notices = notify_transition(self.settings, self.flood, one, priority)
        late = sum(n.counted for n in notices if n.kind == "held")
        self.told_late += late
        self.told += sum(n.kind == "alarm" for n in notices)
        if not late and one.asset in held and one.asset not in {h.transition.asset for h in self.flood.held}:
            self.answered += held[one.asset]
        if PRIORITIES.index(priority) >= PRIORITIES.index("high"):
            assert any(n.transition is one for n in notices)

        self._slowly()

    def _slowly(self) -> None:
        self.slow = self.slow and self._recent() >= self.settings.ends_below

    def _recent(self) -> int:
        return sum(self.now - self.settings.period_s < one for one in self.new)

    @invariant()
    def none_is_lost(self) -> None:
        held = sum(one.count for one in self.flood.held)
        assert len(self.new) == self.told + self.told_late + self.answered + held

    @invariant()
    def it_is_a_flood_when_a_slow_version_says_so(self) -> None:
        assert (self.flood.since is not None) == self.slow
        assert self.slow or not self.flood.held


Flood.TestCase.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)
TestFlood = Flood.TestCase


def test_a_flood_holds_low_priorities_and_tells_them_at_its_end() -> None:
    flood, kinds = FloodState(), []
    for k in range(14):
        one = AlarmTransition(
            float(k),
            f"asset {k}",
            "fault",
            1,
            LifecycleState.NORMAL,
            LifecycleState.UNACKNOWLEDGED,
            LifecycleEvent.OCCUR,
            "",
            "system",
        )
        flood, notices = notify_transition(FloodSettings(), flood, one, "critical" if k == 12 else "low")
        kinds += [notice.kind for notice in notices]
    assert kinds == ["alarm"] * 10 + ["flood_begins", "alarm"]
    gone = replace(
        one, time=20.0, sequence=2, before=one.after, after=LifecycleState.RETURNED, event=LifecycleEvent.CLEAR
    )
    flood, notices = notify_transition(FloodSettings(), flood, gone, "low")
    assert notices == ()
    flood, notices = advance_flood(FloodSettings(), flood, 608.5)
    assert notices == ()
    flood, notices = advance_flood(FloodSettings(), flood, 609.0)
    assert [(n.kind, n.counted, n.peak) for n in notices] == [("flood_ends", 14, 14), *[("held", 1, 0)] * 3]
    assert [n.transition.asset for n in notices if n.transition] == ["asset 10", "asset 11", "asset 13"]
    assert notices[-1].transition == gone
    assert flood == FloodState(recent=(10.0, 11.0, 12.0, 13.0))


def test_a_flood_is_counted_whatever_the_order_that_assets_tell_it_in() -> None:
    flood, kinds = FloodState(), []
    for k in (9, 3, 8, 0, 1, 7, 2, 6, 5, 4, 10):
        states = LifecycleState.NORMAL, LifecycleState.UNACKNOWLEDGED
        one = AlarmTransition(50.0 * k, f"asset {k}", "fault", 1, *states, LifecycleEvent.OCCUR, "", "system")
        flood, notices = notify_transition(FloodSettings(), flood, one, "low")
        kinds += [notice.kind for notice in notices]
    assert kinds == ["alarm"] * 10 + ["flood_begins"]
