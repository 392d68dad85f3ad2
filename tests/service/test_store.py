"""The store on both databases: batches whole and once, versions, retention, history and its exports."""

from __future__ import annotations

import io
import json
import sqlite3
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import halls
import pyarrow.compute as pc
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest
import sqlalchemy as sa
from commands import one_line, run
from rich.console import Console

from servoscope.cli.render.history import row_table
from servoscope.core.errors import StoreError, StoreUnavailableError
from servoscope.service.assets.records import TableRow
from servoscope.service.build import build_components
from servoscope.service.config import ServiceFile
from servoscope.service.housekeeping import THIN_WITHIN_S, Housekeeping
from servoscope.service.service import Service
from servoscope.service.store import Batch, Store, schema, tables
from servoscope.service.store.queries import format_time, query_downsampled, query_history
from servoscope.service.writer import StoreWriter


def residual(number: int, t: float, asset: str = "press") -> dict[str, Any]:
    numbers = {"statistic": 0.25, "level": 0.5, "residual": [[1.0, 0.1, -0.2, 2.0], [10.0, None, None, 20.0]]}
    return {"asset": asset, "number": number, "t": t, **numbers}


def batch(*rows: dict[str, Any]) -> Batch:
    made = Batch()
    made.rows["residuals"] = list(rows)
    return made


def test_a_batch_is_written_whole_or_not_at_all(store: Store) -> None:
    store.write(batch(residual(1, 0.0), residual(2, 1.0)), "hall", 1)
    with store._engine.begin() as connection:
        connection.execute(sa.text("DROP TABLE recent"))
    further = batch(residual(3, 2.0))
    further.rows["recent"] = [{"asset": "press", "sequence": 1, "samples": b""}]
    with pytest.raises(StoreError):  # no row's content is to blame: none is set aside
        store.write(further, "hall", 2)
    assert [row["number"] for row in query_history(store, "residuals")] == [1, 2]
    assert store.last_commit("hall") == 1 and store.last_commit("another") == 0


def test_of_the_outbox_a_service_gets_its_own_and_not_what_is_for_busy_sinks(store: Store) -> None:
    made = Batch()
    made.rows["outbox"] = [
        {"key": key, "sink": sink, "event": {"service": of}, "created": 0.0, "due": due, "attempts": 0, "outcome": ""}
        for key, sink, of, due in (
            ("a", "desk", "hall", 1.0),
            ("b", "pager", "hall", 1.0),
            ("c", "desk", "yard", 1.0),
            ("d", "desk", "hall", 9.0),
            ("e", "desk", "hall", None),
        )
    ]
    store.write(made, "hall", 1)
    assert [row["key"] for row in store.due_deliveries(2.0, 9, "hall")] == ["a", "b"]
    assert [row["key"] for row in store.due_deliveries(2.0, 9, "hall", {"desk"})] == ["b"]


class Forgetful(Store):
    """Loses the connection when a commit has been made, before it could say so."""

    cut = 0

    def write(self, batch: Batch, owner: str, commit: int) -> None:
        super().write(batch, owner, commit)
        self.cut += 1
        if self.cut == 1:
            raise StoreUnavailableError("the connection is lost")


def test_a_commit_whose_end_was_not_heard_is_not_made_twice(url: str) -> None:
    store = Forgetful.open(url, write=True)
    writer = StoreWriter(store, "hall", 10)
    writer.add("press", [TableRow("residuals", {k: v for k, v in residual(1, 0.0).items() if k != "asset"})])
    with pytest.raises(StoreUnavailableError):
        writer.write()
    assert not writer.empty and writer.unavailable_since is not None
    while writer.write() is None:
        time.sleep(0.01)
    assert writer.empty and writer.unavailable_since is None
    assert len(query_history(store, "residuals")) == 1 and store.last_commit("hall") == 1
    store.close()


def test_a_checkpoint_replaces_the_one_before_and_old_samples_go(store: Store) -> None:
    for sequence in range(3):
        made = Batch(first_needed={"press": sequence - 1})
        made.rows["recent"] = [{"asset": "press", "sequence": sequence, "samples": bytes([sequence])}]
        row = {"asset": "press", "sequence": sequence, "state": b"x", "status": {"verdict": "healthy"}, "at": 1.0}
        made.checkpoints["press"] = row
        store.write(made, "hall", sequence + 1)
    assert store.statuses()["press"]["sequence"] == 2
    assert store.recent_samples("press") == [(1, b"\1"), (2, b"\2")]


def test_residuals_are_kept_for_as_long_as_said(store: Store) -> None:
    store.write(batch(*(residual(k, float(k)) for k in range(10))), "hall", 1)
    store.write(batch(residual(1, 0.0, "lift")), "hall", 2)
    assert store.delete_before("residuals", {"press": 7.0}) == 7
    assert [(row["asset"], row["number"]) for row in query_history(store, "residuals")] == [
        ("lift", 1),
        ("press", 7),
        ("press", 8),
        ("press", 9),
    ]


def test_older_tables_are_migrated_and_newer_ones_refused(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    first = Store.open(url, write=True)
    first.write(batch(residual(1, 0.0)), "hall", 1)
    first.close()

    def add_a_note(connection: sa.Connection) -> None:
        if connection.dialect.name == "postgresql":  # it takes as long as the rows do
            assert connection.scalar(sa.text("SHOW statement_timeout")) == "0"
        connection.execute(sa.text("ALTER TABLE residuals ADD COLUMN note TEXT DEFAULT 'old'"))

    released = schema.MIGRATIONS
    monkeypatch.setattr(schema, "MIGRATIONS", [*released, add_a_note])
    monkeypatch.setattr(schema, "READABLE_FROM", 5)
    with pytest.raises(StoreError, match=r"version 4, servoscope run brings them to 5"):
        Store.open(url)
    Store.open(url, write=True).close()
    again = Store.open(url)
    assert again.fetch(sa.select(sa.column("note")).select_from(tables.residuals)) == [{"note": "old"}]
    again.close()
    monkeypatch.setattr(schema, "MIGRATIONS", released)
    with pytest.raises(StoreError, match=r"of version 5, this servoscope knows up to 4: install a newer one"):
        Store.open(url)


def test_a_migration_that_fails_leaves_all_as_it_was(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    Store.open(url, write=True).close()

    def half(connection: sa.Connection) -> None:
        connection.execute(sa.text("ALTER TABLE residuals ADD COLUMN note TEXT"))
        connection.execute(sa.text("ALTER TABLE nowhere ADD COLUMN note TEXT"))

    released = schema.MIGRATIONS
    monkeypatch.setattr(schema, "MIGRATIONS", [*released, half])
    with pytest.raises(StoreError, match="nowhere"):
        Store.open(url, write=True)
    monkeypatch.setattr(schema, "MIGRATIONS", released)
    store = Store.open(url)
    with pytest.raises(StoreError, match="note"):
        store.fetch(sa.select(sa.column("note")).select_from(tables.residuals))
    store.close()


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("nowhere/history.sqlite", "no such store, servoscope run makes it"),
        ("mysql://somewhere/x", "mysql:// is not supported, give a path for SQLite or postgresql://"),
        ("postgres://somewhere/x", "postgres:// is not supported, write postgresql://"),
        ("postgresql://user:secret@127.0.0.1:1/x", "connection refused"),
        ("://", "cannot be read as a URL"),
        ("postgresql://u@localhost:abc/x", "cannot be read as a URL"),
        ("sqlite://", "would be lost with the process, give a path"),
        (".", "is a folder, give the name of a file in it"),
    ],
)
def test_what_cannot_be_opened_is_one_line_without_passwords(url: str, said: str, tmp_path: Path) -> None:
    line = one_line(run("watch", url, "--once"))
    assert said.casefold() in line.casefold() and "secret" not in line


def test_a_file_that_is_no_database_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.sqlite").write_bytes(b"not a database, but long enough to be looked at as if it were one" * 20)
    one_line(run("history", tmp_path / "x.sqlite"), "x.sqlite", "file is not a database")


def test_a_time_that_no_calendar_has_is_a_number() -> None:
    assert format_time(0.0) == "1970-01-01 00:00:00" and format_time(3e11) == "300000000000 s"


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A service file whose service has run."""
    folder = tmp_path_factory.mktemp("history")
    halls.files(folder)
    config = halls.hall(folder, "hall")
    Service(ServiceFile.load(config), build_components(ServiceFile.load(config))).run()
    return config


class TestCommands:
    def test_check_reads_all_that_is_named(self, hall: Path) -> None:
        assert "2 assets, 1 source; all can be used" in run("run", hall, "--check").out
        wrong = hall.with_name("wrong.toml")
        wrong.write_text(hall.read_text().replace("leaky.csv", "weak.csv"))
        one_line(run("run", wrong, "--check"), "weak.csv")
        one_line(run("run", hall, "--anew", "nobody"), "--anew nobody", "press, lift")

    def test_watch_shows_assets_as_they_are(self, hall: Path) -> None:
        shown = run("watch", hall, "--once").out
        assert "press" in shown and "lift" in shown and "fault" in shown
        told = " ".join(shown.split())
        assert "press: Fault: leakage from 2026-01-01 00:01:3" in told and "healthy again since" in told  # and 0 or so
        found = {one["asset"]: one["status"] for one in json.loads(run("watch", hall, "--json").out)}
        assert found["lift"]["verdict"] == "healthy" and found["press"]["alarms"]["fault"]["state"] == "unacknowledged"
        (only,) = json.loads(run("watch", hall, "--json", "--asset", "lift").out)
        assert only["asset"] == "lift"

    def test_history_is_asked_by_kind_asset_and_time(self, hall: Path) -> None:
        rows = [json.loads(line) for line in run("history", hall, "--json").out.splitlines()]
        assert [row["t"] for row in rows] == sorted(row["t"] for row in rows)
        alarms = run("history", hall, "--kind", "alarms", "--asset", "press", "--json").out.splitlines()
        (alarm,) = map(json.loads, alarms)
        assert alarm["time"].startswith("2026-01-01T00:01:3") and alarm["document"]["priority"] == "high"
        before = run("history", hall, "--kind", "alarms", "--to", "2026-01-01T00:01", "--json")
        assert before.out == ""
        assert "started" in run("history", hall, "--kind", "audit", "--from", "1h").out
        assert "version: 1.0" in run("history", hall, "--kind", "audit", "--from", "1h").out
        one_line(run("history", hall, "--asset", "pres"), "no such asset", "press")
        wrong = run("history", hall, "--from", "yesterday")
        assert wrong.code == 2 and "2026-01-31T12:00" in " ".join(wrong.err.split())

    def test_history_is_exported(self, hall: Path, tmp_path: Path) -> None:
        run("history", hall, "--kind", "residuals", "-o", tmp_path / "r.parquet")
        run("history", hall, "--kind", "residuals", "--asset", "lift", "-o", tmp_path / "r.csv")
        run("history", hall, "-o", tmp_path / "d.json")
        table = pq.read_table(tmp_path / "r.parquet")
        assert {"time", "asset", "statistic", "gamma_1Hz_real", "healthy_20Hz"} <= set(table.column_names)
        lift = table.filter(pc.equal(table["asset"], "lift"))
        assert pacsv.read_csv(tmp_path / "r.csv")["statistic"].to_pylist() == lift["statistic"].to_pylist()
        document = json.loads((tmp_path / "d.json").read_text())
        assert any(row["grounds"] == "full" and row["document"]["faults"] for row in document)

    def test_alarms_are_answered_through_the_store(self, hall: Path) -> None:
        assert "press" in run("alarms", "list", hall).out
        one_line(run("alarms", "ack", hall, "pres", "fault"), "no such asset", "did you mean 'press'?")
        one_line(run("alarms", "ack", hall, "press", "falt"), "has no alarm 'falt', did you mean 'fault'?")
        # a service that goes on: the same history with more to replay
        text = hall.read_text().replace("speed = 0.0", "speed = 1.0")
        hall.write_text(text.replace('kind = "replay"', 'kind = "replay"\nrepeat = true'))
        service = Service(ServiceFile.load(hall), build_components(ServiceFile.load(hall)))
        running = threading.Thread(target=service.run)
        running.start()
        try:
            said = run("alarms", "ack", hall, "press", "fault", "--who", "ann", "--why", "on my way")
            assert said.out == "press: fault: done\n"
            one_line(run("alarms", "ack", hall, "press", "fault"), "means nothing there")
            assert run("alarms", "shelve", hall, "press", "fault", "--for", "999d").code == 2
            assert run("alarms", "shelve", hall, "press", "fault", "--for", "8h").code == 0
            (shelved,) = json.loads(run("alarms", "list", hall, "--json").out)
            assert shelved["state"] == "shelved" and shelved["until"] - shelved["since"] == 8 * 3600.0
            assert format_time(shelved["until"]) in run("alarms", "list", hall).out
        finally:
            service.stop()
            running.join(30.0)
        audit = [json.loads(line) for line in run("history", hall, "--kind", "audit", "--json").out.splitlines()]
        told = [
            (row["who"], row["what"], row["document"]["outcome"][:8]) for row in audit if "outcome" in row["document"]
        ]
        assert told[0] == ("ann", "acknowledge", "done") and told[1][2] == "refused:"


def test_the_audit_of_a_login_is_told() -> None:
    row = {"at": 0.0, "who": "vera", "document": {"from": "192.0.2.1", "until": 60.0}}
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(row_table([row], ("at", "who", "document")))
    said = console.export_text()
    assert "from: 192.0.2.1" in said and "until: 1970-01-01 00:01:00" in said


@pytest.mark.parametrize("url", ["postgresql"], indirect=True)
def test_postgresql_clears_samples_away_by_their_number(store: Store) -> None:
    """By default it waits for a fifth of what the table held: 50 GB after a day of 200 assets and many crashes."""
    chosen = "SELECT reloptions FROM pg_class WHERE relname IN ('bundles', 'recent')"
    rows = store.fetch(sa.select(sa.text(chosen).columns(sa.column("reloptions")).subquery()))
    assert ["autovacuum_vacuum_threshold=1000" in row["reloptions"] for row in rows] == [True, True]


def test_a_long_history_is_thinned_by_the_database_to_what_was_largest(store: Store) -> None:
    batch = Batch()
    for number in range(1000):
        row = {"asset": "press", "number": number, "t": 100.0 + number, "level": number % 7 / 10.0}
        batch.rows["residuals"].append(
            {**row, "statistic": float(number == 555), "residual": [[1.0, number, 0.0, 1.0]]}
        )
    store.write(batch, "hall", 1)
    rows, count = query_downsampled(store, "press", (100.0, 1100.0), 10)
    assert count == 1000 and [row["rows"] for row in rows] == [100] * 10
    assert rows[5]["t"] == 655.0 and rows[5]["statistic"] == 1.0 and rows[5]["residual"] == [[1.0, 555, 0.0, 1.0]]
    assert all(row["level"] == 0.6 for row in rows)
    rows, count = query_downsampled(store, "press", (100.0, 110.0), 1000)
    assert count == len(rows) == 10 and [row["t"] for row in rows] == [100.0 + k for k in range(10)]
    assert query_downsampled(store, "lift", (0.0, 1e9), 10) == ([], 0)


def test_sizes_of_many_assets_are_thinned_some_at_each_look(store: Store) -> None:
    """All of them at once would keep the blocks of a large service waiting."""
    names, batch = [f"axis{i}" for i in range(5)], Batch()
    size = {"kind": "live", "name": "leakage", "value": 1.2, "low": 1.1, "high": 1.3, "healthy": 1.0}
    batch.rows["sizes"] = [{"asset": name, "t": t, **size} for name in names for t in (10.0, 20.0)]
    store.write(batch, "hall", 1)
    # one of them belongs to another service by now
    others = (f"other{i}" for i in range(round(2.0 * THIN_WITHIN_S)))
    context: Any = SimpleNamespace(store=store, assets=dict.fromkeys([*names, *others]))
    batch = Batch()
    batch.rows["sizes"] = [{"asset": "gone", "t": t, **size} for t in (10.0, 20.0)]
    store.write(batch, "hall", 2)
    housekeeping = Housekeeping(context, context)
    housekeeping._to_thin = dict.fromkeys(["gone", *names], 1e7)
    left = []
    for _ in range(2):
        housekeeping._thin_sizes()
        left.append(len(store.fetch(sa.select(tables.sizes))))
    assert left == [2 + 3 + 2 * 2, 2 + 5] and not housekeeping._to_thin


def test_what_others_change_is_told_in_the_audit(store: Store) -> None:
    store.add_audit("vera", "", "baseline saved", {"baseline": "mine"})
    (row,) = query_history(store, "audit")
    assert (row["who"], row["asset"], row["what"], row["document"]) == (
        "vera",
        "",
        "baseline saved",
        {"baseline": "mine"},
    )
    assert abs(row["at"] - time.time()) < 60.0


def test_a_writer_waits_for_another_that_prepares_the_file(tmp_path: Path) -> None:
    """Service and pages begin at the same moment; SQLite refuses one of them at once."""
    other = sqlite3.connect(tmp_path / "history.sqlite", check_same_thread=False)
    other.execute("PRAGMA journal_mode = DELETE")
    other.execute("BEGIN EXCLUSIVE")
    timer = threading.Timer(1.0, lambda: (other.rollback(), other.close()))
    timer.start()
    Store.open("history.sqlite", tmp_path, write=True).close()
    timer.join()


def test_a_reader_waits_for_the_tables_of_a_store_that_is_being_made(tmp_path: Path) -> None:
    """`run` and `serve` are started together: the file is there before its tables."""
    path = tmp_path / "history.sqlite"
    sqlite3.connect(path).close()
    path.touch()
    maker = threading.Timer(0.3, lambda: Store.open(str(path), write=True).close())
    maker.start()
    Store.open(str(path)).close()
    maker.join()
