"""The page on handing over: its service file feeds four systems from one document, its pictures show what these get."""

from __future__ import annotations

import csv
import importlib.util
import json
import re
from pathlib import Path
from typing import Any

import halls
import pytest
from alarm_lists import PythonAlarmList
from brokers import Running, until
from test_folder_service import drop, hall

from servoscope.service import kinds, publishers

# asyncua leaves the event loop of a client to the garbage collector
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
MAX_LINES = 20  # of a service file, for all outlets together


def block(project: Path) -> str:
    """Return the lines of the service file on the page."""
    page = (project / "docs/how-to/hand-over.md").read_text(encoding="utf-8")
    (found,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    return found


@pytest.mark.slow
def test_the_lines_of_the_page_feed_four_systems_from_one_document(tmp_path: Path, project: Path) -> None:
    lines = block(project)
    assert len(lines.splitlines()) <= MAX_LINES
    path = hall(tmp_path, lines.replace(":4841", ":0").replace("path =", "every_s = 0.05\npath ="))
    drop(tmp_path, "healthy.csv", "press_20260101_000000.csv")
    drop(tmp_path, "leaky.csv", "press_20260101_000100.csv")
    running = Running(service := halls.service_of(path))
    try:
        work = tmp_path / "work/worklist.json"
        until(lambda: work.is_file() and any(item["size"] for item in json.loads(work.read_text())), 120.0)
        alarms = PythonAlarmList(f"opc.tcp://{service._publishers['scada'].address}/servoscope")  # type: ignore[attr-defined]
        until(lambda: "ns=2;s=press.alarm.fault" in [row["condition"] for row in alarms.rows()], 30.0)
        ratio = alarms.value("ns=2;s=press.Ratio")
        alarms.close()
    finally:
        running.end(stop=True)
    (item,) = (one for one in json.loads(work.read_text()) if one["key"] == "press:leakage")
    rows = list(csv.DictReader((tmp_path / "work/worklist.csv").read_text().splitlines()))
    shell = json.loads((tmp_path / "shells/press.json").read_text())
    robot = json.loads((tmp_path / "ros2/ros2.json").read_text())
    assert shell["assetAdministrationShells"][0]["id"] == "https://works.example/assets:press:aas"
    (faults,) = (one for one in shell["submodels"][0]["submodelElements"] if one["idShort"] == "Faults")
    fields: dict[str, Any] = {one["idShort"]: one for one in faults["value"][0]["value"]}
    (report,) = (one for one in robot["reports"] if one["fault_code"] == "PRESS_LEAKAGE")
    evidence = {one["key"]: one["value"] for one in report["evidence"]}
    assert str(item["size"]) == fields["Ratio"]["value"] == evidence["size"] == str(ratio)
    assert [row["size"] for row in rows if row["key"] == item["key"]] == [str(item["size"])]
    assert str(item["size_low"]) == fields["Interval95"]["min"] == evidence["size_low"]
    assert item["since"] == evidence["since"] and item["check"] and evidence["check_1"] == item["check"][0]


def test_no_other_file_knows_a_publisher_of_the_folder(project: Path) -> None:
    folder = Path(next(iter(publishers.__path__)))
    names = [path.stem for path in folder.glob("*.py") if path.stem not in ("__init__", "base", "files")]
    assert {"aas", "ros2", "worklist"} <= set(names) <= kinds.find_kinds(kinds.PUBLISHERS).keys()
    foreign = [
        (name, path.name)
        for name in names
        for path in (project / "src").rglob("*.py")
        if path.stem != name
        and re.search(rf"publishers[.:]{name}\b|[\"']{name}[\"']", path.read_text(encoding="utf-8"))
    ]
    assert foreign == []


def test_pictures_are_drawn_from_what_the_outlets_give(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = importlib.util.spec_from_file_location("hand_over", project / "scripts/hand_over.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    stored = {name: (module.FOLDER / name).read_text(encoding="utf-8") for name in module.pictures()}
    assert module.pictures() == stored and len(stored) == 4
    monkeypatch.setitem(module.STORED, "summary", "Friction.")
    assert module.pictures() != stored
    page = (project / "docs/how-to/hand-over.md").read_text(encoding="utf-8")
    assert all(f"hand-over/{name})" in page for name in stored)
