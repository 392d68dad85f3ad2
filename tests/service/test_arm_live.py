"""An arm as an asset of the service: messages of all joints to verdict, alarm, sizes and status."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arm_halls import FRICTION, ONSET_S, SIZE, arm_hall, replayed_arm, write_arm
from brokers import BEGAN, Running, Sender, started_broker, until
from halls import asked, service_of

from servoscope.arm.baseline import ArmBaseline
from servoscope.arm.simulation import simulated_arm_loop
from servoscope.core.errors import ConfigError
from servoscope.service.build import build_assets, build_source, check_service_file
from servoscope.service.config import ServiceFile
from servoscope.service.diagnosis_worker import find_due_prognosis
from servoscope.service.sources.block import Block
from servoscope.service.sources.message import InboxMessage

pytestmark = pytest.mark.slow  # minutes of six joints are simulated and diagnosed


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_arm(tmp_path_factory.mktemp("hall"))


def messages(folder: Path) -> list[bytes]:
    """The log as messages of a second each, all joints in each of them; one joint is missing for a moment."""
    loop, table = simulated_arm_loop(), np.genfromtxt(folder / "run.csv", delimiter=",", names=True)
    found = []
    for number, first in enumerate(range(0, table.size, 100)):
        rows = table[first : first + 100]
        columns: dict[str, Any] = {name: rows[column].tolist() for name, column in loop.channels.items()}
        if number == 10:
            columns["elbow.torque"][40:50] = [None] * 10
        content = {"version": 1, "sequence": number, "t0": BEGAN + rows["t"][0], "dt": 0.01, "covariates": columns}
        found.append(json.dumps(content).encode())
    return found


def is_diagnosed(config: Path, blocks: int) -> bool:
    """Whether so many blocks are counted, and all of their diagnoses made."""
    rows = asked(config, "SELECT status FROM checkpoints WHERE asset = 'cell'")
    status = json.loads(rows[0][0]) if rows else {"awaited": [0]}
    return not status["awaited"] and status["counted"]["blocks"] == blocks


def test_messages_of_all_joints_name_the_joint_and_raise_the_alarm(folder: Path, tmp_path: Path) -> None:
    broker = started_broker(tmp_path)
    config = arm_hall(folder, "broker", f'kind = "mqtt"\nhost = "127.0.0.1"\nport = {broker.port}')
    service = service_of(config)
    running = Running(service)
    try:
        until(lambda: service.sources["line"].connected)
        sender = Sender(broker.port)
        for number, message in enumerate(messages(folder), 1):
            sender.send(message, asset="cell")
            if number % 10 == 0:  # as in real time, its diagnoses are made while it works
                until(lambda count=number: is_diagnosed(config, count))
    finally:
        running.end(stop=True)
        broker.stop()
    found = asked(config, "SELECT verdict, t, summary, onset, document FROM diagnoses ORDER BY t")
    assert [row[0] for row in found][:1] == ["healthy"]
    _, _, summary, onset, document = next(row for row in found if row[0] == "fault")
    assert (
        summary.startswith("Fault: friction of elbow. Coulomb friction is 1.")
        and " since 2026-01-01 00:00:4" in summary
    )
    assert onset == pytest.approx(BEGAN + ONSET_S, abs=2.0)
    (fault,) = json.loads(document)["faults"]
    assert fault["name"] == FRICTION and fault["interval"][0] < SIZE < fault["interval"][1]
    sizes = asked(config, f"SELECT value FROM sizes WHERE name = '{FRICTION}'")
    assert sizes and all(value == pytest.approx(SIZE, abs=0.2) for (value,) in sizes)
    coefficients = {name for (name,) in asked(config, "SELECT name FROM sizes WHERE kind = 'coefficient'")}
    assert "elbow.coulomb_friction" in coefficients
    assert asked(config, "SELECT count(*) FROM residuals")[0][0] >= 3
    raised = asked(config, "SELECT t FROM transitions WHERE alarm = 'fault' AND after = 'unacknowledged'")
    assert raised and raised[0][0] > BEGAN + ONSET_S
    status = json.loads(asked(config, "SELECT status FROM checkpoints WHERE asset = 'cell'")[0][0])
    assert status["verdict"] == "fault" and status["about"]["plant"] == "arm" and status["statistic"] > 1.0
    assert "gap" not in status["quality"] and status["counted"]["samples"] == 9000


def test_a_killed_service_asks_for_the_diagnosis_again(folder: Path) -> None:
    config = replayed_arm(folder, "killed")
    asset = build_assets(ServiceFile.load(config))["cell"]
    service_of(config).run()
    first = asked(config, "SELECT verdict, t, summary FROM diagnoses ORDER BY t")
    assert first and first[-1][0] == "fault"
    again = service_of(config)
    state = again.assets["cell"].state
    assert (
        state is not None and state.examination.faults[0]["name"] == FRICTION and state.baseline == asset.machine.hash
    )
    due = find_due_prognosis(state, {FRICTION: 2.0}, 3600.0)
    assert due is not None and (due.fault, due.limit) == (FRICTION, 2.0)
    assert due.since == pytest.approx(BEGAN + ONSET_S, abs=2.0)
    again.run()
    assert asked(config, "SELECT verdict, t, summary FROM diagnoses ORDER BY t") == first


def test_after_a_pause_a_window_is_filled_before_it_is_diagnosed(folder: Path) -> None:
    asset = build_assets(ServiceFile.load(replayed_arm(folder, "paused")))["cell"]

    def pending_after(seconds: range, start: float) -> int:
        for second in seconds:
            t = start + second + 0.01 * np.arange(100)
            asset.process(Block("cell", second, t, *np.zeros((3, 100)), covariates=np.zeros((12, 100))))
        return len(asset.pending_diagnoses)

    whole = pending_after(range(40), BEGAN)
    assert whole in (1, 2)  # the first one comes at the asset's own place in the period
    assert pending_after(range(40, 48), BEGAN + 600.0) == whole
    assert pending_after(range(48, 55), BEGAN + 600.0) == whole + 1
    assert pending_after(range(55, 60), BEGAN - 3600.0) == whole + 1  # a clock that is set back


def test_what_an_arm_cannot_be_is_refused_in_one_line(folder: Path) -> None:
    replay = 'kind = "replay"\nspeed = 0.0'
    rows = 'kind = "mqtt"\nhost = "127.0.0.1"\n[sources.line.payload]\ntopics = ["plant/{asset}"]\ntime = { t = "s" }'
    for source, more, why in (
        (replay, 'files = ["run.csv"]\npoint = "cold"', "an arm has no operating points, leave it out"),
        (
            replay,
            f'files = ["run.csv"]\nlimits = {{ "{FRICTION}" = "tracking" }}',
            "known of loops alone, give a number",
        ),
        (replay, 'files = ["run.csv"]\nlimits = { leakage = 1.5 }', "there is no fault of cell 'leakage'"),
        (rows, "", "depends on base_yaw.position, base_yaw.torque"),
        (rows.replace("{asset}", "{asset}/{signal}"), "", "needs all signals of its machine in one message"),
    ):
        with pytest.raises(ConfigError, match=why):
            check_service_file(ServiceFile.load(arm_hall(folder, "refused", source, more)))
    assert (
        check_service_file(
            ServiceFile.load(
                arm_hall(folder, "taken", replay, f'files = ["run.csv"]\nlimits = {{ "{FRICTION}" = 1.5 }}')
            )
        )
        == []
    )
    baseline = ArmBaseline.load(folder / "arm.json")
    assert baseline is not None and FRICTION in baseline.fault_names


def test_rows_of_a_plant_carry_all_joints(folder: Path) -> None:
    columns = {name: column for name, column in simulated_arm_loop().channels.items()}
    fields = ", ".join(f'"{name}" = "{column}"' for name, column in columns.items())
    source = (
        'kind = "mqtt"\nhost = "127.0.0.1"\n[sources.line.payload]\ntopics = ["plant/{asset}"]\ntime = { t = "s" }\n'
        f'fields = {{ r = "q1", u = "i1", y = "q1", covariates = {{ {fields} }} }}'
    )
    with pytest.raises(ConfigError, match="r, u and y must be different ones"):
        ServiceFile.load(arm_hall(folder, "rows", source))
    config = ServiceFile.load(arm_hall(folder, "rows", source.replace('r = "q1"', 'r = "q2"')))
    decoder = build_source(config, build_assets(config), "line").decoder
    row = {"t": BEGAN, **{column: float(k) for k, column in enumerate(columns.values())}}
    content = decoder.decode(InboxMessage("plant/cell", json.dumps(row).encode(), 0.0))
    assert content.complete and [value for _, _, value in content.values["cell"]][3:] == list(map(float, range(12)))
