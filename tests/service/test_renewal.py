"""A service whose asset is repaired: samples kept, a preview, another baseline in force, and one step back."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from axis_logs import REPAIRED, repaired_axis
from commands import one_line, run

import servoscope as ss
from servoscope.service import renewal
from servoscope.service.assets.status import AssetStatus
from servoscope.service.build import build_components
from servoscope.service.config import ServiceFile
from servoscope.service.service import Service
from servoscope.service.store import Store
from servoscope.service.store.series import read_notes

TIMEOUT_S = 120.0


@pytest.fixture
def hall(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A service that follows an axis whose motor was exchanged."""
    # commands of this process change stderr while the service writes its log to it
    monkeypatch.setattr(logging, "raiseExceptions", False)
    config = repaired_axis(tmp_path)
    settings = ServiceFile.load(config)
    service = Service(settings, build_components(settings))
    thread = threading.Thread(target=service.run)
    thread.start()
    yield config
    service.stop()
    thread.join(TIMEOUT_S)


def test_a_repair_is_learned_by_a_running_service_and_one_step_leads_back(hall: Path) -> None:
    settings, store = ServiceFile.load(hall), Store.open("history.sqlite", hall.parent)

    def status() -> AssetStatus:
        return AssetStatus.model_validate(store.statuses(["axis"])["axis"]["status"])

    def wait(reached: Callable[[AssetStatus], bool]) -> AssetStatus:
        end = time.monotonic() + TIMEOUT_S
        while not reached(status()):
            assert time.monotonic() < end, status()
            time.sleep(0.2)
        return status()

    while not store.statuses(["axis"]):  # its first commit
        time.sleep(0.2)
    wait(lambda now: now.verdict == "fault" and now.position.samples > 5000)
    one_line(run("relearn", hall, "axis", "--yes"), "not healthy", "--accept-change")  # nobody has noted a repair
    one_line(run("relearn", hall, "axis", "--since", "2100-01-01"), "no samples", "keep_s")
    one_line(run("relearn", hall, "axis", "--back"), "never relearned")
    t = status().position.t
    store.add_audit("otto", "axis", "note", {"t": t, "text": "motor exchanged", "anew": True, "kind": "repair"})
    now = wait(lambda now: now.position.t > t + 100.0)
    learned = ss.Baseline.load(settings.baseline_file("axis"))
    progress = renewal.learning_progress(settings, store, "axis", now, learned)
    assert (progress.after, progress.since, progress.revision) == ("repair", t, 1)
    assert 100.0 < progress.learned_s <= progress.needed_s == 200.0
    assert now.learning is not None and now.learning.after == "repair" and now.verdict == "fault"
    assert " Learning after repair, " in now.summary and " of 3.3 min; until then the earlier " in now.summary
    store.add_audit("otto", "axis", "note", {"t": t, "text": "lighter motor", "anew": False, "kind": "confirmed"})
    confirmed = wait(lambda now: now.learning is not None and now.learning.confirmed)
    assert confirmed.verdict == "undetermined" and "Confirmed as no fault: Fault" in confirmed.summary
    preview = json.loads(run("relearn", hall, "axis", "--json").out)
    moves = {row["name"]: row["change"] for row in preview["points"][0]["moves"]}
    assert moves["inertia"] == pytest.approx(REPAIRED - 1.0, abs=0.1)
    assert preview["judged"]["values"] >= 1 and not settings.relearned_file("axis").exists()
    taken = run("relearn", hall, "axis", "--why", "motor exchanged", "--yes", "--who", "otto")
    assert taken.code == 0 and "axis.axis.json" in taken.out
    assert ss.Baseline.load(hall.parent / "axis.json").revision.number == 1  # the service file's stays
    note = read_notes(store, "axis")[-1]
    assert (note["who"], note["kind"], note["anew"]) == ("otto", "baseline", True) and "motor exchanged" in note["text"]
    renewed = ss.Baseline.load(settings.baseline_file("axis"))
    now = wait(lambda now: now.metadata.baseline == renewed.hash and now.verdict == "healthy")
    assert now.learning is None and not store.pending_commands()
    # its alarm goes on: the condition is gone, and nobody has acknowledged or reset it
    now = wait(lambda now: not now.alarms["fault"].active)
    assert now.alarms["fault"].state == "latched_unacknowledged"
    assert renewal.learning_progress(settings, store, "axis", now, renewed).can_go_back
    # a further healthy stretch joins the one that was kept with the history
    added = json.loads(run("relearn", hall, "axis", "--why", "run in", "--json").out)
    assert added["revision"]["kind"] == "healthy" and added["revision"]["reference"] == 2
    assert run("relearn", hall, "axis", "--back", "--why", "not run in").code == 0
    wait(lambda now: now.metadata.baseline == ss.Baseline.load(hall.parent / "axis.json").hash)
    store.close()
