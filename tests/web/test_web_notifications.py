"""A test of each place where notifications go: asked for on a page, sent by the service as alarms are, once."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from pages_context import open_context
from test_web_uploads import ask

from servoscope.service.access import WebSettings
from servoscope.service.actions import ActionSettings, OutboxEntry, deliver
from servoscope.service.clock import SteadyClock
from servoscope.service.housekeeping import Housekeeping
from servoscope.service.notifications import Notifier
from servoscope.service.store import Batch
from servoscope.web.dependencies import Context

TOLERANCE = {
    "mode": "execute", "sink": "plc", "assets": ["press"], "fault": "pump", "quantity": "k", "kind": "gain",
    "nominal": 20.0, "exponent": -1.0, "min": 15.0, "max": 28.0, "max_step": 2.0,
}  # fmt: skip


@pytest.fixture
def context(tmp_path: Path) -> Iterator[Context]:
    tables = {
        "webhook": {"desk": {"url": "http://127.0.0.1:9/secret"}},
        "command": {"plc": {"argv": ["write"]}},
        "email": {"shift": {"host": "mail", "sender": "a@b", "to": ["c@d"]}},
        "tolerance": {"softer": TOLERANCE},
    }
    service = SimpleNamespace(workers=1)
    config: Any = SimpleNamespace(
        name="hall", actions=ActionSettings.model_validate(tables), service=service, assets={}
    )
    with open_context(tmp_path, WebSettings()) as opened:
        yield dataclasses.replace(opened, config=config)


def test_a_test_goes_the_way_of_an_alarm_and_is_tried_once(context: Context) -> None:
    listed, asked, unknown, refused = ask(
        context,
        ("GET", "/notifications", None),
        ("POST", "/notifications/desk/test", None),
        ("POST", "/notifications/nobody/test", None),
        ("POST", "/notifications/plc/test", None),
    )
    rows = {one["name"]: one for one in listed.json()["outlets"]}
    assert [rows[name]["target"] for name in ("desk", "plc", "shift")] == ["http://127.0.0.1:9", "write", "c@d"]
    assert [asked.status_code, unknown.status_code, refused.status_code] == [202, 404, 409]
    assert rows["desk"]["last"] is None and not rows["plc"]["may_test"]
    (command,) = context.store.pending_commands()
    assert (command["asset"], command["alarm"], command["command"]) == ("hall", "desk", "test")
    # what the service makes of it
    assert context.config is not None
    batch, settings = Batch(), context.config.actions
    added: dict[str, list[Any]] = {}
    writer = SimpleNamespace(batch=batch, add=lambda owner, rows: added.setdefault(owner, []).extend(rows))
    notifier = Notifier("hall", SimpleNamespace(), settings)  # type: ignore[arg-type]
    service: Any = SimpleNamespace(
        store=context.store, notifier=notifier, writer=writer, assets={}, clock=SteadyClock()
    )
    Housekeeping(service, service)._execute_commands()
    outbox, audit = added["hall"]
    assert (
        audit.table == "audit" and audit.values["who"] == "local" and batch.outcomes[command["id"]]["outcome"] == "done"
    )
    entry = OutboxEntry(**{key: value for key, value in outbox.values.items() if key != "outcome"})
    assert entry.event["cause"] == "Test, asked for by local: notifications arrive here"
    attempt = deliver(entry, settings, 1.7e9)
    assert not attempt.delivered and attempt.retry_entry is None  # nobody is there, and nobody waits for it
    batch.rows["outbox"] = [outbox.values | {"due": None, "attempts": 1, "outcome": attempt.detail}]
    context.store.write(batch, "hall", 1)
    (again,) = ask(context, ("GET", "/notifications", None))
    (last,) = (one["last"] for one in again.json()["outlets"] if one["name"] == "desk")
    assert last["event"] == "test" and "refused" in last["outcome"].lower()
