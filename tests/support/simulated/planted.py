"""Faults that are planted in the service on purpose: the world has to find each of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any

from servoscope.service import notifications
from servoscope.service import service as service_module
from servoscope.service.actions import transition_entries
from servoscope.service.assets import asset as asset_module
from servoscope.service.assets.alarms import AssetAlarms
from servoscope.service.assets.asset import Asset
from servoscope.service.assets.groups import AssetGroups
from servoscope.service.assets.reception import ReceptionClock
from servoscope.service.assets.records import BlockContinuity, check_continuity
from servoscope.service.mqtt.source import MqttTransport
from servoscope.service.sources.inbox import Inbox
from servoscope.service.store import Batch
from servoscope.service.store.store import Store
from servoscope.service.writer import StoreWriter
from simulated.clock import in_place

_take_block, _process, _write, _add, _resume, _confirm, _begin = (
    Inbox._take_block,
    AssetGroups.process,
    Store.write,
    StoreWriter.add,
    Asset.resume,
    MqttTransport.confirm,
    AssetAlarms.begin,
)


def _early(inbox: Inbox, block: Any, receipt: Any) -> None:
    before = receipt.holders
    _take_block(inbox, block, receipt)
    receipt.holders = before


def _swapped(groups: AssetGroups, blocks: Iterable[Any], *given: Any) -> Any:
    found = list(blocks)
    for i in range(len(found) - 1):
        if found[i].asset == found[i + 1].asset:
            found[i], found[i + 1] = found[i + 1], found[i]
            break
    return _process(groups, found, *given)


def _states_first(store: Store, batch: Batch, owner: str, commit: int) -> Any:
    states = Batch(checkpoints=batch.checkpoints)
    _write(store, states, owner, commit - 1)
    return _write(store, batch, owner, commit)


def _lacking(writer: StoreWriter, owner: str, rows: Iterable[Any]) -> None:
    _add(writer, owner, [row for row in rows if row.table != "residuals" or row.values["number"] % 4])


def _outbox_later(writer: StoreWriter, owner: str, rows: Iterable[Any]) -> None:
    given, kept = list(rows), getattr(writer, "_kept", [])
    writer._kept = [row for row in given if row.table == "outbox"]  # type: ignore[attr-defined]
    if kept:
        _add(writer, owner, kept)
    _add(writer, owner, [row for row in given if row.table != "outbox"])


def _any_connection(transport: MqttTransport, delivery: Any) -> None:
    transport._client.ack(delivery.mid, delivery.qos)


def _twice(counted: Any, block: Any, latest: float) -> BlockContinuity | None:
    if counted is not None and block.sequence == counted.sequence:
        return BlockContinuity(0, False)
    return check_continuity(counted, block, latest)


def _two_keys(*given: Any) -> Any:
    entries = transition_entries(*given)
    return (*entries, *(replace(entry, key=entry.key[::-1]) for entry in entries))


def _no_look(store: Store, owner: str) -> int:
    return 0 if getattr(store, "_looked", False) else _first_look(store, owner)


_last_commit = Store.last_commit


def _first_look(store: Store, owner: str) -> int:
    store._looked = True  # type: ignore[attr-defined]
    return _last_commit(store, owner)


def _nothing(*_: Any, **__: Any) -> None:
    pass


PLANTED: dict[str, Callable[[], AbstractContextManager[None]]] = {
    "acknowledges before it has stored": lambda: in_place((Inbox, "_take_block", _early)),
    "forgets a row": lambda: in_place((StoreWriter, "add", _lacking)),
    "swaps two blocks": lambda: in_place((AssetGroups, "process", _swapped)),
    "stores states before what led to them": lambda: in_place((Store, "write", _states_first)),
    "sends a webhook under two keys": lambda: in_place((notifications.actions, "transition_entries", _two_keys)),
    "stores the outbox with a later commit": lambda: in_place((StoreWriter, "add", _outbox_later)),
    "writes again without a look at what is there": lambda: in_place((Store, "last_commit", _no_look)),
    "acknowledges in a later connection": lambda: in_place((MqttTransport, "_acknowledge", _any_connection)),
    "counts a repetition": lambda: in_place((asset_module, "check_continuity", _twice)),
    "does not tell silence": lambda: in_place((ReceptionClock, "advance", _nothing)),
    "takes more blocks than it has room for": lambda: in_place(
        (StoreWriter, "free", property(lambda writer: writer.capacity))
    ),
    "forgets blocks behind the last state": lambda: in_place(
        (Asset, "resume", lambda asset, *given: _resume(asset, *given)[:0])
    ),
    "forgets alarms at a restart": lambda: in_place(
        (AssetAlarms, "begin", lambda alarms, name, t, _: _begin(alarms, name, t, {}))
    ),
    "confirms one block too many": lambda: in_place(
        (MqttTransport, "confirm", lambda transport, name, *at: _confirm(transport, name, at[0], at[1] + 1))
    ),
    "does not take a new baseline": lambda: in_place((service_module.Service, "reload", _nothing)),
    "forgets a diagnosis when a baseline is relearned": lambda: in_place((asset_module, "owed_rows", lambda _: [])),
}
