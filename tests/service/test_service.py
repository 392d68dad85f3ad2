"""The service against everything that happens to a process in months: killed, stopped, no disk, no database."""

from __future__ import annotations

import json
import os
import random
import resource
import signal
import sqlite3
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import halls
import pytest
import sqlalchemy as sa
from halls import RESULTS, asked, hall, recent_rows, service_of
from reliability.carrying import Carrier
from reliability.servers import Postgres

from servoscope.core.errors import StoreError
from servoscope.service.build import build_components
from servoscope.service.config import ServiceFile
from servoscope.service.health import serve_health


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("hall")
    halls.files(made)
    return made


@pytest.fixture(scope="module")
def whole(folder: Path) -> dict[str, list[object]]:
    """What an uninterrupted run leaves behind."""
    config = hall(folder, "whole")
    service_of(config).run()
    return {name: asked(config, query) for name, query in RESULTS.items()}


@pytest.fixture(scope="module")
def carrier(folder: Path) -> Iterator[Carrier]:
    with Carrier(hall(folder, "warm")) as started:
        yield started


def test_an_uninterrupted_run_says_what_is_there(whole: dict[str, list[object]], folder: Path) -> None:
    config = folder / "whole.toml"
    diagnoses = asked(config, "SELECT asset, grounds, verdict, summary, onset FROM diagnoses ORDER BY t, number")
    assert {row[:3] for row in diagnoses if row[0] == "lift"} == {("lift", "examination", "healthy")}
    full, again = [row for row in diagnoses if row[1] == "full"]
    assert full[0] == "press" and full[2] == "fault" and "leakage" in full[3]
    assert again[0] == "press" and "healthy again since" in again[3]  # the leak ends in its window
    began = ServiceFile.load(config).sources["line"].start
    assert began is not None and full[4] - began.timestamp() == pytest.approx(60.02 + 30.0, abs=0.6)
    (alarm,) = asked(config, "SELECT asset, alarm, t FROM transitions WHERE after = 'unacknowledged'")
    assert alarm[:2] == ("press", "fault") and 0.0 < alarm[2] - full[4] < 3.0
    # rows of an asset are numbered without a gap, over all tables
    for asset in ("press", "lift"):
        tables = " UNION ALL ".join(
            f"SELECT number FROM {name} WHERE asset = '{asset}'" for name in ("residuals", "diagnoses", "transitions")
        )
        numbers = sorted(number for (number,) in asked(config, tables))
        assert numbers == list(range(1, len(numbers) + 1))


@pytest.mark.slow
def test_killed_at_any_of_20_moments_every_block_counts_once(
    folder: Path, whole: dict[str, list[object]], carrier: Carrier
) -> None:
    cut, chance = hall(folder, "cut", speed=15.0), random.Random(7)
    for _ in range(20):
        process = carrier.start(cut)
        time.sleep(chance.uniform(0.0, 0.5))
        carrier.kill(process)
    killed_at = dict(asked(cut, "SELECT asset, sequence FROM checkpoints"))["press"]
    assert killed_at > 20  # of 360: the kills were spread over the run
    carrier.start(hall(folder, "cut"))
    assert carrier.wait() == 0
    assert {name: asked(cut, query) for name, query in RESULTS.items()} == whole


def test_a_stop_is_clean_and_the_next_run_goes_on(folder: Path, whole: dict[str, list[object]]) -> None:
    config = hall(folder, "stopped", speed=60.0)
    service = service_of(config)
    threading.Timer(0.7, service.stop).start()
    service.run()
    sequences = dict(asked(config, "SELECT asset, sequence FROM checkpoints WHERE asset <> 'hall'"))
    assert all(0 < sequence < 359 for sequence in sequences.values())
    service_of(hall(folder, "stopped")).run()
    assert {name: asked(config, query) for name, query in RESULTS.items()} == whole
    told = asked(config, "SELECT what FROM audit ORDER BY id")
    assert [what for (what,) in told] == ["started", "stopped", "started", "stopped"]


def test_a_locked_database_is_waited_for_within_bounds(folder: Path, whole: dict[str, list[object]]) -> None:
    config = hall(folder, "locked", speed=100.0, more="[alarms.buffering]\non_delay_s = 0.0\noff_delay_s = 0.0")
    config.write_text(config.read_text().replace("[service]", "[service]\nbuffer = 40"))
    service = service_of(config)
    running = threading.Thread(target=service.run)
    running.start()
    while service.writer._number < 3:
        time.sleep(0.01)
    with sqlite3.connect(folder / "locked.sqlite", isolation_level=None) as other:
        other.execute("BEGIN IMMEDIATE")
        while service.unready_reason == "":
            time.sleep(0.01)
        time.sleep(1.5)  # three times as long as the buffer lasts
        assert service.writer.waiting == 40  # and not one more: the source has to wait
        assert "40 blocks wait" in service.unready_reason
        other.execute("ROLLBACK")
    running.join(60.0)
    assert not running.is_alive() and service.unready_reason == ""
    results = {name: asked(config, query) for name, query in RESULTS.items()}
    results["transitions"] = [row for row in results["transitions"] if row[0] != "hall"]
    assert results == whole
    own = asked(config, "SELECT after FROM transitions WHERE asset = 'hall' ORDER BY number")
    assert own[0] == ("unacknowledged",)
    (told,) = asked(config, "SELECT document FROM audit WHERE what = 'store was unavailable'")
    assert json.loads(told[0])["seconds"] > 1.0


def worked(process: int) -> float:
    """Return the processor time of a process [s]."""
    fields = Path(f"/proc/{process}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@pytest.mark.slow
def test_a_full_disk_is_waited_for(folder: Path, whole: dict[str, list[object]], carrier: Carrier) -> None:
    config = hall(folder, "full", speed=60.0)
    process = carrier.start(config)
    while not asked(config, "SELECT 1 FROM checkpoints WHERE sequence > 20"):
        time.sleep(0.01)
    # from now on no file may grow: what a full disk says to a process, even to root's
    resource.prlimit(process, resource.RLIMIT_FSIZE, (100_000, resource.RLIM_INFINITY))
    begun, until = worked(process), time.monotonic() + 30.0
    time.sleep(1.0)
    while worked(process) < begun + 0.2 and time.monotonic() < until:  # on a busy machine a second is not enough to try
        time.sleep(0.05)
    before = asked(config, "SELECT asset, sequence FROM checkpoints")
    time.sleep(0.5)
    assert asked(config, "SELECT asset, sequence FROM checkpoints") == before
    resource.prlimit(process, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    assert carrier.wait() == 0
    assert {name: asked(config, query) for name, query in RESULTS.items()} == whole
    assert asked(config, "SELECT 1 FROM audit WHERE what = 'store was unavailable'")


@pytest.mark.slow
def test_postgresql_killed_and_crashed_says_the_same(
    folder: Path, whole: dict[str, list[object]], carrier: Carrier, postgres: Postgres
) -> None:
    config, chance = hall(folder, "pg", speed=15.0, store=postgres.url), random.Random(3)
    for turn in range(12):
        process = carrier.start(config)
        time.sleep(chance.uniform(0.0, 0.3))
        if turn % 4 == 3:  # the database is gone in the middle of it all, and comes back
            postgres.stop("immediate")
            postgres.start()
            time.sleep(0.3)
        carrier.kill(process)
    carrier.start(hall(folder, "pg", store=postgres.url))
    assert carrier.wait() == 0
    engine = sa.create_engine(postgres.url.replace("postgresql", "postgresql+psycopg"))
    with engine.connect() as connection:
        for name, query in RESULTS.items():
            rows = recent_rows(postgres.url) if name == "recent" else connection.execute(sa.text(query))
            found = [tuple(plain(cell) for cell in row) for row in rows]
            assert found == [tuple(plain(cell) for cell in row) for row in whole[name]], name
    engine.dispose()


def plain(cell: object) -> object:
    """JSON is text in SQLite, and whatever it means in PostgreSQL."""
    if isinstance(cell, str) and cell[:1] in "{[":
        return json.loads(cell)
    return bytes(cell) if isinstance(cell, memoryview) else cell


def test_one_store_has_one_writer(folder: Path) -> None:
    first = build_components(ServiceFile.load(hall(folder, "claimed")))
    with pytest.raises(StoreError, match="another servoscope run writes to it, stop it first"):
        build_components(ServiceFile.load(folder / "claimed.toml"))
    first.store.close()
    build_components(ServiceFile.load(folder / "claimed.toml")).store.close()


def test_a_webhook_is_told_once_and_after_a_restart(folder: Path) -> None:
    heard: list[tuple[str, dict[str, object]]] = []

    class Desk(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            heard.append((self.headers["Idempotency-Key"], json.loads(body)))
            self.send_response(503 if len(heard) == 1 else 204)  # it has to be asked twice
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    desk = HTTPServer(("127.0.0.1", 0), Desk)
    threading.Thread(target=desk.serve_forever, daemon=True).start()
    try:
        url = f"http://127.0.0.1:{desk.server_address[1]}"
        more = f'[actions.retry]\nfirst_s = 0.1\n[actions.webhook.desk]\nurl = "{url}"'
        config = hall(folder, "hook", more=more)
        service_of(config).run()  # it ends while the second try is not due, perhaps
        deadline = time.monotonic() + 30.0
        while asked(config, "SELECT 1 FROM outbox WHERE due IS NOT NULL") and time.monotonic() < deadline:
            service_of(config).run()
        (key, first), *others = heard
        ((again, event),) = [one for one in others if one[0] == key]
        assert key == again and first == event
        assert (event["asset"], event["alarm"], event["after"]) == ("press", "fault", "unacknowledged")
        # and once more when the full diagnosis says which fault it is
        ((named, diagnosed),) = [one for one in others if one[0] != key]
        assert (diagnosed["event"], diagnosed["after"]) == ("diagnosed", "unacknowledged")
        assert [one["name"] for one in diagnosed["details"]["faults"]] == ["leakage"]  # type: ignore[index]
        stored = asked(config, "SELECT key, attempts, outcome FROM outbox")
        assert sorted(stored) == sorted([(key, 2, "answered 204"), (named, 1, "answered 204")])
    finally:
        desk.shutdown()
        desk.server_close()


def test_health_and_metrics(folder: Path) -> None:
    config = hall(folder, "served", speed=50.0)
    service = service_of(config)
    server = serve_health(service.health_report(), "127.0.0.1:0")
    running = threading.Thread(target=service.run)
    running.start()
    try:
        while not asked(config, "SELECT 1 FROM checkpoints WHERE asset = 'press' AND sequence > 20"):
            time.sleep(0.01)
        root = f"http://127.0.0.1:{server.server_address[1]}"
        for path in ("/health/live", "/health/ready"):
            with urllib.request.urlopen(root + path, timeout=5.0) as answer:
                assert json.load(answer)["ok"]
        with urllib.request.urlopen(root + "/metrics", timeout=5.0) as answer:
            lines = dict(line.rsplit(" ", 1) for line in answer.read().decode().splitlines() if line[0] != "#")
        assert float(lines['servoscope_blocks_total{asset="press"}']) > 10
        assert lines['servoscope_lost_total{asset="press"}'] == "0.0"
        assert lines["servoscope_store_up"] == "1.0"
        assert float(lines["servoscope_latency_seconds_count"]) > 10
        service.stop()
        with pytest.raises(urllib.error.HTTPError, match="503"):
            urllib.request.urlopen(root + "/health/ready", timeout=5.0)
    finally:
        service.stop()
        running.join(30.0)
        server.shutdown()
        server.server_close()


def test_the_command_stops_on_sigterm(folder: Path) -> None:
    config = hall(folder, "command", speed=1.0)
    words = [sys.executable, "-m", "servoscope", "run", str(config)]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True, env=os.environ)
    while not (folder / "command.sqlite").exists() or not asked(config, "SELECT 1 FROM sqlite_master"):
        time.sleep(0.05)
    time.sleep(1.0)
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=30.0)
    assert process.returncode == 0, said
