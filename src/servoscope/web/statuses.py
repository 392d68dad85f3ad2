"""The statuses in a store as records."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from servoscope.service.assets.status import AssetStatus, ServiceStatus, read_status
from servoscope.service.store import Store


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


def read_statuses(store: Store, names: Sequence[str] | None = None) -> dict[str, StatusEntry]:
    """Return the newest statuses; of all assets and services where no names are given."""
    return {
        name: StatusEntry(name, row["sequence"], row["at"], read_status(row["status"]))
        for name, row in store.statuses(names).items()
    }


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
