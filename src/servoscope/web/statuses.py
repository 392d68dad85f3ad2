"""The statuses in a store as records, and the columns of all of them by which a fleet is put in order."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, get_args

import msgspec
import sqlalchemy as sa

from servoscope.service.alarms import FAULT_ALARM, PRIORITIES, LifecycleState, Ne107, Priority
from servoscope.service.alarms.records import UNACKNOWLEDGED_STATES
from servoscope.service.assets.status import AssetStatus, ServiceStatus
from servoscope.service.store import Store, tables

FRESH_S = 0.5  # for so long, columns that were read serve others too
MAX_NAMES = 500  # that a query asks for by name; of more, all are read
MAX_EXCESS = 3.9  # of a statistic over its limit, in the severity: less than one step of alarm priority
NE107_RANKS: tuple[Ne107, ...] = get_args(Ne107)
_COLUMNS = tables.checkpoints.c
_TEXT = sa.cast(_COLUMNS.status, sa.Text)  # records are made of it at once, a third of the time of values in between


class StatusEntry(NamedTuple):
    """The newest status of an asset, or of a service."""

    name: str
    sequence: int
    at: float  # when it was stored [UTC s]
    status: AssetStatus | ServiceStatus

    @property
    def row_number(self) -> int:
        """The number of its last row in the store."""
        return self.status.position.rows if isinstance(self.status, AssetStatus) else self.sequence


class _Alarm(msgspec.Struct):
    state: LifecycleState
    priority: Priority | None = None


class _About(msgspec.Struct):
    group: str = ""
    coarse: tuple[object, ...] | None = None


class _Columns(msgspec.Struct):
    """What of a status puts its asset in order; of versions that had less of it, too."""

    verdict: str = ""
    ne107: Ne107 = "good"
    statistic: float | None = None
    level: float | None = None
    alarms: dict[str, _Alarm] = {}
    about: _About = msgspec.field(default_factory=_About)
    learning: dict[str, object] | None = None
    repaired: float | None = None
    service: bool = False


_decoder = msgspec.json.Decoder(_Columns)


class FleetLine(NamedTuple):
    """An asset's columns: negative severity and name, by which it is sorted, then group and verdict.

    `is_plain`: whether it is healthy, and its headline says no more than that.
    """

    urgency: float
    asset: str
    group: str
    verdict: str
    is_plain: bool


@dataclass
class FleetTable:
    """The columns of all assets, the most urgent first, and the names of the services."""

    store: Store
    lines: list[FleetLine] = field(default_factory=list)
    services: list[str] = field(default_factory=list)
    _read_at: float = -FRESH_S
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def read(self, *, anew: bool) -> None:
        """Read the store, unless that was done just now; `anew`: in any case."""
        with self._lock:
            if not anew and time.monotonic() - self._read_at < FRESH_S:
                return
            stored = [
                (name, _decoder.decode(text))
                for name, text in self.store.fetch_tuples(sa.select(_COLUMNS.asset, _TEXT))
            ]
            self.lines = sorted(
                FleetLine(-severity(status), name, status.about.group, status.verdict, _is_plain(status))
                for name, status in stored
                if not status.service
            )
            self.services = sorted(name for name, status in stored if status.service)
            self._read_at = time.monotonic()


def _is_plain(status: _Columns) -> bool:
    noted = status.learning is not None or status.repaired is not None or status.about.coarse is not None
    return status.verdict == "healthy" and FAULT_ALARM not in status.alarms and not noted


def severity(status: AssetStatus | _Columns) -> float:
    """Return how urgent an asset is: a fault, then the NE 107 status, then unacknowledged alarms, then statistics."""
    fault = 100.0 if status.verdict == "fault" else 0.0
    waiting = max(
        (alarm_rank(a.priority) for a in status.alarms.values() if a.state in UNACKNOWLEDGED_STATES), default=0
    )
    excess = min(max(status.statistic or 0.0, status.level or 0.0), MAX_EXCESS)
    return fault + 20.0 * NE107_RANKS.index(status.ne107) + 4.0 * waiting + round(excess, 3)


def alarm_rank(priority: Priority | None) -> int:
    """Return how urgent the priority of an alarm is, from 1; 0 without one."""
    return PRIORITIES.index(priority) + 1 if priority is not None else 0


def read_statuses(store: Store, names: Sequence[str] | None = None) -> dict[str, StatusEntry]:
    """Return the newest statuses; of all assets and services where no names are given."""
    query = sa.select(_COLUMNS.asset, _COLUMNS.sequence, _COLUMNS.at, _TEXT).order_by(_COLUMNS.asset)
    if names is not None and len(names) <= MAX_NAMES:
        query = query.where(_COLUMNS.asset.in_(names))
    wanted = None if names is None else set(names)
    return {
        name: StatusEntry(name, sequence, at, _parse_status(text))
        for name, sequence, at, text in store.fetch_tuples(query)
        if wanted is None or name in wanted
    }


def _parse_status(text: str) -> AssetStatus | ServiceStatus:
    return (ServiceStatus if _decoder.decode(text).service else AssetStatus).model_validate_json(text)


def asset_statuses(stored: Iterable[StatusEntry]) -> Iterator[tuple[StatusEntry, AssetStatus]]:
    """Yield those of assets."""
    return (
        (status_entry, status_entry.status) for status_entry in stored if isinstance(status_entry.status, AssetStatus)
    )


def service_statuses(stored: Iterable[StatusEntry]) -> Iterator[tuple[StatusEntry, ServiceStatus]]:
    """Yield those of services."""
    return (
        (status_entry, status_entry.status) for status_entry in stored if isinstance(status_entry.status, ServiceStatus)
    )
