"""A service file that is read again while blocks come: nothing is lost, counted twice or different."""

from __future__ import annotations

import contextlib
import functools
import json
import os
import signal
import socket
import sqlite3
import subprocess
import sys
from pathlib import Path

import halls
import pytest
from brokers import Running, publisher, started_broker
from brokers import until as wait_until
from halls import RESULTS, asked, hall, service_of
from reliability.servers import Postgres

from servoscope.core.errors import StoreError
from servoscope.service.service import Service
from servoscope.service.store import Store
from servoscope.signals import writers

until = functools.partial(wait_until, seconds=30.0)
YARD = """
[sources.yard]
kind = "replay"
speed = 60.0
block = 0.5
start = 2026-01-01T00:00:00Z
[assets.crane]
baseline = "baseline.json"
source = "yard"
files = ["healthy.csv"]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("hall")
    halls.files(made)
    return made


def told(config: Path, what: str) -> list[dict[str, object]]:
    rows = asked(config, f"SELECT document FROM audit WHERE what = '{what}' ORDER BY id")
    return [json.loads(document) for (document,) in rows]


def reload(service: Service, config: Path, text: str) -> None:
    """Write a service file, and wait until the service has read it."""
    config.write_text(text)
    count = len(told(config, "reloaded")) + 1
    service.reload(config)
    until(lambda: len(told(config, "reloaded")) == count)


@pytest.mark.slow
def test_what_a_reload_leaves_as_it_was_is_the_same_to_the_last_bit(folder: Path) -> None:
    """Assets come, change and go while 240 blocks of two others come; a source that changes goes on where it was."""
    whole, config = hall(folder, "whole"), hall(folder, "loaded", speed=0.5)
    for path in (whole, config):
        text = path.read_text().replace('"healthy.csv", "leaky.csv", "healthy.csv"', '"leaky.csv"')
        path.write_text(text.replace('"healthy.csv", "healthy.csv", "healthy.csv"', '"healthy.csv"'))
    service_of(whole).run()
    first = config.read_text()
    running = Running(service := service_of(config))
    grouped = first.replace("[assets.press]", '[assets.press]\ngroup = "outside"')
    changes = [
        (first + YARD, {"added": ["crane"], "opened": ["yard"]}),
        (first + YARD.replace("block = 0.5", "block = 1.0"), {"opened": ["yard"]}),
        (first, {"removed": ["crane"]}),
        (grouped, {"changed": ["press"]}),
        (first.replace("speed = 0.5", "speed = 0.0"), {"changed": ["press"], "opened": ["line"]}),
    ]
    counted = "SELECT sequence FROM checkpoints WHERE asset = 'press'"
    for text, _ in changes:
        before = asked(config, counted)
        reload(service, config, text)
        until(lambda before=before: asked(config, counted) > before)
    running.end()
    nothing: dict[str, list[str]] = {key: [] for key in ("added", "removed", "changed", "anew", "opened")}
    assert told(config, "reloaded") == [nothing | change for _, change in changes]
    of_two = {name: [row for row in asked(config, query) if row[0] != "crane"] for name, query in RESULTS.items()}
    assert of_two == {name: asked(whole, query) for name, query in RESULTS.items()}
    ((crane,),) = asked(config, "SELECT status FROM checkpoints WHERE asset = 'crane'")
    assert json.loads(crane)["counted"]["lost"] == 0


def test_an_asset_with_another_baseline_begins_anew_and_loses_no_block(folder: Path) -> None:
    config = hall(folder, "relearned", speed=1.0)
    running = Running(service := service_of(config))
    until(lambda: asked(config, "SELECT 1 FROM checkpoints WHERE asset = 'press' AND sequence > 2"))
    other = halls.baseline().model_copy(update={"hash": "0123456789abcdef"})
    other.save(folder / "other.json")
    text = config.read_text().replace("speed = 1.0", "speed = 0.0").replace('"healthy.csv", "leaky.csv", ', "")
    reload(service, config, text.replace('"baseline.json"', '"other.json"', 1))
    running.end()
    (document,) = told(config, "reloaded")
    assert document["changed"] == document["anew"] == ["press"]
    assert asked(config, "SELECT asset FROM audit WHERE what = 'began anew'") == [("press",)]
    for asset, baseline, blocks in (("press", other.hash, 120), ("lift", halls.baseline().hash, 360)):
        ((status,),) = asked(config, f"SELECT status FROM checkpoints WHERE asset = '{asset}'")
        found = json.loads(status)
        assert (found["about"]["baseline"], found["counted"]["lost"]) == (baseline, 0)
        assert (found["counted"]["blocks"], found["counted"]["samples"]) == (blocks, 50 * blocks)


def test_a_source_is_opened_anew_where_what_it_is_told_has_changed(folder: Path) -> None:
    """How far time stamps may be ahead stands outside of its table, and is part of what it is told."""
    config = hall(folder, "ahead", speed=1.0)
    running = Running(service := service_of(config))
    before, text = service.sources["line"], config.read_text()
    reload(service, config, text)
    assert service.sources["line"] is before and told(config, "reloaded")[-1]["opened"] == []
    reload(service, config, text.replace("[service]", "[service]\n        ahead_s = 5.0"))
    assert service.sources["line"] is not before and told(config, "reloaded")[-1]["opened"] == ["line"]
    service.stop()
    running.end()


def test_a_file_that_cannot_be_used_changes_nothing(folder: Path) -> None:
    config = hall(folder, "refused", speed=60.0)
    first = config.read_text()
    running = Running(service := service_of(config))
    components = service._components
    wrong = {
        "nowhere.json": first.replace('"baseline.json"', '"nowhere.json"', 1),
        "there is no source 'yard'": first.replace('source = "line"', 'source = "yard"', 1),
        "[store] url: cannot be changed while the service runs, start it again": first.replace("d.sqlite", ".sqlite"),
        "name: cannot be changed": first.replace('name = "hall"', 'name = "yard"'),
        "refused.toml": first + "[",
    }
    for n, text in enumerate(wrong.values(), 1):
        config.write_text(text)
        service.reload(config)
        until(lambda n=n: len(told_of(folder / "refused.sqlite")) == n)
    assert running.alive and service._components is components
    service.stop()
    running.end()
    for words, why in zip(wrong, told_of(folder / "refused.sqlite"), strict=True):
        assert words in why


def told_of(store: Path) -> list[str]:
    """Return why reloads were refused."""
    with contextlib.closing(sqlite3.connect(store, timeout=10.0)) as connection:
        rows = connection.execute("SELECT document FROM audit WHERE what = 'reload refused' ORDER BY id").fetchall()
    return [json.loads(document)["why"] for (document,) in rows]


@pytest.mark.slow
def test_an_asset_more_at_a_broker_while_blocks_come(tmp_path: Path) -> None:
    """Its source connects anew; the broker keeps what comes meanwhile."""
    broker = started_broker(tmp_path)
    halls.baseline().save(tmp_path / "baseline.json")
    writers.write_recording(tmp_path / "press.csv", halls.recorded(2, halls.LEAK))
    config = tmp_path / "hall.toml"
    press = (
        f'name = "hall"\n[service]\nlisten = ""\nlog = "error"\n[store]\nurl = "hall.sqlite"\nresidual_every_s = 2.0\n'
        f'[sources.line]\nkind = "mqtt"\nhost = "127.0.0.1"\nport = {broker.port}\n'
        '[assets.press]\nbaseline = "baseline.json"\nsource = "line"\n'
    )
    config.write_text(press)
    running = Running(service := service_of(config))
    until(lambda: service.sources["line"].connected)
    sending = Running(publisher(tmp_path, broker.port, speed=3.0))
    for n in range(2):
        count = len(asked(config, "SELECT 1 FROM residuals"))
        until(lambda count=count: len(asked(config, "SELECT 1 FROM residuals")) > count)
        lift = '[assets.lift]\nbaseline = "baseline.json"\nsource = "line"\n'
        reload(service, config, press + lift if n % 2 == 0 else press)
    assert sending.alive  # blocks came all the while
    sending.end()
    until(lambda: service.assets["press"].state.position.blocks == 120)
    running.end(stop=True)
    broker.stop()
    ((status,),) = asked(config, "SELECT status FROM checkpoints WHERE asset = 'press'")
    counted = json.loads(status)["counted"]
    assert (counted["blocks"], counted["samples"], counted["lost"]) == (120, 6000, 0)
    assert [change["opened"] for change in told(config, "reloaded")] == [["line"]] * 2


def test_the_right_to_write_follows_the_assets(postgres: Postgres) -> None:
    ours, theirs = Store.open(postgres.url, write=True), Store.open(postgres.url, write=True)
    ours.acquire_lock(["hall", "press"])
    theirs.acquire_lock(["yard", "crane"])
    with pytest.raises(StoreError, match="another servoscope run follows crane"):
        ours.acquire_lock(["hall", "press", "lift", "crane"])
    theirs.acquire_lock(["yard", "lift"])  # what we could not have whole we do not keep in part
    ours.acquire_lock(["hall", "crane"])
    theirs.acquire_lock(["yard", "lift", "press"])
    for one in (ours, theirs):
        one.close()


def test_systemd_hears_of_start_life_reload_and_stop(folder: Path, tmp_path: Path) -> None:
    config = hall(folder, "told", speed=1.0)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as supervisor:
        supervisor.bind(str(tmp_path / "notify"))
        supervisor.settimeout(120.0)

        def heard(line: str) -> list[str]:
            while line not in (lines := supervisor.recv(4096).decode().split("\n")):
                pass
            return lines

        words = [sys.executable, "-m", "servoscope", "run", str(config)]
        process = subprocess.Popen(words, env=os.environ | {"NOTIFY_SOCKET": str(tmp_path / "notify")})
        try:
            heard("READY=1")
            for _ in range(2):
                heard("WATCHDOG=1")
            process.send_signal(signal.SIGHUP)
            assert any(line.startswith("MONOTONIC_USEC=") for line in heard("RELOADING=1"))
            assert "STATUS=2 assets, all followed" in heard("READY=1")
            config.write_text("[")
            process.send_signal(signal.SIGHUP)
            assert any("STATUS=reload refused" in line for line in heard("READY=1"))
            process.send_signal(signal.SIGTERM)
            heard("STOPPING=1")
            assert process.wait(60.0) == 0
        finally:
            process.kill()
