"""A service whose assets are shared out among processes: the same results, one address, one end."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import halls
import pytest
import sqlalchemy as sa
from reliability.servers import Postgres

from servoscope.core.errors import ConfigError, StoreError
from servoscope.service.build import build_components
from servoscope.service.config import ServiceFile, shard_number
from servoscope.service.health import serve_health
from servoscope.service.service import Service
from servoscope.service.store import Store
from servoscope.service.store.tables import meta
from servoscope.service.workers import WorkerPool, _Follower, merge_metrics

WORKERS = 'listen = "127.0.0.1:0"\nworkers = 2'
SHARED = {key: query.replace("<> 'hall'", "NOT LIKE 'hall%'") for key, query in halls.RESULTS.items()}


def shared_hall(folder: Path, name: str, speed: float, more: str = "") -> Path:
    """Write the service file of `halls.hall` for two workers."""
    path = halls.hall(folder, name, speed=speed, more=more)
    path.write_text(path.read_text(encoding="utf-8").replace('listen = ""', WORKERS), encoding="utf-8")
    return path


def until(condition: Callable[[], object], seconds: float = 120.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it never came"
        time.sleep(0.1)


def processes(config: Path) -> dict[str, int]:
    """Return the processes of a service file: their ids by the number of the worker, as they were started."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            words = (folder / "cmdline").read_bytes().decode().split("\0")
        except OSError:
            continue
        if "--worker" in words and str(config) in words:
            found[words[words.index("--worker") + 1]] = int(folder.name)
    return found


def answer(port: int, path: str) -> str:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=30.0) as found:
        return str(found.read().decode())


def is_ready(port: int) -> bool:
    try:
        return bool(json.loads(answer(port, "/health/ready"))["ok"])
    except OSError:
        return False


def test_which_worker_follows_an_asset_never_changes() -> None:
    # CRC-32 of the name, modulo the number of workers: what a change of the rule would move is in stores and sessions
    assert [shard_number(name, 2) for name in ("press", "lift")] == [1, 0]
    assert [shard_number(name, 3) for name in ("axis1", "b", "c")] == [0, 2, 0]


def test_shards_are_the_whole(tmp_path: Path) -> None:
    halls.files(tmp_path)
    sink = '[actions.command.horn]\nargv = ["true"]\nassets = ["hall", "press"]'
    whole = ServiceFile.load(shared_hall(tmp_path, "hall", 0.0, sink))
    parts = {number: whole.shard(number) for number in whole.shard_numbers()}
    assert {number: list(part.assets) for number, part in parts.items()} == {0: ["lift"], 1: ["press"]}
    assert parts[1].name == "hall.1" and parts[1].web is None
    assert parts[1].actions.command["horn"].assets == ("hall.1", "press")  # what a sink hears of the service itself
    assert len({name for part in parts.values() for name in part.client_names().values()}) == 2
    changed = whole.model_copy(update={"service": whole.service.model_copy(update={"workers": 3})})
    with pytest.raises(ConfigError, match="workers: cannot be changed while"):
        whole.check_fixed(changed)


@pytest.mark.parametrize(
    ("more", "why"),
    [
        ('[sources.far]\nkind = "mqtt"\nhost = "localhost"\nclient = "me"', r"\[sources\] far.client: leave it out"),
        ('[outlets.far]\nkind = "opcua"', r"\[outlets\] far: one process has its address"),
    ],
)
def test_what_processes_cannot_share_is_refused(tmp_path: Path, more: str, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        ServiceFile.load(shared_hall(tmp_path, "hall", 0.0, more))


def test_metrics_of_workers_add_up_to_those_of_one_service() -> None:
    head, up = "# HELP a_total x\n# TYPE a_total counter\n", "# HELP servoscope_store_up x\nservoscope_store_up"
    one = f'{head}a_total{{asset="p"}} 1.0\n{up} 1.0\n'
    two = f'{head}a_total{{asset="q"}} 2.0\na_total{{asset="p"}} 4.0\n{up} 0.0\n'
    assert merge_metrics([one, two]).splitlines() == [
        "# HELP a_total x",
        "# TYPE a_total counter",
        'a_total{asset="p"} 5.0',
        'a_total{asset="q"} 2.0',
        "# HELP servoscope_store_up x",
        "servoscope_store_up 0.0",  # it is up where all say so
    ]


def test_a_worker_that_loses_its_last_asset_has_nothing_left_to_do(tmp_path: Path) -> None:
    halls.files(tmp_path)
    config = shared_hall(tmp_path, "hall", 0.0)
    part = ServiceFile.load(config).shard(1)
    service = Service(part, build_components(part))
    assert list(service.assets) == ["press"]
    before, after = config.read_text(encoding="utf-8").split("[assets.press]")
    config.write_text(before + after[after.index("[assets.lift]") :], encoding="utf-8")
    service.reload(config)
    service.run()
    assert not service.assets


def test_a_worker_that_ends_while_it_answers_does_not_end_the_others(tmp_path: Path) -> None:
    config = shared_hall(tmp_path, "hall", 0.0)
    worker = _Follower(ServiceFile.load(config), config, 0, (), ())
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer_half() -> None:
            with server.accept()[0] as one:
                one.recv(4096)
                one.sendall(b'HTTP/1.0 200 OK\r\nContent-Length: 100\r\n\r\n{"ok"')

        thread = threading.Thread(target=answer_half)
        thread.start()
        worker._take_address(f"127.0.0.1:{server.getsockname()[1]}")
        with pytest.raises(OSError, match="no answer"):
            worker.ask("/health/live")
        thread.join()


@pytest.mark.slow
def test_shards_say_what_one_process_says_although_one_is_killed(tmp_path: Path) -> None:
    halls.files(tmp_path)
    alone, config = halls.hall(tmp_path, "alone"), shared_hall(tmp_path, "shared", 12.0)
    halls.service_of(alone).run()
    pool = WorkerPool(ServiceFile.load(config), config)
    server, thread = serve_health(pool.health_report(), "127.0.0.1:0"), threading.Thread(target=pool.run)
    port = int(server.server_address[1])
    thread.start()
    try:
        until(lambda: is_ready(port))
        until(lambda: all(f'blocks_total{{asset="{name}"}}' in answer(port, "/metrics") for name in ("press", "lift")))
        with pytest.raises(StoreError, match="another servoscope run writes to it"):
            Store.open("shared.sqlite", tmp_path, write=True).acquire_lock(["crane"])
        before = processes(config)
        os.kill(before["1"], signal.SIGKILL)
        until(lambda: processes(config).get("1", before["1"]) != before["1"])
        assert processes(config)["0"] == before["0"]
    finally:
        thread.join(300.0)
        pool.stop()
        thread.join()
        server.shutdown()
        server.server_close()
    for what, query in SHARED.items():
        assert halls.asked(config, query) == halls.asked(alone, query), what


@pytest.mark.slow
def test_workers_end_with_their_service(tmp_path: Path) -> None:
    halls.files(tmp_path)
    config = shared_hall(tmp_path, "hall", 1.0)
    words = [sys.executable, "-m", "servoscope", "run", str(config)]

    def run_until_both_have_begun() -> subprocess.Popen[bytes]:
        process = subprocess.Popen(words)
        until(lambda: len(processes(config)) == 2 or process.poll() is not None)
        assert process.poll() is None
        return process

    process = run_until_both_have_begun()
    process.kill()
    process.wait()
    until(lambda: not processes(config))  # nobody is left who could write beside the next one
    process = run_until_both_have_begun()
    until(lambda: len(halls.asked(config, "SELECT * FROM audit WHERE what = 'started'")) >= 2)
    process.terminate()
    assert process.wait(60.0) == 0
    assert not processes(config)


def test_a_worker_that_has_not_begun_is_spared_signals_and_begins_anew_once_more(tmp_path: Path) -> None:
    config = shared_hall(tmp_path, "hall", 0.0)
    worker, sent = _Follower(ServiceFile.load(config), config, 1, ("press",), ()), list[int]()
    worker.supervisor.send_signal = sent.append  # type: ignore[method-assign]
    assert worker._command()[-2:] == ["--anew", "press"]
    worker.reload()
    worker._take_address("")  # it was killed before it began
    assert worker._command()[-2:] == ["--anew", "press"] and not sent
    worker._take_address("127.0.0.1:1")
    assert sent == [signal.SIGHUP]
    assert "--anew" not in worker._command()  # its new state is stored
    worker._take_address("-")  # one that listens nowhere says so
    worker.reload()
    assert sent == 2 * [signal.SIGHUP]


@pytest.mark.slow
def test_a_service_file_that_is_read_again_while_workers_start_ends_none_of_them(tmp_path: Path) -> None:
    halls.files(tmp_path)
    config, told = shared_hall(tmp_path, "hall", 1.0), tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(told))
        systemd.settimeout(120.0)
        words = [sys.executable, "-m", "servoscope", "run", str(config), "--anew", "press"]
        process = subprocess.Popen(words, env={**os.environ, "NOTIFY_SOCKET": str(told)})
        try:
            until(lambda: len(processes(config)) == 2)
            before = processes(config)
            os.kill(process.pid, signal.SIGHUP)
            heard = ""
            while "READY=1" not in heard or "RELOADING=1" not in heard:
                heard += systemd.recv(4096).decode()
            until(lambda: len(halls.asked(config, "SELECT * FROM audit WHERE what = 'reloaded'")) == 2)
            assert processes(config) == before
        finally:
            process.terminate()
            assert process.wait(60.0) == 0


@pytest.mark.slow
def test_workers_of_a_server_count_what_one_process_counts(tmp_path: Path, postgres: Postgres) -> None:
    halls.files(tmp_path)
    alone, config = halls.hall(tmp_path, "alone"), shared_hall(tmp_path, "shared", 0.0)
    config.write_text(config.read_text(encoding="utf-8").replace("shared.sqlite", postgres.url), encoding="utf-8")
    halls.service_of(alone).run()
    WorkerPool(ServiceFile.load(config), config).run()
    with closing(Store.open(postgres.url)) as found, closing(Store.open("alone.sqlite", tmp_path)) as expected:
        for name in ("press", "lift"):
            one, other = (each.checkpoints([name])[name] for each in (found, expected))
            assert one["state"] == other["state"] and one["status"] == other["status"], name
        owners = {row["key"] for row in found.fetch(sa.select(meta))}
    assert {"commit of hall.0", "commit of hall.1"} <= owners  # each wrote its own
