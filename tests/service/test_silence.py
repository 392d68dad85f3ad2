"""When silence is announced, by a clock that the test moves on: in time, however long a turn takes."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

import halls
import numpy as np
import pytest

from servoscope.service import service as service_module
from servoscope.service.assets.reception import MAX_TURN_S
from servoscope.service.build import build_components
from servoscope.service.config import ServiceFile
from servoscope.service.service import Service
from servoscope.service.sources.block import Block, ResumePosition
from servoscope.service.sources.inbox import Inbox
from servoscope.service.sources.message import BlockDecoder, InboxMessage, Transport

BLOCK_S = 0.5
UNHEARD_S, SILENT_S = 30.0, 20.0  # until it is announced, by the settings that hold without others
TOLERANCE_S = 2.0


class Sensor(Transport):
    """Blocks of the asset press, each when it is complete, until the sensor falls silent; others never come."""

    def __init__(self, simulation: Simulation, silent_from: float) -> None:
        super().__init__()
        self._simulation, self.silent_from, self._blocks = simulation, silent_from, 0

    def open(self, resume: Mapping[str, ResumePosition]) -> None:
        pass

    def receive(self, most: int) -> list[InboxMessage]:
        end = min(self._simulation.elapsed_s, self.silent_from)
        found = list[InboxMessage]()
        while (self._blocks + 1) * BLOCK_S <= end and len(found) < most:
            k, recording = self._blocks, halls.recorded(1)
            n = round(BLOCK_S * 100.0)
            rows = slice(n * k % 5000, n * k % 5000 + n)
            t = self._simulation.began + (n * k + np.arange(n)) / 100.0
            block = Block("press", k, t, recording.r[rows], recording.u[rows], recording.y[rows])
            found.append(InboxMessage("press", block, 0.0))
            self._blocks += 1
        return found

    def close(self) -> None:
        pass


class Simulation:
    """A service in the time of a clock of its own; `silent_from`: when the sensor of press falls silent [s]."""

    def __init__(self, folder: Path, silent_from: float) -> None:
        halls.files(folder)
        self.elapsed_s = 0.0
        config = ServiceFile.load(halls.hall(folder, "hall"))
        components = build_components(config)
        components.sources["line"] = Inbox(Sensor(self, silent_from), BlockDecoder(), {})
        self.began = time.time()  # lift waits from about then
        self.service = Service(config, components, lambda: self.elapsed_s)

    def run(self, until_s: float, turn_s: float) -> None:
        """Turn until then; each takes so long [s]."""
        while self.elapsed_s < until_s:
            self.elapsed_s += turn_s
            self.service._run_once()

    def announced(self, asset: str, alarm: str) -> tuple[float, float] | None:
        """Return when an alarm was raised by its date, and now, both in s from the beginning; None: it was not."""
        state = self.service.assets[asset].state
        assert state is not None
        found = state.alarms_now[alarm]
        return (found.since - self.began, self.elapsed_s) if found.state.value == "unacknowledged" else None

    def first(self, asset: str, alarm: str, turn_s: float) -> tuple[float, float]:
        """Turn until an alarm is announced, for a minute at most."""
        end = self.elapsed_s + 60.0
        while (found := self.announced(asset, alarm)) is None:
            assert self.elapsed_s < end, f"{alarm} of {asset} is not announced"
            self.run(self.elapsed_s + turn_s, turn_s)
        return found


@pytest.mark.parametrize("turn_s", [0.05, service_module.MIN_TURN_S, 2.0])
def test_silence_is_announced_and_dated_in_time_however_long_a_turn_takes(tmp_path: Path, turn_s: float) -> None:
    simulation = Simulation(tmp_path, silent_from=12.0)
    date, now = simulation.first("lift", "reception", turn_s)  # it has never come
    assert UNHEARD_S <= now <= UNHEARD_S + TOLERANCE_S and abs(date - UNHEARD_S) <= TOLERANCE_S
    end = 12.0 + SILENT_S  # press has, until then
    date, now = simulation.first("press", "data_quality", turn_s)
    assert end <= now <= end + TOLERANCE_S and abs(date - end) <= TOLERANCE_S


def test_what_was_not_listened_to_is_no_silence(tmp_path: Path) -> None:
    simulation = Simulation(tmp_path, silent_from=1000.0)
    simulation.run(5.0, 0.25)
    sensor = simulation.service.sources["line"].transport
    assert isinstance(sensor, Sensor)
    simulation.elapsed_s += 600.0  # the process was suspended, and its connections have nothing yet
    sensor.silent_from = simulation.elapsed_s - 600.0
    simulation.run(simulation.elapsed_s + 4.0, 0.25)
    assert simulation.service.assets["press"].reception.state == "followed"
    assert simulation.announced("press", "data_quality") is None and simulation.announced("lift", "reception") is None


def test_blocks_that_wait_for_the_next_turn_are_no_silence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service_module, "MAX_BLOCKS_PER_POLL", 1)
    simulation = Simulation(tmp_path, silent_from=1000.0)
    simulation.run(40.0, 2.0)  # four blocks come in a turn, and one is followed
    assert simulation.service._is_behind and simulation.service._listening.seconds == 2.0
    monkeypatch.setattr(service_module, "MAX_BLOCKS_PER_POLL", 1024)
    simulation.run(44.0, 2.0)
    assert simulation.service._listening.seconds <= 2.0 + 2.0 * MAX_TURN_S
