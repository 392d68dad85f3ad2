"""Weeks of a machine through a service: a repair is learned, another week is healthy afterwards, a fault is found."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import halls
from axis_logs import LOOP, axis
from brokers import Running, until
from commands import run
from halls import asked

import servoscope as ss
from servoscope.service.assets.status import AssetStatus
from servoscope.service.store import Store
from servoscope.signals.writers import write_recording

FIRST_WEEK = datetime(2026, 1, 5, tzinfo=UTC)
SECONDS = 60.0
MOTOR, DAMAGED = 1.3, 1.6  # u over that of the first weeks


def test_weeks_with_a_repair_have_no_alarm_but_that_of_the_fault(tmp_path: Path) -> None:
    ss.learn(LOOP, [axis(i, seconds=SECONDS) for i in range(4)]).save(tmp_path / "axis.json")
    config = tmp_path / "hall.toml"
    (tmp_path / "share").mkdir()
    config.write_text(
        'name = "hall"\n[service]\nlisten = ""\ncommit_every_s = 0.05\nlog = "error"\n[store]\nurl = "history.sqlite"\n'
        "[diagnosis]\nwindow_s = 50.0\nkeep_s = 60.0\nevery_s = 20.0\nafter_s = 1.0\n[quality]\nsilent_s = 1000.0\n"
        '[sources.share]\nkind = "folder"\npath = "share"\nmatch = "{asset}_{time}.csv"\ncomplete_after_s = 0.1\n'
        'poll_s = 0.05\ninterval_s = 1e6\n[assets.axis]\nbaseline = "axis.json"\nsource = "share"\n'
    )
    running = Running(halls.service_of(config))
    store = Store.open("history.sqlite", tmp_path)

    def status() -> AssetStatus:
        return AssetStatus.model_validate(store.statuses(["axis"])["axis"]["status"])

    def follow(week: int, seed: int, times: float, reached: Callable[[AssetStatus], bool]) -> AssetStatus:
        """Drop the log of a week, and wait until the service has come to its end and to a verdict."""
        recording, at = axis(seed, seconds=SECONDS), FIRST_WEEK + timedelta(weeks=week)
        path = tmp_path / f"axis_{at:%Y%m%d_%H%M%S}.csv"
        write_recording(path, ss.Recording(**{**vars(recording), "u": times * recording.u}))
        path.rename(tmp_path / "share" / path.name)
        end = at.timestamp() + SECONDS - 2.0
        until(lambda: store.statuses(["axis"]) and status().position.t >= end and reached(status()), 120.0)
        return status()

    def alarms() -> list[tuple[str]]:
        return asked(config, "SELECT t FROM transitions WHERE alarm = 'fault' AND after = 'unacknowledged'")

    try:
        for week in (0, 1):
            follow(week, 10 + week, 1.0, lambda now: now.verdict == "healthy")
        assert not alarms()
        changed = follow(2, 20, MOTOR, lambda now: now.verdict == "fault")
        assert len(alarms()) == 1
        note = {"t": changed.position.t, "text": "motor exchanged", "anew": True, "kind": "repair"}
        store.add_audit("otto", "axis", "note", note)
        learning = follow(3, 21, MOTOR, lambda now: now.learning is not None)
        assert " Learning after repair, " in learning.summary
        taken = run("relearn", config, "axis", "--why", "motor exchanged", "--yes")
        assert taken.code == 0, taken.err
        renewed = ss.Baseline.load(tmp_path / "axis.axis.json")
        assert renewed.scatter.carried_from == 4
        until(lambda: status().metadata.baseline == renewed.hash, 60.0)  # else half of the next week is of the old one
        for week in (4, 5, 6):
            follow(week, 10 + week, MOTOR, lambda now: now.verdict == "healthy")
        assert len(alarms()) == 1
        found = follow(7, 30, MOTOR * DAMAGED, lambda now: now.verdict == "fault")
        assert len(alarms()) == 2 and found.learning is None
    finally:
        running.end(stop=True)
        store.close()
