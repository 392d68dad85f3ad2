"""Alarms in the lists of two foreign OPC UA clients, over restarts of the service and of the clients: none is lost."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from alarm_lists import NodeAlarmList, PythonAlarmList, Row
from brokers import until
from halls import asked
from test_folder_service import drop, hall
from test_opcua import free_port

from servoscope.service.alarms.records import UNACKNOWLEDGED_STATES
from servoscope.service.assets.status import read_status

FAULT = "ns=2;s=press.alarm.fault"
Shown = dict[str, tuple[bool, bool, bool]]  # of a condition: whether it is active, acknowledged, shelved
AlarmList = NodeAlarmList | PythonAlarmList


@contextmanager
def running(path: Path) -> Iterator[None]:
    """Run the service of a file in a process of its own; kill it then."""
    process = subprocess.Popen([sys.executable, "-m", "servoscope", "run", str(path)])
    try:
        yield
    finally:
        process.kill()
        process.wait()


def stored(path: Path) -> Shown:
    """Return the alarms that the store holds and that are not normal."""
    return {
        f"ns=2;s={asset}.alarm.{name}": (
            bool(alarm.active),
            alarm.state not in UNACKNOWLEDGED_STATES,
            alarm.state == "shelved",
        )
        for asset, text in asked(path, "SELECT asset, status FROM checkpoints")
        for name, alarm in read_status(json.loads(text)).alarms.items()
        if alarm.state != "normal"
    }


def shown(one: AlarmList) -> Shown:
    return {
        row["condition"]: (row["activeState"], row["ackedState"], row["shelvingState"] == "TimedShelved")
        for row in one.rows()
    }


def fault(one: AlarmList) -> Row:
    return next(row for row in one.rows() if row["condition"] == FAULT)


def agree(path: Path, *lists: AlarmList) -> int:
    """Wait until all lists show what the store holds; return how many alarms that are."""
    found: list[Shown] = []

    def do_agree() -> bool:
        found[:] = [stored(path), *(shown(one) for one in lists)]
        return all(one == found[0] for one in found)

    try:
        until(do_agree, 60.0)
    except AssertionError:
        raise AssertionError(found) from None
    return len(found[0])


def connected(address: str) -> PythonAlarmList | None:
    try:
        return PythonAlarmList(address)
    except OSError:
        return None


def command(visit: int, path: Path, node: NodeAlarmList, python: PythonAlarmList, seen: Row) -> str:
    """Do what an operator does on this visit; return what the server answers. `seen`: kept from visit to visit."""
    match visit:
        case 0:
            return node.acknowledge(fault(node), "on my way")
        case 1:
            return str(node.ask("shelve", condition=FAULT, for_s=3600.0))
        case 2:
            assert shown(node)[FAULT] == shown(python)[FAULT] == (True, True, True)
            answer = str(node.ask("unshelve", condition=FAULT))
            until(lambda: not fault(python)["ackedState"], 30.0)
            seen |= fault(python)
            return answer
        case 3:  # an event from before the restart
            return python.acknowledge(seen, "again")
        case 4:
            for minute in (2, 3, 4):  # the first examination that finds it healthy, and off_delay_s
                drop(path.parent, "healthy.csv", f"press_20260101_000{minute}00.csv")
            until(lambda: not fault(node)["confirmedState"], 60.0)
            return str(node.ask("refresh"))
        case _:
            event = fault(node)["eventId"]
            return str(node.ask("confirm", condition=FAULT, eventId=event, comment="new seal"))


@pytest.mark.slow
def test_no_alarm_and_no_command_is_lost_over_six_restarts(tmp_path: Path) -> None:
    """Both lists show what the store holds after each kill and each command; asyncua's client is new each time."""
    listen = f"127.0.0.1:{free_port()}"
    path = hall(tmp_path, f'[outlets.scada]\nkind = "opcua"\nlisten = "{listen}"\noperate = true')
    drop(tmp_path, "healthy.csv", "press_20260101_000000.csv")
    drop(tmp_path, "leaky.csv", "press_20260101_000100.csv")
    address, answers, seen, compared = f"opc.tcp://{listen}/servoscope", list[str](), Row(), list[int]()
    with ExitStack() as stack:
        node: NodeAlarmList | None = None
        for visit in range(7):
            with running(path), closing(until(lambda: connected(address), 60.0)) as python:
                if visit == 0:
                    until(lambda: FAULT in stored(path), 120.0)
                if visit in (0, 3):  # in between it connects again by itself
                    node = stack.enter_context(closing(NodeAlarmList(address)))
                assert node is not None
                times = visit - 3 * (visit >= 3)
                until(lambda one=node, times=times: one.ask("counts")["refreshed"] >= times, 60.0)
                compared.append(agree(path, node, python))
                if visit < 6:
                    answers.append(command(visit, path, node, python, seen))
                    compared.append(agree(path, node, python))
    assert answers == ["Good"] * 6 and FAULT not in stored(path)
    query = "SELECT what, document FROM audit WHERE asset = 'press' AND who = 'hall.scada.outlet' ORDER BY id"
    audited: Any = [(what, json.loads(document)["why"]) for what, document in asked(path, query)]
    assert audited == [
        ("acknowledge", "on my way"), ("shelve", ""), ("unshelve", ""), ("acknowledge", "again"), ("reset", "new seal"),
    ]  # fmt: skip
    print(f"{sum(compared)} alarms compared at {len(compared)} times with two lists, none lost")
