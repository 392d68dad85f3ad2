#!/usr/bin/env python3
"""Draws what other systems are given of one asset, from the outlets' own functions: docs/images/hand-over/*.svg.

scripts/hand_over.py             print which pictures are not those of this version; 1 if there are some
scripts/hand_over.py --write     draw them
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from html import escape
from pathlib import Path
from typing import Any

from servoscope.service.assets.status import AssetStatus, read_status
from servoscope.service.assets.work_items import work_items
from servoscope.service.opcua.conditions import SEVERITIES, Condition
from servoscope.service.opcua.device_health import ALARM_TYPES
from servoscope.service.publishers.aas import shell
from servoscope.service.publishers.ros2 import diagnostic_status, failed

FOLDER = Path(__file__).resolve().parent.parent / "docs/images/hand-over"
DAY_S, BEGAN = 86400.0, 1767225600.0  # 2026-01-01
ALARM = {"state": "unacknowledged", "since": BEGAN + 60.0, "priority": "high", "cause": "Leakage has risen by a fifth.",
         "active": True, "ne107": "maintenance_required"}  # fmt: skip
STORED: dict[str, Any] = {
    "verdict": "fault", "summary": ALARM["cause"], "since": BEGAN, "onset": BEGAN, "examined": BEGAN + 60.0,
    "ne107": "maintenance_required", "reasons": ["fault"], "statistic": 3.5, "level": 2.0, "quality": {},
    "faults": [{"name": "leakage", "parameter": "C_ie", "ratio": 1.2, "interval": [1.17, 1.23]}],
    "alarms": {"fault": ALARM}, "counted": {"began": BEGAN - DAY_S, "t": BEGAN + 60.0},
    "about": {"group": "hall 2", "faults": {"leakage": "leakage"}, "checks": {"leakage": ["Seals of the piston."]}},
    "outlook": {"name": "leakage", "limit": 1.5, "outlook": "forecast", "t": BEGAN, "asked": BEGAN,
                "reach_t": [BEGAN + 20 * DAY_S, BEGAN + 30 * DAY_S, None], "summary": "Limit 1.5 in 30 days."},
}  # fmt: skip
CHARACTER, LINE, MARGIN = 7.3, 18.0, 12.0  # of the font, px
WIDTH_OF_STATUS, GAP = 34, 40.0


def alarm_list() -> list[str]:
    """Return the row of an alarm list."""
    condition = Condition.from_status("press", "fault", ALARM)
    words = {name: holds for name, holds in condition.two_states.items() if name in ("ActiveState", "AckedState")}
    fields = {
        "SourceName": condition.asset,
        "ConditionName": condition.alarm,
        "EventType": ALARM_TYPES[str(condition.ne107)][1],
        "Severity": SEVERITIES[condition.priority],
        "Message": condition.cause,
        **{f"{name}/Id": str(holds).lower() for name, holds in words.items()},
    }
    return columns(fields.items())


def twin(status: AssetStatus) -> list[str]:
    """Return the elements of the shell's submodels, indented."""

    def lines(element: dict[str, Any], depth: int) -> Iterable[str]:
        value = element.get("statements", element.get("value", f"{element.get('min')} .. {element.get('max')}"))
        name = "  " * depth + element.get("idShort", "-")
        yield name if isinstance(value, list) else f"{name:<32}{value}"
        for inside in value if isinstance(value, list) else ():
            yield from lines(inside, depth + 1)

    shown = ("Verdict", "Since", "NE107", "Faults", "RemainingUsefulLifePrediction")
    left_out = ("  IsBoundary", "  BoundaryEng", "  ListRUL", "  PredictionModel", "  Indication", "  StartValue")
    found = []
    for submodel in shell("press", status)["submodels"]:
        found.append(submodel["idShort"])
        for element in submodel["submodelElements"]:
            if element["idShort"] in shown:
                found += lines(element, 1)
    return [line for line in found if not any(part in line for part in left_out)][:18]


def work_list(status: AssetStatus) -> list[str]:
    """Return the item of the work list."""
    (item,) = work_items("press", status)
    return columns((name, "; ".join(value) if name == "check" else value) for name, value in item._asdict().items())


def ros2(status: AssetStatus) -> list[str]:
    """Return the two messages."""
    items = work_items("press", status)
    found = []
    for title, message in (
        ("/diagnostics: DiagnosticStatus", diagnostic_status("press", status, items)),
        ("/fault_manager/report_fault: ReportFault", failed(items[0])),
    ):
        pairs = message.pop("values", None) or message.pop("evidence")
        found += [
            "",
            title,
            *columns(message.items()),
            *columns((f"  {one['key']}", one["value"]) for one in pairs[:4]),
        ]
    return found[1:]


def columns(pairs: Iterable[tuple[str, object]]) -> list[str]:
    """Return names and values as lines of two columns."""
    return [f"{name:<22}{value}" for name, value in pairs]


def picture(title: str, right: list[str]) -> str:
    """Return the drawing: the status, an arrow, and what the other system is given."""
    fault = STORED["faults"][0]
    status = columns([
        ("verdict", STORED["verdict"]), ("NE 107", "maintenance"), ("fault", fault["name"]), ("size", fault["ratio"]),
        ("95 %", " .. ".join(map(str, fault["interval"]))), ("since", "2026-01-01"), ("limit 1.5", "in 30 days"),
    ])  # fmt: skip
    rows = max(len(status), len(right))
    left_px = WIDTH_OF_STATUS * CHARACTER + 2 * MARGIN
    right_px = max(map(len, [title, *right])) * CHARACTER + 2 * MARGIN
    height, width = (rows + 1) * LINE + 2 * MARGIN, left_px + GAP + right_px
    middle = height / 2.0
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width + 2:.0f} {height + 2:.0f}" '
        f'font-family="monospace" font-size="12"><title>{escape(title)}</title>',
        '<rect width="100%" height="100%" fill="#fff"/>',
        f'<path d="M{left_px + 4:.1f} {middle:.1f}h{GAP - 14:.1f}m-7 -5l8 5l-8 5" fill="none" stroke="#333"/>',
    ]
    for x, wide, name, lines in ((1.0, left_px, "press", status), (left_px + GAP, right_px, title, right)):
        parts.append(f'<rect x="{x:.1f}" y="1" width="{wide:.1f}" height="{height:.1f}" fill="#f6f8fa" stroke="#333"/>')
        for k, line in enumerate([name, *lines]):
            style = ' font-weight="bold"' if k == 0 else ""
            y = MARGIN + (k + 0.75) * LINE
            parts.append(f'<text x="{x + MARGIN:.1f}" y="{y:.1f}" xml:space="preserve"{style}>{escape(line)}</text>')
    return "\n".join([*parts, "</svg>"]) + "\n"


def pictures() -> dict[str, str]:
    """Return the drawings by file name."""
    status = read_status(STORED)
    assert isinstance(status, AssetStatus)
    return {
        "alarm-list.svg": picture("alarm list: an event of OPC UA", alarm_list()),
        "twin.svg": picture("digital twin: submodels of press.aasx", twin(status)),
        "work-list.svg": picture("CMMS: a row of worklist.csv", work_list(status)),
        "ros2.svg": picture("ROS 2: sent by the bridge node", ros2(status)),
    }


def main(arguments: list[str]) -> int:
    """Run the command line; 1 if a picture is another one."""
    stale = []
    for name, drawing in pictures().items():
        path = FOLDER / name
        if arguments == ["--write"]:
            path.write_text(drawing, encoding="utf-8")
        elif not path.is_file() or path.read_text(encoding="utf-8") != drawing:
            stale.append(name)
    print("\n".join(f"docs/images/hand-over/{name} is stale: make pictures" for name in stale))
    return 1 if stale else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
