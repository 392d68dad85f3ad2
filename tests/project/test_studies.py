"""A small share of the studies is measured again, so that a row of a page that has become stale fails.

`make figures` measures all of them. Programs marked quick in benchmarks/figures.toml run whole, see test_figures.py.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from accuracy import nonlinear, run
from studies.design import size
from studies.recordings import RIG

import servoscope as ss
from servoscope.design.detectability import AlarmPower, detectable_size
from servoscope.design.mimics import match_mimic, mimic_causes
from servoscope.design.scenario import Scenario
from servoscope.design.study import SEED
from servoscope.simulation import reference, simulate

PROJECT = Path(__file__).resolve().parents[2]
# scenarios of docs/accuracy.md of which the first unit of work takes about a second
SCENARIOS = (
    "bias/healthy",
    "motion/valve-trapezoid",
    "signals/axis-2-friction",
    "smooth/axis-2-friction",
)
TOLERANCES = {"rel": 1e-3, "abs": 5e-4}  # pages show two digits


def stored(program: str) -> dict[str, Any]:
    text = (PROJECT / "benchmarks" / "figures" / f"{program}.json").read_text(encoding="utf-8")
    results: dict[str, Any] = json.loads(text)
    return results


def rows(program: str, title: str) -> dict[str, list[str]]:
    (table,) = (table for table in stored(program)["tables"] if table["title"] == title)
    return {row[0]: row[1:] for row in table["rows"]}


def numbers(result: Any) -> Iterator[Any]:
    if isinstance(result, dict):
        result = [result[key] for key in sorted(result)]
    if isinstance(result, list | tuple):
        for part in result:
            yield from numbers(part)
    else:
        yield result


def test_the_program_of_each_figure_is_listed() -> None:
    command = [sys.executable, "benchmarks"]
    listed = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, check=True).stdout
    programs = {line.split()[0] for line in listed.splitlines()}
    figures = tomllib.loads((PROJECT / "benchmarks" / "figures.toml").read_text(encoding="utf-8"))
    words = [figure["command"].split() for figure in figures.values()]
    assert {name for program, name, *_ in words if program == "benchmarks"} <= programs
    assert subprocess.run([*command, "public/nothing"], cwd=PROJECT, capture_output=True, check=False).returncode == 1


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_a_scenario_finds_what_is_stored(scenario: str) -> None:
    before = list(numbers(run.stored_results()[scenario]["numbers"][0]))
    after = list(numbers(json.loads(json.dumps(run.SCENARIOS[scenario].run(0)))))
    assert after == [pytest.approx(value, **TOLERANCES) if isinstance(value, float) else value for value in before]


def test_the_nonlinear_rig_is_as_its_page_says() -> None:
    results = stored("nonlinear")
    (table,) = nonlinear.effects(("none: the linear rig", "all of them at 40 degC"))
    assert {row[0]: list(row[1:]) for row in table.rows}.items() <= rows("nonlinear", table.title).items()
    assert nonlinear.leak() == results["values"]["leak"]


def test_the_design_study_is_as_its_page_says() -> None:
    """The pump on the trapezoid, and another mass."""
    loop = ss.Loop.load(RIG)
    r = reference("trapezoid", 60.0 + 30.0, loop.sample_rate)
    healthy, _ = simulate(loop, r[: round(60.0 * loop.sample_rate)], seed=SEED)
    scene = Scenario.from_baseline(ss.learn(loop, [healthy]), r, 30.0)
    pump = loop.plant.faults[0]
    detected = [float(np.exp(way * detectable_size(AlarmPower(scene), pump, way > 0))) for way in (1, -1)]
    cells = rows("design", "Detectable sizes")
    assert [size(ratio) for ratio in detected] == [cells[f"pump {way}"][4] for way in ("up", "down")]
    match = match_mimic(scene, mimic_causes(scene)[0])
    cosine = match.cosines[match.imitates]
    assert rows("mimics", "Mimics")["another mass"][2].startswith(f"{match.imitates}, {cosine:.3f}, ")
