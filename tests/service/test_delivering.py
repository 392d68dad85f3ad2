"""Deliveries beside each other: a sink that takes its time keeps nobody else waiting."""

from __future__ import annotations

import time
from pathlib import Path

from servoscope.service.actions import ActionSettings
from servoscope.service.actions.dispatcher import OutboxDispatcher
from servoscope.service.clock import SteadyClock
from servoscope.service.store import Batch, Store


def test_a_slow_sink_delays_no_other(tmp_path: Path) -> None:
    store = Store.open(str(tmp_path / "s.sqlite"), write=True)
    made = Batch()
    made.rows["outbox"] = [
        {
            "key": f"{n}",
            "sink": sink,
            "event": {"service": "hall"},
            "created": 0.0,
            "due": n,
            "attempts": 0,
            "outcome": "",
        }
        for n, sink in enumerate(("slow", "slow", "quick"))
    ]
    store.write(made, "hall", 1)
    argv = {"slow": {"argv": ["sleep", "5"]}, "quick": {"argv": ["true"]}}
    dispatcher = OutboxDispatcher(store, "hall", ActionSettings.model_validate({"command": argv}), SteadyClock())
    dispatcher.start()
    heard, deadline = [], time.monotonic() + 30.0
    while not heard and time.monotonic() < deadline:
        time.sleep(0.05)
        heard = dispatcher.take_attempts()
    dispatcher.stop()
    assert [(one.sink, one.delivered) for one in heard] == [("quick", True)]
    store.close()
