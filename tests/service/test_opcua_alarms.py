"""Alarms in the lists of two foreign OPC UA clients: raised, acknowledged, shelved, confirmed, refreshed, none lost."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from alarm_lists import SCRIPT, NodeAlarmList, PythonAlarmList, Row
from brokers import BEGAN, until
from test_opcua import STATUS

from servoscope.service.alarms import DEFAULT_ALARMS, LifecycleState
from servoscope.service.opcua import device_health
from servoscope.service.opcua.conditions import Condition
from servoscope.service.opcua.server import OpcuaServer, OpcuaServerSettings

# asyncua leaves tasks of a server that stops to the garbage collector
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
FAULT = "ns=2;s=press.alarm.fault"
NODESET = SCRIPT.parent / "node_modules/node-opcua-nodesets/nodesets/Opc.Ua.Di.NodeSet2.xml"


def status(state: str, since: float = BEGAN, **more: Any) -> dict[str, Any]:
    alarm = {"state": state, "since": since, "priority": "high", "cause": "Leakage.", "ne107": "maintenance_required"}
    return {**STATUS, "alarms": {"fault": {**alarm, **more}} if state != "normal" else {}}


@contextmanager
def opened(
    folder: Path, statuses: dict[str, Any], *, listen: str = "127.0.0.1:0", operate: bool = True
) -> Iterator[OpcuaServer]:
    settings = OpcuaServerSettings(kind="opcua", listen=listen, operate=operate)
    with closing(settings.create("scada", folder)) as outlet:
        outlet.open(statuses)
        yield outlet


def url(outlet: OpcuaServer) -> str:
    return f"opc.tcp://{outlet.address}/servoscope"


def states(row: Row) -> tuple[bool, bool, bool, str]:
    return row["activeState"], row["ackedState"], row["confirmedState"], row["shelvingState"]


@pytest.mark.slow
def test_two_stacks_show_each_state_and_lose_nothing_when_they_come_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from asyncua.server.internal_session import InternalSession

    counters = {name: getattr(InternalSession, name) for name in ("_counter", "_auth_counter")}
    statuses = {"press": status("unacknowledged"), "lift": status("acknowledged")}
    with ExitStack() as stack:
        with opened(tmp_path, {"hall": {"service": True, "alarms": {}}}) as outlet:
            node = stack.enter_context(closing(NodeAlarmList(url(outlet))))
            with closing(PythonAlarmList(url(outlet))) as python:
                check_states(outlet, [node, python])
            outlet.publish(statuses)
            until(lambda: len(node.rows()) == 2, 20.0)
            node.pause()
        for name, first in counters.items():  # as in a new process
            monkeypatch.setattr(InternalSession, name, first)
        outlet = stack.enter_context(opened(tmp_path, statuses, listen=outlet.address, operate=False))
        python = stack.enter_context(closing(PythonAlarmList(url(outlet))))
        check_recovery(outlet, node, python)


def check_recovery(outlet: OpcuaServer, node: NodeAlarmList, python: PythonAlarmList) -> None:
    """The library counts sessions and subscriptions from the same number in each process: the list of node-opcua once
    took those of asyncua, which had connected first, and asked for a message that was lost without end."""
    until(lambda: len(python.rows()) == 2, 20.0)
    node.go_on()
    until(lambda: node.ask("counts")["refreshed"] == 1, 30.0)
    assert [one.acknowledge(one.rows()[0], "seen") for one in (node, python)] == ["BadUserAccessDenied"] * 2
    assert not outlet.take_requests()  # since it may not operate
    outlet.publish({"press": status("acknowledged")})
    for one in (node, python):
        until(lambda one=one: [row["ackedState"] for row in one.rows()] == [True, True], 20.0)


def check_states(outlet: OpcuaServer, lists: list[NodeAlarmList | PythonAlarmList]) -> None:
    expected = {
        "unacknowledged": (True, False, True, "Unshelved"),
        "acknowledged": (True, True, True, "Unshelved"),
        "returned_unacknowledged": (False, False, True, "Unshelved"),
        "latched_unacknowledged": (False, False, False, "Unshelved"),
        "latched_acknowledged": (False, True, False, "Unshelved"),
        "shelved": (True, True, True, "TimedShelved"),
        "suppressed_by_design": (False, True, True, "Unshelved"),
        "out_of_service": (False, True, True, "Unshelved"),
    }
    assert ["normal", *expected] == list(LifecycleState)
    for state, words in expected.items():
        outlet.publish({"press": status(state, active=words[0])})
        for one in lists:
            until(lambda one=one, words=words: [states(row) for row in one.rows()] == [words], 20.0)
    for one in lists:
        assert [(row["conditionName"], row["severity"], row["message"]) for row in one.rows()] == [
            ("fault", 750, "Leakage.")
        ]
    health = lists[0].ask("health", asset="ns=2;s=press", di=3)  # type: ignore[union-attr]
    assert health == {"value": 1, "type": "ns=3;i=6244", "name": "FAILURE"}
    outlet.publish({"press": status("normal")})
    for one in lists:
        until(lambda one=one: not one.rows(), 20.0)


def test_an_event_has_one_name_over_restarts_and_another_for_each_change() -> None:
    def condition(state: str, **more: Any) -> Condition:
        return Condition.from_status("press", "fault", status(state, **more)["alarms"]["fault"])

    one = condition("unacknowledged")
    others = [condition("acknowledged"), condition("unacknowledged", since=BEGAN + 1.0)]
    reworded = condition("unacknowledged", cause="Leakage 1.3.")
    assert len({one.event_id, reworded.event_id, *(other.event_id for other in others)}) == 4
    assert one.event_id == condition("unacknowledged").event_id and len(one.event_id) == 16
    assert reworded.event_id[:8] == one.event_id[:8] not in [other.event_id[:8] for other in others]


def test_alarms_stored_by_an_earlier_version_are_shown() -> None:
    old = {key: value for key, value in status("acknowledged")["alarms"]["fault"].items() if key != "ne107"}
    assert Condition.from_status("press", "fault", old).active


@pytest.mark.skipif(not NODESET.is_file(), reason="opcua_server is not installed")
def test_types_of_devices_are_those_of_the_published_nodeset() -> None:
    text = NODESET.read_text(encoding="utf-8")
    published = dict(re.findall(r'<UA\w+ NodeId="ns=1;i=(\d+)" BrowseName="1:(\w+)"', text))
    numbers = {**{number: name for number, name in device_health.ALARM_TYPES.values()}}
    numbers |= {device_health.ENUMERATION: "DeviceHealthEnumeration", device_health.INTERFACE: "IDeviceHealthType"}
    numbers |= {device_health.INTERFACE_HEALTH: "DeviceHealth"}
    numbers |= {device_health.ABSTRACT_ALARM: "DeviceHealthDiagnosticAlarmType"}
    assert {str(number): published[str(number)] for number in numbers} == {str(n): name for n, name in numbers.items()}
    definition = text[text.index('<Definition Name="1:DeviceHealthEnumeration">') :]
    found = re.findall(r'<Field Name="(\w+)" Value="(\d)">', definition[: definition.index("</Definition>")])
    assert found == [(name, str(value)) for value, name in enumerate(device_health.HEALTH)]
    assert set(device_health.ALARM_TYPES) == {alarm["ne107"] for alarm in DEFAULT_ALARMS.values()} - {"good"} | {
        "failure"
    }
