"""Secrets planted in a service with real servers: none is in its log, store, pages, metrics, reports and files."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import halls
import httpx
import pytest
import sqlalchemy as sa
from brokers import until
from browsing import FOUND, SOURCE, finished, login
from opcua_plant import NODES
from reliability.servers import Mosquitto, Postgres, mosquitto

from servoscope.service.access import Users

SECRET = "hush0"  # followed by two digits: each says where it was planted
PASSWORD = f"{SECRET}10 of an engineer"
ENVIRONMENT = {"DESK_SECRET": f"{SECRET}11", "PGSSLPASSWORD": f"{SECRET}12"}
PASSWORD_FILES = {"bus": f"{SECRET}21", "wall": f"{SECRET}22", "bell": f"{SECRET}23", "cell": f"{SECRET}24"}
SERVICE = """
name = "hall"
[service]
listen = "127.0.0.1:{health}"
commit_every_s = 0.1
log = "debug"
[store]
url = "{store}"
[diagnosis]
window_s = 40.0
after_s = 1.0
[web]
listen = "127.0.0.1:0"
users = "users.json"
[sources.line]
kind = "replay"
speed = 20.0
repeat = true
[sources.bus]
kind = "mqtt"
host = "127.0.0.1"
port = {broker}
user = "servo"
password_file = "bus.password"
[sources.cell]
kind = "opcua"
url = "opc.tcp://servo:hush031@127.0.0.1:{plant}/hush032?token=hush033"
user = "servo"
password_file = "cell.password"
[outlets.wall]
kind = "mqtt"
host = "127.0.0.1"
port = {broker}
user = "stranger"
password_file = "wall.password"
[actions.retry]
first_s = 0.1
[actions.webhook.desk]
url = "http://servo:hush041@127.0.0.1:{desk}/hush042?token=hush043"
secret_env = "DESK_SECRET"
[actions.webhook.gone]
url = "http://servo:hush044@127.0.0.1:{gone}/hush045?token=hush046"
secret_file = "gone.secret"
[actions.mqtt.bell]
topic = "bell"
broker = {{ host = "127.0.0.1", port = {broker}, user = "stranger", password_file = "bell.password" }}
[assets.press]
baseline = "baseline.json"
source = "line"
files = ["healthy.csv", "leaky.csv"]
[assets.lift]
baseline = "baseline.json"
source = "bus"
[assets.crane]
baseline = "baseline.json"
source = "cell"
nodes = {{ r = "{r}", u = "{u}", y = "{y}" }}
"""


@pytest.fixture
def desk() -> Iterator[ThreadingHTTPServer]:
    """A receiver that refuses, and says in its answer what it was sent."""

    class Echo(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(500, f"refused {self.path}")
            self.end_headers()
            self.wfile.write(f"{self.path} {self.headers}".encode())

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Echo)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    """A broker with one user."""
    program = mosquitto()
    if program is None or shutil.which("mosquitto_passwd") is None:
        pytest.skip("mosquitto is not on this machine: scripts/install-test-servers installs it")
    folder = tmp_path / "broker"
    folder.mkdir()
    known = ["mosquitto_passwd", "-b", "-c", str(folder / "users"), "servo", PASSWORD_FILES["bus"]]
    subprocess.run(known, check=True)
    server = Mosquitto(folder, program, f"password_file {folder / 'users'}", "allow_anonymous false")
    server.start()
    yield server
    server.stop()


@pytest.fixture
def plant() -> Iterator[int]:
    """The port of an OPC UA server, which lets everybody in."""
    port = free_port()
    words = [
        sys.executable,
        str(Path(__file__).parents[1] / "support" / "opcua_plant.py"),
        str(port),
        str(time.time()),
        "20",
    ]
    process = subprocess.Popen([*words, "nothing"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert process.stdout is not None and process.stdout.readline()
    yield port
    process.kill()
    process.wait()
    process.stdout.close()


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


def visit(url: str, health: int, leaky: bytes) -> list[str]:
    """Return all that pages, metrics and reports say to a user who is logged in, and to one who is not."""
    planted = {"Authorization": f"Bearer {SECRET}51", "X-Api-Key": f"{SECRET}52", "Cookie": f"other={SECRET}53"}
    said = []
    with httpx.Client(base_url=f"{url}/api/v1", timeout=60.0) as client:
        for path in ("/assets", "/session", f"/assets?token={SECRET}54"):
            said.append(client.get(path, headers=planted).text)
        said.append(login(client, "nobody", f"{SECRET}56 is a guess").text)
        assert login(client, "enno", PASSWORD).status_code == 200
        sent = client.post(
            "/uploads?name=leaky.csv", content=leaky, headers={"Content-Type": "application/octet-stream"}
        )
        asked = {"upload": sent.json()["id"], "baseline": "service:press"}
        diagnosis = finished(client, client.post("/diagnoses", json=asked))["result"]["diagnosis"]
        described = client.get("/openapi.json").json()["paths"]
        plain = [
            path for path, one in described.items() if "get" in one and "{" not in path and not path.endswith("/live")
        ]
        paths = [path.removeprefix("/api/v1") for path in plain]
        paths += [
            f"/assets/{name}{part}" for name in ("press", "lift", "crane") for part in ("", "/alarms", "/signals")
        ]
        paths += [f"/diagnoses/{diagnosis}", f"/diagnoses/{diagnosis}/report", f"/uploads/{sent.json()['id']}"]
        for path in paths:
            answer = client.get(path)
            assert answer.status_code < 500, path
            said.append(answer.text.replace(client.headers["X-CSRF-Token"], ""))
        said += [
            client.get(f"{url}{path}").text for path in ("/metrics", "/health/live", "/health/ready", "/", "/none")
        ]
    said += [httpx.get(f"http://127.0.0.1:{health}{path}").text for path in ("/metrics", "/health/ready", "/other")]
    return said


def read_store(url: str) -> str:
    """Return everything that is in a database."""
    engine = sa.create_engine(url.replace("postgresql", "postgresql+psycopg"))
    metadata = sa.MetaData()
    metadata.reflect(engine)
    with engine.connect() as connection:
        rows = [tuple(row) for table in metadata.tables.values() for row in connection.execute(sa.select(table))]
    engine.dispose()
    assert len(rows) > 20
    return "\n".join(map(repr, rows))


def failed_sinks(config: Path) -> set[str]:
    """Return the sinks at which attempts have failed."""
    lines = command("history", config, "--kind", "deliveries", "--json").splitlines()
    return {row["sink"] for row in map(json.loads, lines) if row["attempts"]}


def command(*words: object) -> str:
    """Return what a command says, on both streams."""
    environment = os.environ | {"PYTHONPATH": str(SOURCE)}
    argv = [sys.executable, "-m", "servoscope", *map(str, words)]
    done = subprocess.run(argv, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


@pytest.mark.slow
def test_no_secret_is_told_by_a_service_with_real_servers(
    tmp_path: Path, postgres: Postgres, broker: Mosquitto, plant: int, desk: ThreadingHTTPServer
) -> None:
    folder = tmp_path / "hall"
    halls.files(folder)
    for name, secret in PASSWORD_FILES.items():
        (folder / f"{name}.password").write_text(f"{secret}\n")
    (folder / "gone.secret").write_text(f"{SECRET}13")
    Users(folder / "users.json").add("enno", "engineer", PASSWORD)
    host = postgres.url.removeprefix("postgresql://").rpartition("@")[2]
    user = postgres.url.removeprefix("postgresql://").partition("@")[0].partition(":")[0]
    store = f"postgresql://{user}:{SECRET}14@{host}{'&' if '?' in host else '?'}sslpassword={SECRET}15"
    health, nodes = free_port(), {name: NODES[name] for name in "ruy"}
    ports = {"broker": broker.port, "plant": plant, "desk": desk.server_port, "gone": free_port(), "health": health}
    (folder / "hall.toml").write_text(SERVICE.format(store=store, **ports, **nodes))
    log = folder / "service.log"
    environment = os.environ | ENVIRONMENT | {"PYTHONPATH": str(SOURCE), "NO_PROXY": "*"}
    words = [sys.executable, "-m", "servoscope", "run", "hall.toml"]
    with log.open("wb") as stderr:
        process = subprocess.Popen(words, cwd=folder, env=environment, stderr=stderr)
    try:

        def address() -> str:
            assert process.poll() is None, log.read_text()
            return next((found[1] for line in log.read_text().splitlines() if (found := FOUND.match(line))), "")

        url = until(address, 120.0)
        until(lambda: failed_sinks(folder / "hall.toml") == {"desk", "gone", "bell"}, 120.0)
        said = visit(url, health, (folder / "leaky.csv").read_bytes())
        shown = [command("watch", folder / "hall.toml", "--once")]
        shown += [command("history", folder / "hall.toml", "--kind", kind) for kind in ("deliveries", "audit")]
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(60)
    texts: dict[str, str] = {"log": log.read_text(), "store": read_store(postgres.url), "pages": "\n".join(said)}
    texts |= {f"command {k}": text for k, text in enumerate(shown)}
    planted = {"hall.toml", "users.json", "gone.secret", *(f"{name}.password" for name in PASSWORD_FILES)}
    texts |= {
        str(path): path.read_bytes().decode("latin-1")
        for path in folder.rglob("*")
        if path.is_file() and path.name not in planted
    }
    told = {name: sorted(set(re.findall(rf".{{60}}{SECRET}\d\d|{SECRET}\d\d", text))) for name, text in texts.items()}
    assert {name: found for name, found in told.items() if found} == {}
    assert "Traceback" not in texts["log"]
