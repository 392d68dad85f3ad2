"""Verdicts for ROS 2, judged against the published definitions: what the example node sends is serialized by them."""

from __future__ import annotations

import importlib.util
import json
import re
import sys
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from test_publishers import ABOUT, ALARM, FAULT, NOTHING, status

from servoscope.service.kinds import PUBLISHERS, find_kinds
from servoscope.service.publishers.ros2 import MAX_CODE, fault_code

DEFINITION = Path(__file__).parents[1] / "support/ros2/ReportFault.srv"
REQUEST = "ros2_medkit_msgs/srv/msg/ReportFault_Request"  # as the type store calls it
STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE.register(get_types_from_msg(DEFINITION.read_text(encoding="utf-8").split("---")[0], REQUEST))
STATUS, ARRAY, KEY_VALUE, TIME = (
    f"{name}" for name in ("diagnostic_msgs/msg/DiagnosticStatus", "diagnostic_msgs/msg/DiagnosticArray",
                           "diagnostic_msgs/msg/KeyValue", "builtin_interfaces/msg/Time")
)  # fmt: skip


def message_type(name: str) -> type:
    """Return a class like those that ROS generates for Python: fields of the definition and no others."""
    fields = [field for field, _ in STORE.fielddefs[name][1]]

    class Message:
        __slots__ = fields

        def __init__(self, **values: Any) -> None:
            for field in fields:
                setattr(self, field, values.pop(field, None))
            assert not values
            if "header" in fields:
                self.header = STORE.types["std_msgs/msg/Header"](stamp=None, frame_id="")

        def judged(self) -> Any:
            """Return it as a message of the type store."""
            values = {field: getattr(self, field) for field in fields}
            for field, value in values.items():
                if isinstance(value, list):
                    values[field] = [one.judged() for one in value]
                if isinstance(value, bytes):  # a `byte` is one byte for Python
                    (values[field],) = value
            return STORE.types[name](**values)

    return Message


class Ros:
    """What a node finds of ROS: it notes what is sent, serialized and read again."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.sent: list[Any] = []
        self.reports: list[Any] = []
        self.warned: list[str] = []
        self.accepts = True
        self.file = ""
        request = SimpleNamespace(Request=message_type(REQUEST))
        for name, content in {
            "rclpy": {},
            "rclpy.node": {"Node": self.node_class()},
            "diagnostic_msgs.msg": {n.rpartition("/")[2]: message_type(n) for n in (STATUS, ARRAY, KEY_VALUE)},
            "ros2_medkit_msgs.srv": {"ReportFault": request},
        }.items():
            module = ModuleType(name)
            vars(module).update(content)
            monkeypatch.setitem(sys.modules, name, module)

    def node_class(ros) -> type:
        class Node:
            def __init__(self, name: str) -> None:
                assert re.fullmatch(r"[a-z_]+", name)

            def declare_parameter(self, _: str, value: str) -> Any:
                return SimpleNamespace(value=ros.file or value)

            def create_publisher(self, _: type, topic: str, depth: int) -> Any:
                assert (topic, depth) == ("/diagnostics", 10)
                return SimpleNamespace(publish=lambda message: ros.sent.append(ros.read(message, ARRAY)))

            def create_client(self, _: Any, service: str) -> Any:
                assert service == "/fault_manager/report_fault"
                return SimpleNamespace(service_is_ready=lambda: True, call_async=self.call)

            def call(self, request: Any) -> Any:
                ros.reports.append(ros.read(request, REQUEST))
                future = SimpleNamespace(result=lambda: SimpleNamespace(accepted=ros.accepts))
                return SimpleNamespace(add_done_callback=lambda call: call(future))

            def create_timer(self, period_s: float, call: Any) -> None:
                assert period_s == 1.0

            def get_logger(self) -> Any:
                return SimpleNamespace(warning=ros.warned.append)

            def get_clock(self) -> Any:
                now = SimpleNamespace(to_msg=lambda: STORE.types[TIME](sec=1, nanosec=2))
                return SimpleNamespace(now=lambda: now)

        return Node

    @staticmethod
    def read(message: Any, name: str) -> Any:
        judged = message.judged()
        read = STORE.deserialize_cdr(STORE.serialize_cdr(judged, name), name)
        assert read == judged
        return read


def bridge(project: Path) -> Any:
    spec = importlib.util.spec_from_file_location("servoscope_bridge", project / "examples/ros2/servoscope_bridge.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Bridge()


def outlet(folder: Path) -> Any:
    return find_kinds(PUBLISHERS)["ros2"].load()(kind="ros2", path="ros2", every_s=600.0).create("hall.robot", folder)


def stored(**keys: Any) -> dict[str, Any]:
    return {**status(about=ABOUT, **keys), "counted": {"began": 0.0, "t": 1767225640.0}}


def test_a_node_sends_diagnostics_and_faults_until_they_are_accepted_and_gone(
    tmp_path: Path, project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ros = Ros(monkeypatch)
    ros.file = str(tmp_path / "ros2/ros2.json")
    one = outlet(tmp_path)
    alarms = {"fault": {**ALARM, "ne107": "maintenance_required"}}
    one.open({"press": stored(alarms=alarms), "axis 7/ä": stored(**NOTHING), "hall": {"service": True}})
    node = bridge(project)
    ros.accepts = False
    node.send()
    (array,) = ros.sent
    assert array.header.stamp.nanosec == 2
    assert [(one.level, one.name, one.hardware_id) for one in array.status] == [
        (STORE.types[STATUS].OK, "servoscope: axis 7/ä", "axis 7/ä"),
        (STORE.types[STATUS].ERROR, "servoscope: press", "press"),
    ]
    values = {value.key: value.value for value in array.status[1].values}
    assert values["leakage.size"] == "1.2" and values["leakage.check_2"] == "Valve; return line."
    assert values["leakage.since"] == "2025-12-31T23:59:40Z"
    ros.accepts = True
    node.send()
    node.send()  # nothing has changed
    first, again = ros.reports
    types = STORE.types[REQUEST]
    assert first == again and (first.fault_code, first.event_type) == ("PRESS_LEAKAGE", types.EVENT_FAILED)
    assert (first.severity, first.source_id, first.description) == (2, "/servoscope/press", "leakage")
    assert {value.key for value in first.evidence} > {"size", "size_low", "size_high", "since", "due", "check_1"}
    one.close()

    another = outlet(tmp_path)  # after a restart of the service, during which the fault has gone
    another.open({"press": stored(**NOTHING)})
    node.send()
    gone = ros.reports[-1]
    assert (gone.fault_code, gone.event_type, gone.evidence) == ("PRESS_LEAKAGE", types.EVENT_PASSED, [])
    another.publish({"press": stored(faults=[{**FAULT, "name": "friction"}])})
    another.close()
    node.send()
    assert all(status.level != STORE.types[STATUS].STALE for array in ros.sent for status in array.status)
    file = Path(ros.file)
    document = json.loads(file.read_text())
    file.write_text(json.dumps({**document, "until": time.time() - 1.0}))  # the service has ended
    node.send()
    assert [status.level for status in ros.sent[-1].status] == [STORE.types[STATUS].STALE]
    file.unlink()
    node.send()
    assert ros.warned == [f"{file}: [Errno 2] No such file or directory: '{file}'"]
    events = {report.fault_code: report.event_type for report in ros.reports[2:]}
    assert events == {"PRESS_LEAKAGE": types.EVENT_PASSED, "PRESS_FRICTION": types.EVENT_FAILED}


@given(st.lists(st.text(min_size=1, max_size=100), min_size=2, max_size=2, unique_by=str.upper))
@settings(max_examples=100)
def test_codes_have_the_form_of_the_convention_and_no_two_assets_share_one(assets: list[str]) -> None:
    codes = [fault_code(f"{asset}:leakage") for asset in assets]
    assert len(set(codes)) == 2
    assert all(re.fullmatch(r"[A-Z0-9_]+", code) and len(code) <= MAX_CODE for code in codes)


def test_the_example_node_is_short_and_a_damaged_file_is_begun_anew(tmp_path: Path, project: Path) -> None:
    lines = (project / "examples/ros2/servoscope_bridge.py").read_text().split('"""', 2)[2].splitlines()
    assert len([line for line in lines if line.strip() and not line.strip().startswith(("#", '"""'))]) <= 45
    (tmp_path / "ros2").mkdir()
    for damaged in ('{"reports": [{"fault_code": "A"}]}', "[]", "{"):
        (tmp_path / "ros2/ros2.json").write_text(damaged)
        one = outlet(tmp_path)
        one.open({"press": stored(**NOTHING)})
        one.close()
        document = json.loads((tmp_path / "ros2/ros2.json").read_text())
        assert len(document["status"]) == 1 and document["reports"] == []
