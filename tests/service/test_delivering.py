"""Deliveries beside each other: a sink that takes its time keeps nobody else waiting."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from servoscope.service.actions import ActionSettings, OutboxEntry, deliver
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
    assert [(one.entry.sink, one.delivered) for one in heard] == [("quick", True)]
    store.close()


@contextmanager
def dripping(every_s: float) -> Iterator[str]:
    """Yield the address of a receiver that answers byte by byte, and never to the end."""
    over = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def drip() -> None:
            connection, _ = listener.accept()
            with connection, suppress(OSError):
                connection.sendall(b"HTTP/1.1 200 OK\r\nX-Slow: ")
                while not over.wait(every_s):
                    connection.sendall(b"x")

        thread = threading.Thread(target=drip)
        thread.start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}/hook"
        over.set()
        thread.join()


def test_a_try_has_one_deadline_however_slowly_the_receiver_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with dripping(0.05) as url:
        settings = ActionSettings.model_validate({"webhook": {"desk": {"url": url, "timeout_s": 0.5}}})
        begin = time.monotonic()
        result = deliver(OutboxEntry("key", "desk", {}, created=0.0, due=0.0), settings, 1.0)
        assert 0.5 <= time.monotonic() - begin < 10.0  # each byte comes in time, and the head of an answer has 64 kB
    assert not result.delivered and "timed out after 0.5 s" in result.detail
