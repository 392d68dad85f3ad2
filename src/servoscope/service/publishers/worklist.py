"""What is to be done on all machines, as a list that a maintenance system (CMMS) imports: CSV and JSON."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

from servoscope.service.alarms.settings import PRIORITIES
from servoscope.service.assets.status import AssetStatus
from servoscope.service.assets.work_items import WorkItem, work_items
from servoscope.service.publishers.files import FilesPublisher, FilesSettings

NAME = "worklist"


class WorklistSettings(FilesSettings):
    """An outlet of kind ``worklist``: the files ``worklist.csv`` and ``worklist.json``."""

    kind: Literal["worklist"]

    def create(self, name: str, folder: Path) -> WorkListPublisher:
        """Return the publisher."""
        return WorkListPublisher(folder / self.path, self.every_s)


class WorkListPublisher(FilesPublisher):
    """Keeps the list of all assets."""

    def __init__(self, folder: Path, every_s: float) -> None:
        super().__init__(folder, every_s)
        self._items: dict[str, list[WorkItem]] = {}

    def render(self, changed: Mapping[str, AssetStatus]) -> Mapping[str, bytes]:
        """Return the list in both forms."""
        self._items |= {name: work_items(name, status) for name, status in changed.items()}
        items = [item for of_asset in self._items.values() for item in of_asset]
        items.sort(key=lambda item: (-PRIORITIES.index(item.urgency), item.since, item.key))
        document = [item._asdict() for item in items]
        text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False)
        return {f"{NAME}.json": text.encode(), f"{NAME}.csv": to_csv(items).encode()}


def to_csv(items: Iterable[WorkItem]) -> str:
    """Return the list after RFC 4180: a head, and a row for each item."""
    text = io.StringIO()
    table = csv.writer(text)
    table.writerow(WorkItem._fields)
    for item in items:
        cells = item._asdict() | {"check": "; ".join(item.check)}
        table.writerow([_cell(value) for value in cells.values()])
    return text.getvalue()


def _cell(value: object) -> object:
    """Return a value for a cell; a text must not begin like a formula, for spreadsheets execute it."""
    return f"'{value}" if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r")) else value
