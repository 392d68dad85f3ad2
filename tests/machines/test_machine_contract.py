"""What all machines guarantee, checked for every built-in kind."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from arm_halls import write_arm
from halls import LOOP, recorded

from servoscope.arm.simulation import simulate_arm
from servoscope.core.errors import BaselineError
from servoscope.machines.kinds import (
    kind_of_file,
    kind_of_loop_file,
    load_machine,
    machine_class,
    machine_kinds,
    parse_machine,
)
from servoscope.machines.protocol import CHECKS, Machine
from servoscope.signals import writers

BEGAN = 1767225580.0  # UTC s


class Harness:
    """A machine of one kind, a healthy log of it in a file, and the same log as rows t, r, u, y and channels."""

    def __init__(self, kind: str, machine: Machine, log: Path, rows: np.ndarray) -> None:
        self.kind, self.machine, self.log, self.rows = kind, machine, log, rows


def _loop(folder: Path) -> Harness:
    logs = [folder / f"{seed}.csv" for seed in (1, 2, 3)]
    for seed, log in enumerate(logs, 1):
        writers.write_recording(log, recorded(seed))
    kind = kind_of_loop_file(LOOP)
    machine = machine_class(kind).learn(LOOP, logs[:2], nullcontext)
    recording = recorded(3)
    rows = np.stack([recording.t + BEGAN, recording.r, recording.u, recording.y])
    return Harness(kind, machine, logs[2], rows)


def _arm(folder: Path) -> Harness:
    machine, columns = load_machine(write_arm(folder) / "arm.json"), simulate_arm(7, 20.0)
    log = folder / "healthy.csv"
    table = np.column_stack(list(columns.values()))
    np.savetxt(log, table, delimiter=",", header=",".join(columns), comments="")
    t, own = columns[machine.carrier.columns.time], machine.carrier.columns.covariates
    rows = np.stack([t + BEGAN, *[t] * 3, *(columns[own[name]] for name in machine.channels)])
    return Harness("arm", machine, log, rows)


MAKERS: dict[str, Callable[[Path], Harness]] = {"loop": _loop, "arm": _arm}


@pytest.fixture(scope="module", params=MAKERS)
def harness(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Harness:
    return MAKERS[request.param](tmp_path_factory.mktemp(request.param))


def check_file(harness: Harness, folder: Path) -> None:
    machine, path = harness.machine, folder / "baseline.json"
    machine.save(path)
    assert kind_of_file(path) == harness.kind
    for again in (load_machine(path), parse_machine(machine.to_json())):
        assert type(again) is type(machine) and again.hash == machine.hash and again.name == machine.name


def check_names(harness: Harness, folder: Path) -> None:
    words = harness.machine.fault_words
    assert words and all(words.values())
    assert all(str(check) for fault in words for check in harness.machine.checks(fault))


def check_points(harness: Harness, folder: Path) -> None:
    with pytest.raises(BaselineError) as error:
        harness.machine.at("cold")
    assert "\n" not in str(error.value)


def check_log(harness: Harness, folder: Path) -> None:
    machine, steps = harness.machine, list[str]()
    judged = machine.judge(machine.read(harness.log), steps.append)
    assert judged.diagnosis.verdict == "healthy" and judged.hash == machine.hash and steps
    assert {fault.name for fault in judged.diagnosis.faults} <= machine.fault_words.keys()
    assert (
        machine.sources and machine.summary() and all(len(row) == len(machine.table()[0]) for row in machine.table()[1])
    )


def check_window(harness: Harness, folder: Path) -> None:
    diagnosis, start, evidence, _ = harness.machine.judge_window("window", harness.rows)
    assert diagnosis.verdict == "healthy" and start == pytest.approx(harness.rows[0, 0])
    assert (harness.machine.follower() is None) == (evidence is not None)
    assert evidence is None or 0.0 <= evidence < 1.0


def check_report(harness: Harness, folder: Path) -> None:
    judged = harness.machine.judge(harness.machine.read(harness.log), lambda _: None)
    judged.write_report(folder / "report.html", "baseline.json", harness.log.name)
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert harness.log.name in page and harness.machine.hash in page


@pytest.mark.parametrize("check", CHECKS)
def test_a_machine_keeps_the_contract(harness: Harness, check: str, tmp_path: Path) -> None:
    globals()[f"check_{check}"](harness, tmp_path)


def test_every_kind_is_checked_and_a_kind_that_is_missing_is_named(tmp_path: Path) -> None:
    assert set(MAKERS) == set(machine_kinds())
    path = tmp_path / "press.json"
    path.write_text('{"format": "servoscope-crane-baseline"}')
    with pytest.raises(BaselineError, match=r"press.json: .*'crane' is unknown, install"):
        load_machine(path)
