"""The alarm life-cycle against its full transition list, and what each setting of an alarm does."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import ValidationError

from servoscope.core.errors import AlarmError, StateError
from servoscope.service.alarms import (
    COMMANDS,
    AlarmDefinition,
    AlarmSettings,
    AlarmState,
    AlarmTransition,
    AssetSnapshot,
    LifecycleEvent,
    LifecycleState,
    OperatorCommand,
    advance_alarms,
    evaluate_ne107,
    initial_alarm_state,
    step_alarm,
)
from servoscope.service.alarms.records import ReleaseCondition, next_state

# The transition list, written down independently of the table: letters as in ISA-18.2, figure "Alarm state transition
# diagram"; a dot where an event has no meaning; * is a release, which depends on what is found.
LIST = """
                              A B C D E F G H I
    occur                     B . . B B B G H I
    clear                     . D A . . . G H I
    clear_latched             . E F . . . G H I
    suppress                  H H H H H H G . I
    unsuppress                . . . . . . G * I
    expire                    . . . . . . * . .
    acknowledge               . C . A F . . . .
    reset                     . . . . . A . . .
    shelve                    G G G G G G G G .
    unshelve                  . . . . . . * . .
    remove_from_service       I I I I I I I I .
    return_to_service         . . . . . . . . *
"""
RELEASED = {"suppressed": "H", "abnormal": "B", "latched": "E", "normal": "A"}
LETTER = dict(zip("ABCDEFGHI", LifecycleState, strict=True))


def transition_list() -> dict[tuple[LifecycleState, LifecycleEvent, str], LifecycleState | None]:
    header, *rows = [line.split() for line in LIST.strip().splitlines()]
    return {
        (LETTER[letter], LifecycleEvent(name), found): LETTER.get(RELEASED[found] if to == "*" else to)
        for name, *cells in rows
        for letter, to in zip(header, cells, strict=True)
        for found in RELEASED
    }


def test_the_table_is_the_transition_list() -> None:
    expected = transition_list()
    assert len(expected) == len(LifecycleState) * len(LifecycleEvent) * len(get_args(ReleaseCondition)) == 9 * 12 * 4
    assert {key: next_state(key[0], key[1], key[2]) for key in expected} == expected  # type: ignore[arg-type]


def test_the_page_has_the_same_table(project: Path) -> None:
    page = (project / "docs" / "alarms.md").read_text(encoding="utf-8")
    section = page.split("\n## Life-cycle\n")[1].split("\n## ")[0]
    _, *rows = [line for line in section.splitlines() if line.startswith("| ")]
    cells = [[cell.strip() or "." for cell in row.split("|")[2:-1]] for row in rows]
    assert cells == [row.split()[1:] for row in LIST.strip().splitlines()[1:]]


DAY = 86400.0
FAULT, HEALTHY, UNDETERMINED = AssetSnapshot("fault"), AssetSnapshot("healthy"), AssetSnapshot("undetermined")
SUPPRESSED = ("clock",)


def definition(**settings: Any) -> AlarmDefinition:
    return AlarmDefinition(source="verdict", **settings)


def commanded(event: LifecycleEvent, until: float | None = None) -> OperatorCommand:
    return OperatorCommand(event, "ann", "because", until)


def lived(
    one: AlarmDefinition, *steps: tuple[float, AssetSnapshot | OperatorCommand | None]
) -> tuple[AlarmState, list[AlarmTransition]]:
    state, told = initial_alarm_state("press 1", "fault", 0.0), []
    for time, given in steps:
        state, transitions = step_alarm(one, state, given, time)
        told += transitions
    return state, told


def brought_to(state: LifecycleState, one: AlarmDefinition) -> AlarmState:
    """Return an alarm in a state that it has reached by living."""
    occurred = [(1.0, FAULT)]
    steps: dict[LifecycleState, list[tuple[float, AssetSnapshot | OperatorCommand | None]]] = {
        LifecycleState.NORMAL: [(1.0, HEALTHY)],
        LifecycleState.UNACKNOWLEDGED: [*occurred],
        LifecycleState.ACKNOWLEDGED: [*occurred, (2.0, commanded(LifecycleEvent.ACKNOWLEDGE))],
        LifecycleState.RETURNED: [*occurred, (2.0, HEALTHY)],
        LifecycleState.LATCHED_UNACKNOWLEDGED: [*occurred, (2.0, HEALTHY)],
        LifecycleState.LATCHED_ACKNOWLEDGED: [*occurred, (2.0, HEALTHY), (3.0, commanded(LifecycleEvent.ACKNOWLEDGE))],
        LifecycleState.SHELVED: [*occurred, (2.0, commanded(LifecycleEvent.SHELVE, until=DAY))],
        LifecycleState.SUPPRESSED: [*occurred, (2.0, AssetSnapshot("undetermined", SUPPRESSED))],
        LifecycleState.OUT_OF_SERVICE: [*occurred, (2.0, commanded(LifecycleEvent.REMOVE))],
    }
    reached, _ = lived(one, *steps[state])
    assert reached.state is state
    return reached


@pytest.mark.parametrize("state", LifecycleState)
@pytest.mark.parametrize("event", COMMANDS)
def test_each_command_in_each_state_does_what_the_list_says_or_is_refused(
    state: LifecycleState, event: LifecycleEvent
) -> None:
    one = definition(latching="latched" in state, suppressed_when=SUPPRESSED)
    alarm = brought_to(state, one)
    found = (
        "suppressed" if alarm.suppressed else "abnormal" if alarm.active else "latched" if alarm.latched else "normal"
    )
    expected = transition_list()[state, event, found]
    command = commanded(event, until=2 * DAY if event is LifecycleEvent.SHELVE else None)
    if expected is None:
        with pytest.raises(AlarmError, match=f"press 1: fault is {state}: {event} means nothing there"):
            step_alarm(one, alarm, command, 10.0)
        return
    new, (told,) = step_alarm(one, alarm, command, 10.0)
    assert new.state is expected
    assert told == AlarmTransition(
        10.0, "press 1", "fault", alarm.sequence + 1, state, expected, event, "because", "ann"
    )
    assert new.shelved_until == (2 * DAY if event is LifecycleEvent.SHELVE else None)


def test_delays_end_at_their_own_moment_however_late_time_is_told() -> None:
    one = definition(on_delay_s=10.0, off_delay_s=20.0)
    steps = [(100.0, FAULT), (150.0, HEALTHY), (400.0, None)]
    _, told = lived(one, *steps)
    assert [(t.time, t.event) for t in told] == [(110.0, LifecycleEvent.OCCUR), (170.0, LifecycleEvent.CLEAR)]
    often = sorted([*steps, *((float(t), None) for t in range(90, 400, 3))], key=lambda one: one[0])
    assert lived(one, *often)[1] == told


def test_a_condition_shorter_than_the_delay_is_none() -> None:
    one = definition(on_delay_s=10.0, off_delay_s=20.0)
    assert lived(one, (100.0, FAULT), (109.0, HEALTHY), (400.0, None))[1] == []
    _, told = lived(one, (100.0, FAULT), (150.0, HEALTHY), (169.0, FAULT), (900.0, None))
    assert [t.event for t in told] == [LifecycleEvent.OCCUR]


def test_what_is_not_known_is_neither_an_alarm_nor_its_end() -> None:
    one = definition(on_delay_s=10.0, off_delay_s=20.0)
    assert lived(one, (100.0, FAULT), (105.0, UNDETERMINED), (900.0, None))[1] == []
    state, told = lived(one, (100.0, FAULT), (150.0, HEALTHY), (160.0, UNDETERMINED), (9e5, None))
    assert [t.event for t in told] == [LifecycleEvent.OCCUR]
    assert state.active


def test_hysteresis_is_a_second_limit_to_return() -> None:
    one = AlarmDefinition(source="statistic", limit=2.0, hysteresis=0.5)
    values = [1.9, 2.0, 1.6, None, 1.6, 1.4, 1.9, 2.1, float("nan"), 1.4]
    _, told = lived(one, *((float(k), AssetSnapshot(statistic=value)) for k, value in enumerate(values)))
    assert [(t.time, t.event) for t in told] == [
        (1.0, LifecycleEvent.OCCUR),
        (5.0, LifecycleEvent.CLEAR),
        (7.0, LifecycleEvent.OCCUR),
        (9.0, LifecycleEvent.CLEAR),
    ]


def test_shelving_expires_into_what_is_there_by_then() -> None:
    shelve = (10.0, commanded(LifecycleEvent.SHELVE, until=100.0))
    for given, expected in ((HEALTHY, LifecycleState.NORMAL), (FAULT, LifecycleState.UNACKNOWLEDGED)):
        _, told = lived(definition(), (1.0, HEALTHY), shelve, (50.0, given), (500.0, None))
        assert (told[-1].time, told[-1].event, told[-1].after) == (100.0, LifecycleEvent.EXPIRE, expected)
    with pytest.raises(AlarmError, match="shelving needs an end in the future"):
        lived(definition(), (1.0, HEALTHY), (10.0, commanded(LifecycleEvent.SHELVE, until=10.0)))


def test_what_is_due_happens_in_its_order_however_late() -> None:
    one = definition(on_delay_s=50.0)
    shelve = commanded(LifecycleEvent.SHELVE, until=100.0)
    _, told = lived(one, (1.0, HEALTHY), (10.0, shelve), (90.0, FAULT), (500.0, None))
    assert [(t.time, t.event) for t in told[1:]] == [(100.0, LifecycleEvent.EXPIRE), (140.0, LifecycleEvent.OCCUR)]


def test_settings_may_change_while_an_alarm_lives() -> None:
    state, _ = lived(definition(on_delay_s=100.0), (10.0, FAULT), (90.0, None))
    _, (told,) = step_alarm(definition(on_delay_s=5.0), state, None, 95.0)
    assert told.time == 90.0  # what was told until then is not rewritten
    latched = brought_to(LifecycleState.LATCHED_ACKNOWLEDGED, definition(latching=True))
    free, told = latched, []
    for time, given in ((10.0, FAULT), (11.0, commanded(LifecycleEvent.ACKNOWLEDGE)), (12.0, HEALTHY)):
        free, transitions = step_alarm(definition(latching=False), free, given, time)
        told += transitions
    assert (free.state, free.latched) == (LifecycleState.NORMAL, False)


def test_a_latch_survives_everything_but_its_reset() -> None:
    state = brought_to(LifecycleState.LATCHED_UNACKNOWLEDGED, definition(latching=True))
    for there, back in (
        (LifecycleEvent.SHELVE, LifecycleEvent.UNSHELVE),
        (LifecycleEvent.REMOVE, LifecycleEvent.RESTORE),
    ):
        state, _ = step_alarm(definition(latching=True), state, commanded(there, until=DAY), 10.0)
        state, _ = step_alarm(definition(latching=True), state, commanded(back), 11.0)
        assert state.state is LifecycleState.LATCHED_UNACKNOWLEDGED
    for event in (LifecycleEvent.ACKNOWLEDGE, LifecycleEvent.RESET):
        state, _ = step_alarm(definition(latching=True), state, commanded(event), 12.0)
    assert (state.state, state.latched) == (LifecycleState.NORMAL, False)


def test_what_a_shelved_alarm_does_unseen_is_in_its_history() -> None:
    shelve = (10.0, commanded(LifecycleEvent.SHELVE, until=100.0))
    _, told = lived(definition(), (1.0, HEALTHY), shelve, (20.0, FAULT), (30.0, HEALTHY))
    assert [(t.event, t.after) for t in told[1:]] == [
        (LifecycleEvent.OCCUR, LifecycleState.SHELVED),
        (LifecycleEvent.CLEAR, LifecycleState.SHELVED),
    ]


def test_one_alarm_suppresses_another_by_design() -> None:
    settings = AlarmSettings.model_validate({"undetermined": {"on_delay_s": 5}, "data_quality": {"on_delay_s": 0}})
    states = {name: initial_alarm_state("a", name, 0.0) for name in settings.asset_alarms}
    states, told = advance_alarms(settings.asset_alarms, states, AssetSnapshot("undetermined", ("gap",)), 0.0)
    assert [(t.alarm, t.after) for t in told] == [
        ("data_quality", LifecycleState.UNACKNOWLEDGED),
        ("undetermined", LifecycleState.SUPPRESSED),
    ]
    states, told = advance_alarms(settings.asset_alarms, states, None, 10.0)
    assert [(t.alarm, t.before, t.after) for t in told] == [
        ("undetermined", LifecycleState.SUPPRESSED, LifecycleState.SUPPRESSED)
    ]
    states, told = advance_alarms(settings.asset_alarms, states, AssetSnapshot("healthy"), 10.0)
    states, told = advance_alarms(settings.asset_alarms, states, AssetSnapshot("undetermined"), 80.0)
    assert (told[0].alarm, told[0].time, told[0].after) == ("data_quality", 70.0, LifecycleState.RETURNED)
    assert states["undetermined"].state is LifecycleState.NORMAL


def test_a_clock_that_is_set_back_takes_running_delays_with_it() -> None:
    one = definition(on_delay_s=10.0)
    state, told = lived(one, (1e6, FAULT), (1e6 + 4.0, FAULT), (500.0, FAULT), (505.9, None), (506.0, None))
    assert [t.time for t in told] == [506.0]
    state, _ = step_alarm(one, state, commanded(LifecycleEvent.SHELVE, until=600.0), 510.0)
    state, _ = step_alarm(one, state, None, 10.0)
    assert (state.since, state.shelved_until) == (10.0, 100.0)


def test_a_state_goes_to_json_and_back_and_another_version_is_refused() -> None:
    for state in LifecycleState:
        alarm = brought_to(state, definition(latching="latched" in state, suppressed_when=SUPPRESSED))
        plain = json.loads(json.dumps(alarm.to_dict(), allow_nan=False))
        assert AlarmState.from_dict(plain) == alarm
    with pytest.raises(StateError, match="alarm state of version 2, this servoscope reads 1"):
        AlarmState.from_dict({**plain, "version": 2})
    with pytest.raises(StateError, match="not whole"):
        AlarmState.from_dict({key: value for key, value in plain.items() if key != "latched"})
    with pytest.raises(StateError, match="'asleep' is unknown"):
        AlarmState.from_dict({**plain, "state": "asleep"})


def test_a_transition_goes_to_json_and_back() -> None:
    _, (told,) = lived(definition(), (1.5, AssetSnapshot("fault", cause="leakage")))
    assert told.is_new
    assert told.cause == "leakage"
    assert AlarmTransition.from_dict(json.loads(json.dumps(told.to_dict()))) == told


def test_alarms_need_no_configuration_and_say_what_to_do() -> None:
    settings = AlarmSettings()
    assert list(settings.asset_alarms) == ["fault", "data_quality", "reception", "limit", "undetermined"]
    assert list(settings.service_alarms) == ["connection", "left_out", "backlog", "buffering"]
    for one in settings.definitions.values():
        assert one.consequence and one.operator_action and one.response_time_s
    assert AlarmSettings.model_validate(settings.model_dump()) == settings


def test_a_table_changes_keys_of_a_default_and_another_name_adds_an_alarm() -> None:
    near = {"source": "statistic", "limit": 0.8}
    section = {"fault": {"priority": "critical"}, "undetermined": {"enabled": False}, "near": near}
    settings = AlarmSettings.model_validate(section)
    assert settings.asset_alarms["fault"] == AlarmSettings().asset_alarms["fault"].model_copy(
        update={"priority": "critical"}
    )
    assert list(settings.asset_alarms) == ["fault", "data_quality", "reception", "limit", "near"]


@pytest.mark.parametrize(
    ("section", "complaint"),
    [
        ({"fault": {"priority": "urgent"}}, "fault.priority: 'urgent' is not one of"),
        ({"fault": {"priorty": "low"}}, "fault.priorty: unknown key, did you mean 'priority'"),
        ({"near": {}}, "near.source: missing"),
        ({"fault": {"when": ["sick"]}}, "'sick' is not a word of source 'verdict': fault, undetermined"),
        ({"near": {"source": "level", "when": ["high"]}}, "source 'level' is a number, give limit instead"),
        ({"fault": {"suppressed_when": ["fault"]}}, "no other alarm or finding is called 'fault'"),
        ({"press 1": {"source": "level"}}, "'press 1' is no name for an alarm"),
    ],
)
def test_a_wrong_section_is_told_in_one_line(section: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ValidationError, match=complaint):
        AlarmSettings.model_validate(section)


def test_the_status_is_the_most_severe_of_verdict_data_and_alarms() -> None:
    fault = definition(ne107="out_of_specification", suppressed_when=SUPPRESSED)
    active = (fault, brought_to(LifecycleState.ACKNOWLEDGED, fault))
    assert evaluate_ne107("healthy", (), []) == ("good", ())
    assert evaluate_ne107("undetermined", ("waiting",), []) == ("function_check", ("waiting", "undetermined"))
    assert evaluate_ne107("fault", (), []) == ("maintenance_required", ("fault",))
    assert evaluate_ne107("fault", (), [active]) == ("out_of_specification", ("fault",))
    assert evaluate_ne107("undetermined", ("silent", "jitter"), [active]) == ("failure", ("silent",))
    shelved = brought_to(LifecycleState.SHELVED, fault)
    assert evaluate_ne107("fault", (), [(fault, shelved)]).ne107 == "out_of_specification"  # shelving is about telling
    assert evaluate_ne107("fault", (), [(fault, replace(shelved, suppressed=True))]).ne107 == "maintenance_required"
    assert (
        evaluate_ne107("fault", (), [(fault, brought_to(LifecycleState.OUT_OF_SERVICE, fault))]).ne107
        == "function_check"
    )
