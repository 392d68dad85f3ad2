"""A store through the years: copied while it is written to, migrated from any version, no larger than it should be."""

from __future__ import annotations

import contextlib
import gzip
import os
import shutil
import sqlite3
import threading
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from commands import one_line, run
from reliability.servers import Postgres

from golden.results import FOLDER
from servoscope.service.config import StoreSettings
from servoscope.service.housekeeping import DAY_S, delete_old_rows
from servoscope.service.store import Batch, Store, schema, tables
from servoscope.service.store import copy as copying
from servoscope.service.store.copy import copy_store
from servoscope.service.store.series import read_notes

BEGAN = 1767225600.0  # 2026-01-01T00:00:00Z
# What each released version of the tables left behind; a new version brings its own.
STORES = {1: "history.sqlite.gz", 2: "history-2.sqlite.gz", 3: "history-3.sqlite.gz", 4: "history-4.sqlite.gz"}


def old_store(folder: Path, version: int) -> Path:
    path = folder / f"version-{version}.sqlite"
    path.write_bytes(gzip.decompress((FOLDER / STORES[version]).read_bytes()))
    return path


def content(url: str) -> dict[str, list[tuple[Any, ...]]]:
    """Return all rows of a store, by table, in the order of their keys."""
    store = Store.open(url)
    with contextlib.closing(store), store.snapshot() as connection:
        chosen = [table for table in tables.METADATA.sorted_tables if sa.inspect(connection).has_table(table.name)]
        return {
            table.name: [tuple(row) for row in connection.execute(sa.select(table).order_by(*table.primary_key))]
            for table in chosen
        }


@pytest.fixture
def empty(postgres: Postgres) -> Iterator[str]:
    """A database without a table."""
    yield postgres.url
    engine = sa.create_engine(postgres.url.replace("postgresql", "postgresql+psycopg"))
    tables.METADATA.drop_all(engine)
    engine.dispose()


def test_a_store_is_kept_of_every_version_that_was_released() -> None:
    assert sorted(STORES) == list(range(schema.FIRST_VERSION, schema.schema_version() + 1))


@pytest.mark.parametrize("version", sorted(STORES))
def test_every_version_is_copied_as_it_is_and_migrated_alike_on_both_databases(
    version: int, tmp_path: Path, empty: str
) -> None:
    old = old_store(tmp_path, version)
    before = content(str(old))
    done = run("store", "restore", str(old), empty)
    assert done.code == 0, done.err
    assert content(empty) == before
    for url in (str(old), empty):
        store = Store.open(url, write=True)
        (index,) = sa.inspect(store._engine).get_indexes("residuals")
        assert index["column_names"] == ["asset", "t", "statistic", "level"]
        store.close()
    after = content(empty)
    assert after == content(str(old))
    assert set(after) == set(tables.METADATA.tables)
    assert ("schema", schema.schema_version()) in after["meta"]
    kept = {name: rows for name, rows in after.items() if name in before and name != "meta"}
    assert kept == {name: rows for name, rows in before.items() if name != "meta"}


def test_the_database_counts_on_behind_what_was_restored(tmp_path: Path, empty: str) -> None:
    restored = Store.open(str(old_store(tmp_path, 2)))
    copy_store(restored, empty)
    restored.close()
    last = content(empty)["audit"][-1][0]
    store = Store.open(empty, write=True)
    store.add_audit("otto", "press", "note", {"t": BEGAN, "text": "oil changed", "anew": False})
    store.close()
    assert content(empty)["audit"][-1][0] == last + 1


def test_a_backup_is_of_one_moment_while_rows_are_written(store: Store, url: str, tmp_path: Path) -> None:
    """Each commit writes one row of two assets; a copy has all of a commit or nothing."""
    stopped = threading.Event()

    def write() -> None:
        for number in range(1, 100_000):
            if stopped.is_set():
                return
            made = Batch()
            made.rows["residuals"] = [
                {"asset": asset, "number": number, "t": BEGAN + number, "statistic": 0.2, "level": 0.1, "residual": []}
                for asset in ("lift", "press")
            ]
            store.write(made, "hall", number)

    writer = threading.Thread(target=write)
    writer.start()
    copies = []
    try:
        for n in range(5):
            while store.last_commit("hall") < 30 * (n + 1):
                pass
            done = run("store", "backup", url, str(tmp_path / f"copy-{n}.sqlite"))
            assert done.code == 0, done.err
            copies.append(content(str(tmp_path / f"copy-{n}.sqlite")))
    finally:
        stopped.set()
        writer.join()
    sizes = []
    for copy in copies:
        ((commits,),) = [(value,) for key, value in copy["meta"] if key == "commit of hall"]
        for asset in ("lift", "press"):
            assert [row[1] for row in copy["residuals"] if row[0] == asset] == list(range(1, commits + 1))
        sizes.append(commits)
    assert sizes == sorted(set(sizes)) and sizes[0] >= 30
    assert sorted(one.name for one in tmp_path.iterdir() if "part" in one.name) == []


DAMAGES = {"deep": 20_000 * "[" + 20_000 * "]", "torn": "{", "bytes": b"\xff\xfe", "nothing": None}


@pytest.mark.parametrize("kind", DAMAGES)
def test_a_damaged_cell_is_copied_or_refused_in_one_line(tmp_path: Path, kind: str) -> None:
    sound, damaged, refused = old_store(tmp_path, max(STORES)), tmp_path / "damaged.sqlite", set[str]()
    columns = [column for table in tables.METADATA.sorted_tables for column in table.columns]
    for column in (one for one in columns if isinstance(one.type, sa.JSON | sa.LargeBinary | sa.Double)):
        shutil.copy(sound, damaged)
        with contextlib.closing(sqlite3.connect(damaged)) as connection, contextlib.suppress(sqlite3.IntegrityError):
            changed = connection.execute(f"UPDATE {column.table.name} SET {column.name} = ?", (DAMAGES[kind],)).rowcount
            connection.commit()
            if changed:
                done = run("store", "restore", damaged, tmp_path / "restored.sqlite")
                if done.code:
                    one_line(done, "damaged.sqlite")
                    refused.add(str(column))
                    assert not (tmp_path / "restored.sqlite").exists()
                (tmp_path / "restored.sqlite").unlink(missing_ok=True)
    assert ("checkpoints.status" in refused) == (kind != "nothing")


def test_a_copy_is_its_owners_alone_from_its_first_byte(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, modes = old_store(tmp_path, max(STORES)), set[int]()
    copy_rows = copying._copy_rows

    def watched(*arguments: Any) -> int:
        modes.update(one.stat().st_mode & 0o777 for one in tmp_path.glob("*.part*"))
        return copy_rows(*arguments)

    monkeypatch.setattr(copying, "_copy_rows", watched)
    before = os.umask(0o000)
    try:
        assert run("store", "backup", source, tmp_path / "backup.sqlite").code == 0
        assert run("store", "restore", tmp_path / "backup.sqlite", tmp_path / "restored.sqlite").code == 0
    finally:
        os.umask(before)
    modes.update((tmp_path / name).stat().st_mode & 0o777 for name in ("backup.sqlite", "restored.sqlite"))
    assert modes == {0o600}


def write_samples(store: Store, commits: int, asset: str, samples: bytes) -> None:
    """Write a block of an asset with each commit."""
    index = store.bundle_index("hall")
    for k in range(commits):
        batch = Batch(bundles=index.advance([(asset, 1_000_000 + k, samples, False)], {}))
        store.write(batch, "hall", store.last_commit("hall") + 1)


def test_a_copy_holds_a_few_rows_of_samples_in_memory(store: Store, tmp_path: Path) -> None:
    """Of a large service each row has megabytes."""
    write_samples(store, 64, "press", bytes(2**18))
    tracemalloc.start()
    try:
        copied = copy_store(store, str(tmp_path / "copy.sqlite"))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert copied["bundles"] == 64
    assert peak < 32 * 2**18


def test_a_reader_sees_the_tables_that_a_service_adds_meanwhile(tmp_path: Path) -> None:
    """After an update the pages may be opened before the service, whose tables are of the version before then."""
    for version in (1, 2):
        path = str(old_store(tmp_path, version))
        with (
            contextlib.closing(Store.open(path)) as reader,
            contextlib.closing(Store.open(path, write=True)) as service,
        ):
            write_samples(service, 1, "press", b"samples")
            assert reader.has_sizes
            assert reader.recent_samples("press")[-1] == (1_000_000, b"samples")


def test_a_copy_never_replaces_a_history(tmp_path: Path, empty: str) -> None:
    backup = old_store(tmp_path, 2)
    there = tmp_path / "there.sqlite"
    shutil.copy(backup, there)
    for words in (("backup", str(backup), str(there)), ("restore", str(backup), str(there))):
        done = run("store", *words)
        assert done.code == 1 and "there.sqlite: exists already, give another name" in one_line(done)
    Store.open(empty, write=True).close()
    done = run("store", "restore", str(backup), empty)
    assert done.code == 1 and "already, give an empty database" in one_line(done)
    done = run("store", "backup", str(backup), str(tmp_path / "nowhere" / "copy.sqlite"))
    assert done.code == 1 and "nowhere does not exist" in one_line(done)


def months_of(store: Store, settings: StoreSettings, size: Any) -> list[int]:
    """Write 90 days, with the retention of each day, and return the size after every ninth [bytes]."""
    sizes, number = [], 0
    for day in range(90):
        t, made = BEGAN + day * DAY_S, Batch()
        rows = range(number, number := number + 20)
        common = {"asset": "press", "t": t}
        made.rows["residuals"] = [
            {**common, "number": n, "statistic": 0.2, "level": 0.1, "residual": [[1.0, 0.1, 0.2, 3.0]] * 30}
            for n in rows
        ]
        made.rows["diagnoses"] = [
            {**common, "number": number, "grounds": "full", "verdict": "fault", "summary": "", "onset": t,
             "document": {"text": "x" * 2000}}
        ]  # fmt: skip
        made.rows["audit"] = [
            {"asset": "press", "at": t, "who": "service", "what": "refused", "document": {"why": "y" * 2000}}
        ]
        made.rows["outbox"] = [
            {"key": f"{day}", "sink": "desk", "event": {"service": "hall", "text": "z" * 2000}, "created": t,
             "due": None, "attempts": 1, "outcome": "200"}
        ]  # fmt: skip
        store.write(made, "hall", day + 1)
        delete_old_rows(store, settings, "hall", {"press": t}, t)
        if day % 9 == 8:
            sizes.append(size())
    return sizes


def test_the_disk_stays_as_small_as_the_retention_says(store: Store, url: str, tmp_path: Path) -> None:
    """After a while it grows no more."""

    def size() -> int:
        if not url.startswith("postgresql"):
            return sum(path.stat().st_size for path in tmp_path.glob("history.sqlite*") if "wal" not in path.name)
        engine = sa.create_engine(url.replace("postgresql", "postgresql+psycopg"), isolation_level="AUTOCOMMIT")
        with engine.connect() as connection:
            connection.execute(sa.text("VACUUM"))  # what the server does by itself every minute
            found = [
                connection.execute(sa.text(f"SELECT pg_total_relation_size('{name}')")).scalar_one()
                for name in ("residuals", "diagnoses", "audit", "outbox")
            ]
        engine.dispose()
        return sum(found)

    kept = StoreSettings.model_validate({"residual_days": 9.0, "event_days": 9.0})
    sizes = months_of(store, kept, size)
    assert max(sizes[3:]) <= 1.1 * max(sizes[:3])  # where all were kept, it would be the triple
    found = content(url)
    assert {name: len(found[name]) for name in ("residuals", "diagnoses", "audit", "outbox")} == {
        "residuals": 10 * 20, "diagnoses": 10, "audit": 10, "outbox": 10
    }  # fmt: skip


def test_what_is_still_needed_stays(store: Store, url: str) -> None:
    """Notes, what is still to be delivered or executed, other services' rows; of an asset that has gone nothing old."""
    now, old = BEGAN + 100 * DAY_S, BEGAN
    made = Batch()
    event = {"key": "", "sink": "desk", "created": old, "attempts": 0, "outcome": ""}
    made.rows["outbox"] = [
        {**event, "key": "due", "event": {"service": "hall"}, "due": old},
        {**event, "key": "theirs", "event": {"service": "yard"}, "due": None},
        {**event, "key": "done", "event": {"service": "hall"}, "due": None},
    ]
    audit = {"who": "otto", "document": {"t": old, "text": "pump replaced", "anew": True}, "at": old}
    made.rows["audit"] = [
        {**audit, "asset": "press", "what": "note"},
        {**audit, "asset": "press", "what": "refused"},
        {**audit, "asset": "crane", "what": "refused"},
    ]
    numbers = {"number": 1, "t": old, "statistic": 0.2, "level": 0.1, "residual": []}
    made.rows["residuals"] = [{"asset": asset, **numbers} for asset in ("gone", "paused", "crane")]
    for asset, at in (("gone", old), ("paused", now - 10 * DAY_S), ("crane", now)):
        made.checkpoints[asset] = {"asset": asset, "sequence": 0, "state": b"x", "status": {}, "at": at}
    store.write(made, "hall", 1)
    asked = store.add_command("otto", "press", "fault", "acknowledge")
    settings = StoreSettings.model_validate({"residual_days": 30.0, "event_days": 30.0})
    counts = delete_old_rows(store, settings, "hall", {"press": now}, now)
    assert counts == {"residuals": 1, "audit": 1, "outbox": 1}
    found = content(url)
    assert [row[0] for row in found["outbox"]] == ["due", "theirs"]
    assert [row[0] for row in found["residuals"]] == ["crane", "paused"]
    assert [(row[3], row[4]) for row in found["audit"]] == [("press", "note"), ("crane", "refused")]
    assert [row["text"] for row in read_notes(store, "press")] == ["pump replaced"]
    assert [row["id"] for row in store.pending_commands()] == [asked]
    assert delete_old_rows(store, StoreSettings(), "hall", {"press": now}, now) == {}
