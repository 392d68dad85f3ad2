"""The machine's clock is set while a service runs: no date of an alarm changes, and what is to be sent is sent."""

from __future__ import annotations

import itertools
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import halls
import pytest
from halls import RESULTS, asked, hall, service_of

from servoscope.service.actions import ActionSettings
from servoscope.service.alarms import AlarmSettings
from servoscope.service.clock import SteadyClock
from servoscope.service.housekeeping import Housekeeping
from servoscope.service.notifications import Notifier

TIME = time.time
HOOK = '[actions.command.tool]\nargv = ["false"]\n[actions.retry]\nfirst_s = 0.1\ngive_up_s = 600.0'


class MachineClock:
    """A clock that somebody sets."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.offset_s = 0.0
        monkeypatch.setattr(time, "time", lambda: TIME() + self.offset_s)


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> MachineClock:
    return MachineClock(monkeypatch)


def test_a_service_s_own_alarm_keeps_its_dates(machine: MachineClock) -> None:
    alarms = AlarmSettings.model_validate({"buffering": {"on_delay_s": 1000.0, "off_delay_s": 0.0}})
    writer = SimpleNamespace(fill_ratio=1.0, add=lambda owner, rows: None)
    notifier = Notifier("hall", alarms, ActionSettings())
    service: Any = SimpleNamespace(writer=writer, notifier=notifier, assets={}, troubles={}, clock=SteadyClock())
    housekeeping, start = Housekeeping(service, service), TIME()
    for machine.offset_s in (0.0, 7200.0, -7200.0):
        housekeeping._update_service_alarms()
    alarm = notifier.status["alarms"]["buffering"]
    assert alarm["state"] == "normal"  # two hours ahead would have ended the delay
    assert alarm["since"] == pytest.approx(start, abs=60.0)


@pytest.mark.slow
def test_rows_are_the_same_and_deliveries_go_on_while_the_clock_is_set(
    tmp_path: Path, machine: MachineClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    halls.files(tmp_path)
    quiet, disturbed = (hall(tmp_path, name, more=HOOK) for name in ("quiet", "disturbed"))
    service_of(quiet).run()
    start, steps = TIME(), itertools.cycle((-86400.0, 0.0, 86400.0, -3.0, 3.0))
    service = service_of(disturbed)
    once = service._run_once

    def run_once() -> None:
        machine.offset_s = next(steps)
        once()

    monkeypatch.setattr(service, "_run_once", run_once)
    service.run()
    machine.offset_s = 0.0
    for name, query in RESULTS.items():
        assert asked(disturbed, query) == asked(quiet, query), name
    rows = asked(disturbed, "SELECT created, due FROM outbox")
    assert rows, "the leak is announced"
    for created, due in rows:
        assert start - 60.0 < created < TIME() + 60.0
        assert due is not None, "a step ahead gave it up"
        assert due < TIME() + 700.0


def test_the_clock_passes_with_time(machine: MachineClock) -> None:
    clock = SteadyClock()
    before = clock.now()
    machine.offset_s = -1000.0
    time.sleep(0.01)
    assert 0.009 < clock.now() - before < 60.0
