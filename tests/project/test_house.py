"""The measures of the structure: none gets worse unnoticed, and nobody but an entry point knows a machine's package."""

from __future__ import annotations

import json
from typing import Any

from sources import PROJECT, SOURCES, house, listing
from test_architecture import imports

BOUNDS: dict[str, Any] = json.loads((PROJECT / "scripts" / "house-bounds.json").read_text(encoding="utf-8"))
MACHINES = {"arm"}


def test_no_measure_gets_worse() -> None:
    figures = house.measure(SOURCES)
    worse = [f"{name}: {figures[name]:g}, was {bound:g}" for name, bound in BOUNDS.items() if figures[name] > bound]
    assert not worse, f"the structure got worse (scripts/house.py; bounds are lowered by --bounds):{listing(worse)}"


def test_bounds_are_only_lowered(tmp_path: Any) -> None:
    path = tmp_path / "bounds.json"
    path.write_text('{"arm_questions": 3, "method_names": 5}')
    house.lower_bounds(path, {"arm_questions": 1, "method_names": 9, "lines": 4})
    assert json.loads(path.read_text()) == {"arm_questions": 1, "method_names": 5}
    assert {"arm_questions", *(f"outside_{kind}" for kind in house.KINDS)} <= BOUNDS.keys()


def test_nobody_imports_the_package_of_a_machine() -> None:
    wrong = [
        f"{path}:{line} imports {name}"
        for path, names in imports().items()
        for line, name in names
        if (package := [*name.split("."), ""][1]) in MACHINES and path.split("/")[0] != package
    ]
    assert not wrong, f"a machine is found by its entry point (machines/kinds.py):{listing(wrong)}"
