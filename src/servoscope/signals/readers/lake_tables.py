"""Tables of Delta Lake and Iceberg as recordings, through deltalake and pyiceberg."""

from __future__ import annotations

import operator
import re
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.dataset as ds

from servoscope.signals.readers.addresses import TableAddress
from servoscope.signals.readers.table import TableFile, one_line_errors

ICEBERG_COMPARISONS = {operator.eq: "EqualTo", operator.ge: "GreaterThanOrEqual", operator.lt: "LessThan"}


def open_delta(address: TableAddress) -> TableFile:
    """Open ``delta:FOLDER``, or a URL of an object store; its newest version."""
    address.require("deltalake", "lake")
    from deltalake import DeltaTable

    unreadable = address.text, "cannot be read as a table of Delta"
    with one_line_errors(*unreadable):
        rows = DeltaTable(_location(address.place)).to_pyarrow_dataset()
    time = address.time_column(rows.schema.names)

    def read(wanted: Sequence[str]) -> Iterator[dict[str, Any]]:
        chosen: Any = ds.scalar(True)
        for column, compare, value in address.conditions(time):
            chosen &= compare(ds.field(column), _scalar(address, rows.schema.field(column).type, value))
        with one_line_errors(*unreadable):
            arrow = rows.to_table(columns=_with_time(wanted, time), filter=chosen)
        yield _ordered(arrow, wanted, time)

    return address.table(rows.schema.names, read)


def open_iceberg(address: TableAddress) -> TableFile:
    """Open ``iceberg:FOLDER``, ``iceberg:....metadata.json``, or ``iceberg:CATALOG/NAMESPACE.TABLE``.

    What a catalog is stands in pyiceberg's own settings.
    """
    address.require("pyiceberg", "lake")
    expressions: Any = import_module("pyiceberg.expressions")  # takes names and texts, which its types do not say
    unreadable = address.text, "cannot be read as a table of Iceberg"
    with one_line_errors(*unreadable):
        table = _iceberg_table(address.place)
    names = [field.name for field in table.schema().fields]
    time = address.time_column(names)

    def read(wanted: Sequence[str]) -> Iterator[dict[str, Any]]:
        chosen: Any = expressions.AlwaysTrue()
        for column, compare, value in address.conditions(time):
            bound = value if compare is operator.eq else _bound(address, table, column, value)
            chosen = expressions.And(chosen, getattr(expressions, ICEBERG_COMPARISONS[compare])(column, bound))
        with one_line_errors(*unreadable):
            arrow = table.scan(row_filter=chosen, selected_fields=tuple(_with_time(wanted, time))).to_arrow()
        yield _ordered(arrow, wanted, time)

    return address.table(names, read)


def _iceberg_table(place: str) -> Any:
    folder = Path(place)
    if folder.is_dir() or place.endswith(".metadata.json"):
        from pyiceberg.table import StaticTable

        if folder.is_dir():  # the newest version, as its number says
            paths = sorted(folder.glob("metadata/*.metadata.json"), key=lambda path: _version(path.name))
            if not paths:
                raise FileNotFoundError("holds no metadata/*.metadata.json")
            return StaticTable.from_metadata(str(paths[-1].absolute()))
        return StaticTable.from_metadata(_location(place))
    from pyiceberg.catalog import load_catalog

    catalog, _, name = place.partition("/")
    return load_catalog(catalog).load_table(name)


def _version(name: str) -> int:
    match = re.match(r"v?(\d+)", name)
    return int(match[1]) if match else -1


def _location(place: str) -> str:
    """Return a path or URL; paths of Python write ``s3://bucket`` with one stroke."""
    return re.sub(r"^([a-z][a-z0-9]+):/(?!/)", r"\1://", place)


def _with_time(wanted: Sequence[str], time: str | None) -> list[str]:
    return list(wanted) if time is None or time in wanted else [*wanted, time]


def _ordered(table: Any, wanted: Sequence[str], time: str | None) -> dict[str, Any]:
    """Return the wanted columns in the order of time: the files of a table have none."""
    ordered = table if time is None else table.sort_by(time)
    return {name: ordered.column(name) for name in wanted}


def _scalar(address: TableAddress, kind: Any, value: str) -> Any:
    with one_line_errors(address.text, f"{value!r} does not go with the column", kinds=(pa.ArrowException,)):
        if pa.types.is_timestamp(kind):
            moment = address.moment(value)
            return pa.scalar(moment if kind.tz else moment.replace(tzinfo=None), kind)
        return pa.scalar(value).cast(kind)


def _bound(address: TableAddress, table: Any, time: str, value: str) -> str:
    """Return a limit of the time as Iceberg reads it."""
    kind = str(table.schema().find_field(time).field_type)
    if not kind.startswith("timestamp"):
        return value
    moment = address.moment(value)
    return (moment if kind.startswith("timestamptz") else moment.replace(tzinfo=None)).isoformat()
