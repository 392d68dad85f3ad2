"""Measurements of InfluxDB as recordings: InfluxQL over HTTP, which versions 1, 2 and 3 answer alike."""

from __future__ import annotations

import json
import operator
from collections.abc import Iterator, Sequence
from typing import Any
from urllib.parse import unquote, urlsplit

from servoscope.core.errors import RecordingError
from servoscope.signals.readers.addresses import TableAddress
from servoscope.signals.readers.table import TableFile, one_line_errors

CHUNK_ROWS = 10_000  # that the server sends at a time
TIMEOUT_S = 60.0
SIGNS = {operator.ge: ">=", operator.lt: "<"}


def open_influx(address: TableAddress) -> TableFile:
    """Open ``influx:CONNECTION/MEASUREMENT``; conditions are tags.

    A variable of the environment has the address of the server with the database, another one the token.
    """
    address.require("httpx", "service")
    import pyarrow as pa

    measurement = address.place.partition("/")[2]
    where = [
        f"{_quote(tag)} = '{_escape(value)}'"
        if compare is operator.eq
        else f"time {SIGNS[compare]} '{address.moment(value):%Y-%m-%dT%H:%M:%S.%fZ}'"
        for tag, compare, value in address.conditions("time")
    ]
    query = f"SELECT * FROM {_quote(measurement)}" + (f" WHERE {' AND '.join(where)}" if where else "")
    first = next(_answer(address, f"{query} LIMIT 1"), None)
    if first is None:
        raise RecordingError(f"{address.text}: holds no rows, check measurement, tags and times")
    names: list[str] = first["columns"]

    def read(wanted: Sequence[str]) -> Iterator[dict[str, Any]]:
        for series in _answer(address, query):
            columns = dict(zip(series["columns"], zip(*series["values"], strict=True), strict=True))
            yield {
                name: pa.array(columns[name], pa.timestamp("ns", "UTC") if name == "time" else None) for name in wanted
            }

    return address.table(names, read)


def _answer(address: TableAddress, query: str) -> Iterator[dict[str, Any]]:
    """Yield the series of an answer: names of columns, and rows."""
    import httpx

    variable, text = address.setting()
    url = urlsplit(text)
    database = url.path.strip("/")
    if url.scheme not in ("http", "https") or not database:
        raise RecordingError(f"{address.text}: set {variable} to server and database, as in http://host:8086/database")
    token = address.setting("_token")[1]
    headers = {"Authorization": f"Token {token}"} if token else {}
    login = (unquote(url.username), unquote(url.password or "")) if url.username else None
    host = url.netloc.rpartition("@")[2]
    parameters: dict[str, str | int] = {"db": database, "q": query, "epoch": "ns"}
    parameters |= {"chunked": "true", "chunk_size": CHUNK_ROWS}
    kinds, place = (httpx.HTTPError, ValueError, KeyError), f"{url.scheme}://{host}/query"
    with (
        one_line_errors(address.text, f"cannot be read from {host}", kinds=kinds),
        httpx.stream("GET", place, params=parameters, headers=headers, auth=login, timeout=TIMEOUT_S) as answer,
    ):
        if answer.status_code != 200:
            raise RecordingError(f"{address.text}: the server answers {answer.status_code}, see {variable}")
        for line in answer.iter_lines():
            for result in json.loads(line)["results"] if line.strip() else ():
                if "error" in result:
                    raise RecordingError(f"{address.text}: the server says: {result['error']}")
                yield from result.get("series", ())


def _quote(name: str) -> str:
    escaped = name.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def _escape(value: str) -> str:
    return value.replace("\\", "\\\\").replace("'", "\\'")
