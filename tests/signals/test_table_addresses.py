"""Recordings in tables: SQL on two databases, InfluxDB's answers, Delta Lake, Iceberg; whole and by filter."""

from __future__ import annotations

import base64
import contextlib
import json
import sqlite3
import threading
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import halls
import numpy as np
import pyarrow as pa
import pytest
import sqlalchemy as sa
from commands import one_line, run
from reliability.servers import Postgres

from servoscope.core.errors import RecordingError
from servoscope.models.loop import Columns, Loop
from servoscope.signals import readers
from servoscope.signals.readers import addresses

BEGAN = datetime(2026, 1, 1, tzinfo=UTC)
COLUMNS = Columns(time="time")
SECRET = "correct-horse"


@pytest.fixture(scope="module")
def rows() -> dict[str, Any]:
    """Two assets whose rows are mixed, in no order of time: press leaks, lift does not."""
    found: dict[str, list[Any]] = {name: [] for name in ("time", "asset", "r", "u", "y")}
    for asset, one in (("press", halls.recorded(2, halls.LEAK)), ("lift", halls.recorded(1))):
        found["time"] += [BEGAN + timedelta(microseconds=round(1e6 * t)) for t in one.t.tolist()]
        found["asset"] += [asset] * one.samples
        for name in "ruy":
            found[name] += getattr(one, name).tolist()
    order = np.random.default_rng(3).permutation(len(found["time"])).tolist()
    return {name: [column[i] for i in order] for name, column in found.items()}


def check(address: str) -> None:
    """Check that a table with the `rows` is read: one asset whole, and a part of it."""
    loop, leaky = Loop.load(halls.LOOP), halls.recorded(2, halls.LEAK)
    assert [one.name for one in readers.list_channels(address)][-3:] == ["r", "u", "y"]
    whole = readers.read(f"{address}?asset=press", loop, columns=COLUMNS)
    assert whole.samples == leaky.samples and not whole.defects
    for name in "ruy":
        assert np.array_equal(getattr(whole, name), getattr(leaky, name)), name
    part = readers.read(
        f"{address}?asset=press&from=2026-01-01T00:00:10&to=2026-01-01T01:00:20%2B01:00", loop, columns=COLUMNS
    )
    chosen = (leaky.t >= 10.0) & (leaky.t < 20.0)
    assert np.array_equal(part.y, leaky.y[chosen]) and part.samples == 1000
    with pytest.raises(RecordingError, match=r"there is no column 'machine', only .*asset"):
        readers.read(f"{address}?machine=press", loop, columns=COLUMNS)
    with pytest.raises(RecordingError, match="holds no rows"):
        readers.read(f"{address}?asset=crane", loop, columns=COLUMNS)


def fill(url: str, rows: dict[str, Any]) -> None:
    engine = sa.create_engine(url)
    kinds: dict[str, Any] = {"time": sa.DateTime(timezone=True), "t": sa.DateTime(), "asset": sa.Text}
    table = sa.Table("log", sa.MetaData(), *(sa.Column(name, kinds.get(name, sa.Double)) for name in rows))
    with engine.begin() as connection:
        table.drop(connection, checkfirst=True)
        table.create(connection)
        connection.execute(
            table.insert(), [dict(zip(rows, row, strict=True)) for row in zip(*rows.values(), strict=True)]
        )
    engine.dispose()


def test_sqlite(tmp_path: Path, rows: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    naive = rows | {"time": [time.replace(tzinfo=None) for time in rows["time"]]}
    fill("sqlite:///plant.db", naive)
    check("sql:plant.db/log")
    with contextlib.closing(sqlite3.connect("plant.db")) as connection:  # seconds since 1970, as many loggers write
        seconds = "(julianday(time) - 2440587.5) * 86400.0"
        connection.execute(f"CREATE TABLE plain AS SELECT {seconds} AS ts, r, u, y FROM log WHERE asset = 'press'")
        connection.commit()
    part = readers.read(
        "sql:plant.db/plain?from=2026-01-01T00:00:10&to=2026-01-01T00:00:20", columns=Columns(time="ts")
    )
    assert part.samples > 0 and part.t[-1] - part.t[0] < 10.0
    with pytest.raises(RecordingError, match="there is no table 'lgo', only log, plain"):
        readers.read("sql:plant.db/lgo")


def test_postgresql_and_no_secret_in_what_is_said(
    postgres: Postgres, rows: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(postgres.url.replace("postgresql", "postgresql+psycopg"), rows)
    monkeypatch.setenv("SERVOSCOPE_SQL_PLANT", postgres.url)
    check("sql:plant/log")
    check("sql:plant/public.log")
    host = postgres.url.rpartition("@")[2]
    for wrong in (f"postgresql://nobody:{SECRET}@{host}", f"postgresql://u:{SECRET}@127.0.0.1:1/x", f"oops:{SECRET}"):
        monkeypatch.setenv("SERVOSCOPE_SQL_PLANT", wrong)
        done = run("inspect", "sql:plant/log")
        assert done.code == 1 and "sql:plant/log" in one_line(done) and SECRET not in done.out + done.err
    monkeypatch.delenv("SERVOSCOPE_SQL_PLANT")
    with pytest.raises(RecordingError, match="SERVOSCOPE_SQL_PLANT is not set: set it to the URL of the database"):
        readers.read("sql:plant/log")


def test_from_a_table_to_a_verdict(tmp_path: Path, rows: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    named = {"t" if name == "time" else name: column for name, column in rows.items()}
    fill("sqlite:///plant.db", named | {"t": [time.replace(tzinfo=None) for time in rows["time"]]})
    halls.baseline().save("baseline.json")
    done = run("diagnose", "baseline.json", "sql:plant.db/log?asset=press", "--json")
    assert done.code == 3, done.err
    said = json.loads(done.out)
    assert (said["verdict"], said["faults"][0]["name"]) == ("fault", "leakage")


class Influx(BaseHTTPRequestHandler):
    """Answers as https://docs.influxdata.com/influxdb/v1/tools/api/#query-http-endpoint says, with `chunked=true`."""

    rows: dict[str, Any]
    asked: list[tuple[dict[str, list[str]], str | None]]

    def do_GET(self) -> None:
        words = parse_qs(urlsplit(self.path).query)
        self.asked.append((words, self.headers["Authorization"]))
        assert words["epoch"] == ["ns"] and words["chunked"] == ["true"] and words["db"] == ["plant"]
        query = words["q"][0]
        if SECRET not in (self.headers["Authorization"] or "") and base64.b64encode(
            f"otto:{SECRET}".encode()
        ).decode() not in (self.headers["Authorization"] or ""):
            return self.answer(401, '{"error":"authorization failed"}\n')
        if "nothing" in query:
            return self.answer(200, '{"results":[{"statement_id":0}]}\n')
        if "broken" in query:
            return self.answer(200, '{"results":[{"statement_id":0,"error":"shard is gone"}]}\n')
        ns = [round(time.timestamp() * 1e6) * 1000 for time in self.rows["time"]]
        table = sorted(zip(ns, *(self.rows[name] for name in ("asset", "r", "u", "y")), strict=True))
        for clause in query.partition(" WHERE ")[2].removesuffix(" LIMIT 1").split(" AND "):
            left, _, right = clause.partition(" >= " if ">=" in clause else " < " if " < " in clause else " = ")
            if left == '"asset"':
                table = [row for row in table if f"'{row[1]}'" == right]
            elif left == "time":
                at = datetime.fromisoformat(right.strip("'")).timestamp() * 1e9
                table = [row for row in table if (row[0] >= at) == (">=" in clause)]
        if not table:
            return self.answer(200, '{"results":[{"statement_id":0}]}\n')
        table = table[:1] if query.endswith(" LIMIT 1") else table
        size, lines = int(words["chunk_size"][0]) // 4, []
        for first in range(0, len(table), size):
            more = {"partial": True} if first + size < len(table) else {}
            part = [list(row) for row in table[first : first + size]]
            series = {"name": "log", "columns": ["time", "asset", "r", "u", "y"], "values": part, **more}
            lines.append(json.dumps({"results": [{"statement_id": 0, "series": [series], **more}]}) + "\n")
        return self.answer(200, "".join(lines))

    def answer(self, status: int, text: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(text.encode())))
        self.end_headers()
        self.wfile.write(text.encode())

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def influx(rows: dict[str, Any]) -> Iterator[tuple[str, type[Influx]]]:
    kind = type("Answering", (Influx,), {"rows": rows, "asked": []})
    server = ThreadingHTTPServer(("127.0.0.1", 0), kind)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"127.0.0.1:{server.server_port}", kind
    server.shutdown()
    thread.join()
    server.server_close()


def test_influxdb(influx: tuple[str, type[Influx]], monkeypatch: pytest.MonkeyPatch) -> None:
    host, server = influx
    monkeypatch.setenv("SERVOSCOPE_INFLUX_PLANT", f"http://{host}/plant")
    monkeypatch.setenv("SERVOSCOPE_INFLUX_PLANT_TOKEN", SECRET)
    loop, leaky = Loop.load(halls.LOOP), halls.recorded(2, halls.LEAK)
    whole = readers.read("influx:plant/log?asset=press", loop, columns=COLUMNS)
    assert all(np.array_equal(getattr(whole, name), getattr(leaky, name)) for name in "ruy")
    part = readers.read(
        "influx:plant/log?asset=press&from=2026-01-01T00:00:10&to=2026-01-01T00:00:20", loop, columns=COLUMNS
    )
    assert np.array_equal(part.y, leaky.y[(leaky.t >= 10.0) & (leaky.t < 20.0)])
    assert {header for _, header in server.asked} == {f"Token {SECRET}"}
    # a name cannot end its quotes
    with pytest.raises(RecordingError, match="holds no rows"):
        readers.read("influx:plant/lo\"g; DROP?asset=nothing' OR 1=1", loop, columns=COLUMNS)
    assert server.asked[-1][0]["q"] == ['SELECT * FROM "lo\\"g; DROP" WHERE "asset" = \'nothing\\\' OR 1=1\' LIMIT 1']
    with pytest.raises(RecordingError, match="the server says: shard is gone"):
        readers.read("influx:plant/broken", loop, columns=COLUMNS)
    monkeypatch.delenv("SERVOSCOPE_INFLUX_PLANT_TOKEN")
    for url, why in (
        (f"http://otto:{SECRET}@{host}/plant", ""),
        (f"http://otto:wrong-{SECRET}@{host}/plant", "answers 401"),
        (f"http://otto:{SECRET}@127.0.0.1:1/plant", "cannot be read from 127.0.0.1:1"),
        (f"http://otto:{SECRET}@{host}", "set SERVOSCOPE_INFLUX_PLANT to server and database"),
    ):
        monkeypatch.setenv("SERVOSCOPE_INFLUX_PLANT", url)
        if not why:
            assert readers.read("influx:plant/log?asset=lift", loop, columns=COLUMNS).samples == 6000
            continue
        with pytest.raises(RecordingError, match=why) as told:
            readers.read("influx:plant/log?asset=lift", loop, columns=COLUMNS)
        assert SECRET not in str(told.value)


def test_delta_lake(tmp_path: Path, rows: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    deltalake = pytest.importorskip("deltalake")
    monkeypatch.chdir(tmp_path)
    table = pa.table(rows)
    for part in (table.slice(0, 5000), table.slice(5000)):  # two versions
        deltalake.write_deltalake("log", part, mode="append", partition_by=["asset"])
    check("delta:log")
    check(f"delta:{tmp_path}/log")
    with pytest.raises(RecordingError, match="cannot be read as a table of Delta"):
        readers.read("delta:nowhere")


def test_iceberg(tmp_path: Path, rows: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    sql = pytest.importorskip("pyiceberg.catalog.sql")
    from pyiceberg.utils.config import Config

    monkeypatch.chdir(tmp_path)
    settings = {"uri": f"sqlite:///{tmp_path}/catalog.db", "warehouse": f"file://{tmp_path}/warehouse"}
    catalog = sql.SqlCatalog("plant", **settings)
    catalog.create_namespace("hall")
    written = pa.table(rows)
    table = catalog.create_table("hall.log", schema=written.schema)
    for part in (written.slice(0, 5000), written.slice(5000)):
        table.append(part)
    check(f"iceberg:{table.location().removeprefix('file://')}")
    for name, value in settings.items():
        monkeypatch.setenv(f"PYICEBERG_CATALOG__PLANT__{name.upper()}", value)
    monkeypatch.setattr("pyiceberg.catalog._ENV_CONFIG", Config())  # it is read when pyiceberg is imported
    check("iceberg:plant/hall.log")
    catalog.close()
    with pytest.raises(RecordingError, match="cannot be read as a table of Iceberg"):
        readers.read(f"iceberg:{tmp_path}")


def test_a_package_adds_a_kind_of_its_own_and_replaces_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """The recipe of CONTRIBUTING.md."""
    added = [EntryPoint(name, "test_table_addresses:open_made", addresses.ENTRY_POINTS) for name in ("made", "sql")]
    monkeypatch.setattr(addresses, "entry_points", lambda group: added)
    recording = readers.read("made:sines?rows=300")
    assert (recording.samples, recording.name) == (300, "made:sines?rows=300")
    with pytest.raises(RecordingError, match="SERVOSCOPE_SQL_SINES is not set"):
        readers.read("sql:sines/log")


def open_made(address: addresses.TableAddress) -> Any:
    count = int(address.equal["rows"])

    def read(wanted: tuple[str, ...]) -> Iterator[dict[str, Any]]:
        for first in range(0, count, 100):
            t = 0.01 * np.arange(first, first + 100)
            made = {"t": t, "r": np.sin(t), "u": np.cos(t), "y": np.sin(t - 0.1)}
            yield {name: pa.chunked_array([made[name]]) for name in wanted}

    return address.table(("t", "r", "u", "y"), read)


@pytest.mark.parametrize("text", ["sql:", "sql:plant/log?a=1&a=2", "delta:?a=1"])
def test_what_is_no_address_is_said(text: str) -> None:
    with pytest.raises(RecordingError, match="no such file" if text == "sql:" else "is no address of a table"):
        readers.read(text)
