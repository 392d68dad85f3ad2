"""Tables of SQL databases as recordings, through SQLAlchemy."""

from __future__ import annotations

import operator
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

from servoscope.core.addresses import hide_secrets
from servoscope.core.errors import RecordingError
from servoscope.signals.readers.addresses import TableAddress
from servoscope.signals.readers.table import TableFile, shorten_error

CHUNK_ROWS = 1 << 15  # that are fetched at a time


def open_sql(address: TableAddress) -> TableFile:
    """Open ``sql:CONNECTION/TABLE``: the connection is a SQLite file, or a variable of the environment has its URL."""
    address.require("sqlalchemy", "service")
    import pyarrow as pa
    import sqlalchemy as sa

    connection, _, name = address.place.rpartition("/")
    url, table = _database_url(address, connection), _reflect(address, connection, name)
    time = address.time_column([column.name for column in table.c])

    def read(wanted: Sequence[str]) -> Iterator[dict[str, Any]]:
        query = sa.select(*(table.c[name] for name in wanted))
        for column, compare, value in address.conditions(time):
            bound = _typed(address, table.c[column], value, limit=compare is not operator.eq)
            query = query.where(compare(table.c[column], bound))
        if time is not None:
            query = query.order_by(table.c[time])
        with _connect(address, url) as opened:
            rows = opened.execution_options(stream_results=True).execute(query)
            for part in rows.partitions(CHUNK_ROWS):
                yield dict(zip(wanted, map(pa.array, zip(*part, strict=True)), strict=True))

    return address.table([column.name for column in table.c], read)


def _database_url(address: TableAddress, connection: str) -> Any:
    from sqlalchemy.engine import URL, make_url

    if Path(connection).is_file():
        return URL.create("sqlite", database=f"file:{quote(connection)}", query={"mode": "ro", "uri": "true"})
    variable, text = address.setting()
    if not text:
        raise RecordingError(
            f"{address.text}: {connection!r} is no file, and {variable} is not set: set it to the URL of the database,"
            " as in postgresql://user@host/database"
        )
    try:
        url = make_url(text)
    except Exception:  # its message would repeat the password
        raise RecordingError(f"{address.text}: {variable} is no URL, write postgresql://user@host/database") from None
    return url.set(drivername="postgresql+psycopg") if url.drivername == "postgresql" else url


@contextmanager
def _connect(address: TableAddress, url: Any) -> Iterator[Any]:
    """Yield a connection that only reads; what goes wrong is one line without secrets."""
    import sqlalchemy as sa

    engine = None
    try:
        engine = sa.create_engine(url, hide_parameters=True)
        with engine.connect() as connection:
            if engine.dialect.name == "postgresql":
                connection.execute(sa.text("SET TRANSACTION READ ONLY"))
            yield connection
    except (sa.exc.SQLAlchemyError, ModuleNotFoundError) as error:
        cause = getattr(error, "orig", None) or error
        text = shorten_error(cause).replace(url.password or "\0", "***")
        raise RecordingError(f"{address.text}: cannot be read ({hide_secrets(text)})") from None
    finally:
        if engine is not None:
            engine.dispose()


def _reflect(address: TableAddress, connection: str, name: str) -> Any:
    import sqlalchemy as sa

    schema, _, bare = name.rpartition(".")
    with _connect(address, _database_url(address, connection)) as opened:
        known = sa.inspect(opened)
        there = [*known.get_table_names(schema or None), *known.get_view_names(schema or None)]
        if bare not in there:
            raise RecordingError(
                f"{address.text}: there is no table {name!r}, only {', '.join(sorted(there)) or 'none'}"
            )
        return sa.Table(bare, sa.MetaData(), schema=schema or None, autoload_with=opened)


def _typed(address: TableAddress, column: Any, value: str, *, limit: bool = False) -> Any:
    """Return a value of an address, or a limit of the time, as the database compares it with a column."""
    import sqlalchemy as sa

    if isinstance(column.type, sa.DateTime):
        moment = address.moment(value)
        # SQLite, and columns without a zone, hold UTC
        return moment if getattr(column.type, "timezone", False) else moment.replace(tzinfo=None)
    if isinstance(column.type, sa.String):
        return value
    try:  # SQLite also has columns without a type
        return float(value)
    except ValueError:
        if limit:
            return address.moment(value).timestamp()
        raise RecordingError(f"{address.text}: {value!r} is no number, as {column.name!r} has them") from None
