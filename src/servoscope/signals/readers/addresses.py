"""Recordings that are no files: tables of databases and lakes, by addresses such as ``sql:plant/press?asset=P07``."""

from __future__ import annotations

import operator
import os
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

from servoscope.core.errors import RecordingError
from servoscope.models.loop import TextLayout
from servoscope.signals.readers.table import TableFile

Comparison = Callable[[Any, Any], Any]

ENTRY_POINTS = "servoscope.tables"  # name is what an address begins with, object a function from address to table
BUILT_IN = tuple(  # written like the entry points of other packages, and loaded like them
    EntryPoint(name, f"servoscope.signals.readers.{value}", ENTRY_POINTS)
    for name, value in (
        ("join", "concatenation:open_concatenation"),
        ("mqtt", "topic:open_topic"),
        ("sql", "sql:open_sql"),
        ("influx", "influx:open_influx"),
        ("delta", "lake_tables:open_delta"),
        ("iceberg", "lake_tables:open_iceberg"),
    )
)
TIME_COLUMNS = ("time", "t", "timestamp", "ts", "datetime", "_time")  # in whose order rows are read, the first there is


@dataclass(frozen=True)
class TableAddress:
    """What an address says."""

    text: str  # as it was given; it holds no secret
    place: str  # connection and table, or folder of the table
    equal: dict[str, str]  # rows to take: column -> value
    since: str | None = None  # since, until: rows to take, by the time column: from here on, and before
    until: str | None = None
    time: str | None = None  # the time column, where it is called otherwise
    text_layout: TextLayout | None = None  # what the user says of the layout of text files

    def time_column(self, columns: Sequence[str]) -> str | None:
        """Return the column in whose order the rows are; None where there is none.

        Raises RecordingError if a column that the address names is missing.
        """
        for name in (*self.equal, *([self.time] if self.time else ())):
            if name not in columns:
                raise RecordingError(f"{self.text}: there is no column {name!r}, only {', '.join(columns)}")
        column = self.time or next((name for name in TIME_COLUMNS if name in columns), None)
        if column is None and (self.since or self.until):
            raise RecordingError(f"{self.text}: from and to need a time column, name it: time=COLUMN")
        return column

    def setting(self, suffix: str = "") -> tuple[str, str]:
        """Return name and value of the variable of the environment that belongs to the connection; empty: not set."""
        scheme, connection = self.text.partition(":")[0], self.place.partition("/")[0]
        name = re.sub(r"\W", "_", f"servoscope_{scheme}_{connection}{suffix}").upper()
        return name, os.environ.get(name, "")

    def require(self, library: str, extra: str) -> None:
        """Raise RecordingError if a library is missing."""
        if find_spec(library) is None:
            raise RecordingError(f"{self.text}: needs {library}, pip install 'servoscope[{extra}]'")

    def moment(self, value: str) -> datetime:
        """Return a time as it stands in `from` and `to`, UTC unless it says otherwise; else RecordingError."""
        try:
            moment = datetime.fromisoformat(value)
        except ValueError:
            example = "2026-01-31T12:00"
            raise RecordingError(f"{self.text}: {value!r} is no time, write from and to as {example}") from None
        return moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment.astimezone(UTC)

    def table(self, columns: Sequence[str], read: Any) -> TableFile:
        """Return a table whose chunks `read` yields, as mappings of names to Arrow columns."""
        return TableFile(Path(self.text), tuple(columns), lambda wanted, _: read(tuple(wanted)))

    def conditions(self, time: str | None) -> Iterator[tuple[str, Comparison, str]]:
        """Yield what rows have to meet: a column, how it is compared, and with what; `time`: the time column."""
        for column, value in self.equal.items():
            yield column, operator.eq, value
        for limit, compare in ((self.since, operator.ge), (self.until, operator.lt)):
            if limit is not None and time is not None:
                yield time, compare, limit


def parse_address(text: str) -> TableAddress:
    """Return what an address says; raises RecordingError if it has no table, or a key twice."""
    place, _, query = text.partition(":")[2].partition("?")
    pairs = parse_qsl(query, keep_blank_values=True)
    words = dict(pairs)
    if not place or len(words) < len(pairs) or (query and not pairs):
        raise RecordingError(f"{text}: is no address of a table, write SCHEME:TABLE?COLUMN=VALUE&from=TIME&to=TIME")
    since, until, time = (words.pop(key, None) for key in ("from", "to", "time"))
    return TableAddress(text, place, words, since, until, time)


def is_address(text: str | Path) -> bool:
    """Tell whether a text begins with the name of a kind of tables, as in ``sql:``; else it is a path."""
    return _find_opener(str(text)) is not None


def _find_opener(text: str) -> EntryPoint | None:
    """Return what opens an address; a package cannot replace a built-in kind."""
    scheme, colon, place = text.partition(":")
    if not (colon and place and re.fullmatch(r"[a-z][a-z0-9]+", scheme)):
        return None
    return {opener.name: opener for opener in (*entry_points(group=ENTRY_POINTS), *BUILT_IN)}.get(scheme)


def open_address(text: str, layout: TextLayout | None = None) -> TableFile | None:
    """Open a table by its address, None where the text is none.

    Raises RecordingError if the table cannot be read.
    """
    opener = _find_opener(text)
    if opener is None:
        return None
    opened: TableFile = opener.load()(replace(parse_address(text), text_layout=layout))
    return opened
