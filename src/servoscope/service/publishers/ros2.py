"""Assets for ROS 2: contents of `diagnostic_msgs`, and of reports to the fault manager of ros2_medkit.

A node copies them into messages; `examples/ros2` has one. The gateway of ros2_medkit takes no faults: reports are
calls of the service ReportFault.
"""

from __future__ import annotations

import hashlib
import json
import re
import time
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

from servoscope.service.alarms import Ne107
from servoscope.service.alarms.settings import PRIORITIES
from servoscope.service.assets.status import AssetStatus
from servoscope.service.assets.work_items import WorkItem, work_items
from servoscope.service.publishers.files import FilesPublisher, FilesSettings

FILE = "ros2.json"
OK, WARN, ERROR = 0, 1, 2  # levels of a DiagnosticStatus
LEVELS: Mapping[Ne107, int] = {"good": OK, "failure": ERROR}  # all others: the machine goes on
FAILED, PASSED = 0, 1  # events of a ReportFault
LOOKS = 3  # for so many the file holds, which is written at each: a service that has ended leaves no healthy machines
MAX_CODE = 64  # characters of the code of a fault
Message = dict[str, Any]


class Ros2Settings(FilesSettings):
    """An outlet of kind ``ros2``: the file ``ros2.json``, for a bridge node."""

    kind: Literal["ros2"]

    def create(self, name: str, folder: Path) -> Ros2Publisher:
        """Return the publisher."""
        return Ros2Publisher(folder / self.path, self.every_s)


class Ros2Publisher(FilesPublisher):
    """Keeps a DiagnosticStatus of each asset, and a report of each fault that there is or has been."""

    def __init__(self, folder: Path, every_s: float) -> None:
        super().__init__(folder, every_s)
        self._diagnostics: dict[str, Message] = {}
        self._reports: dict[str, Message] = {}  # by code
        with suppress(OSError, ValueError, KeyError, TypeError):  # what was reported before a restart may have gone
            for report in json.loads((folder / FILE).read_bytes())["reports"]:
                self._reports[report["fault_code"]] = passed(report) | {"source_id": report["source_id"]}

    def render(self, changed: Mapping[str, AssetStatus]) -> Mapping[str, bytes]:
        """Return the file."""
        for name, status in changed.items():
            items = work_items(name, status)
            self._diagnostics[name] = diagnostic_status(name, status, items)
            ours = {code: old for code, old in self._reports.items() if old["source_id"] == source_id(name)}
            self._reports |= {code: passed(report) for code, report in ours.items()}
            self._reports |= {report["fault_code"]: report for report in map(failed, items)}
        document = {
            "until": time.time() + LOOKS * self._every_s,
            "status": [message for _, message in sorted(self._diagnostics.items())],
            "reports": [report for _, report in sorted(self._reports.items())],
        }
        return {FILE: json.dumps(document, indent=1, allow_nan=False).encode()}


def diagnostic_status(asset: str, status: AssetStatus, items: Collection[WorkItem]) -> Message:
    """Return the fields of a `diagnostic_msgs/DiagnosticStatus`."""
    values: dict[str, str] = {"verdict": status.verdict, "ne107": status.ne107}
    for item in items:
        values |= {f"{item.key.removeprefix(f'{asset}:')}.{name}": text for name, text in measurements(item).items()}
    return {
        "level": LEVELS.get(status.ne107, WARN),
        "name": f"servoscope: {asset}",
        "message": status.summary,
        "hardware_id": asset,
        "values": key_values(values),
    }


def failed(item: WorkItem) -> Message:
    """Return the fields of a request of `ros2_medkit_msgs/srv/ReportFault` for a finding."""
    return {
        "fault_code": fault_code(item.key),
        "event_type": FAILED,
        "severity": PRIORITIES.index(item.urgency),  # from INFO to CRITICAL
        "description": item.finding,
        "source_id": source_id(item.asset),
        "evidence": key_values(measurements(item)),
    }


def passed(report: Message) -> Message:
    """Return the report that a fault has gone."""
    return {**report, "event_type": PASSED, "evidence": []}


def measurements(item: WorkItem) -> dict[str, str]:
    """Return what is known of a finding, as texts."""
    names = "since", "parameter", "size", "size_low", "size_high", "due", "ne107"
    known = {name: getattr(item, name) for name in names}
    checks = {f"check_{k}": text for k, text in enumerate(item.check, 1)}
    return {name: str(value) for name, value in {**known, **checks}.items() if value not in (None, "")}


def key_values(values: Mapping[str, str]) -> list[Message]:
    """Return the fields of `diagnostic_msgs/KeyValue` messages."""
    return [{"key": key, "value": value} for key, value in values.items()]


def source_id(asset: str) -> str:
    """Return what a report names as its origin, in the form of a node's full name."""
    return f"/servoscope/{_plain(asset).lower()}"


def fault_code(key: str) -> str:
    """Return the code of a fault, unique among all assets: capital letters, digits and underscores."""
    return _plain("_".join(key.rsplit(":", 1)))


def _plain(text: str) -> str:
    """Return a text in capital letters, digits and underscores; where others are lost, with a hash in their place."""
    plain = re.sub(r"[^A-Z0-9]+", "_", text.upper())
    if re.fullmatch(r"\w+", text, re.ASCII) and len(plain) <= MAX_CODE:
        return plain
    return f"{plain[: MAX_CODE - 9]}_{hashlib.sha256(text.encode()).hexdigest()[:8].upper()}"
