"""Clients that are slow, silent or many, over real sockets: each of them is closed, and health is answered."""

from __future__ import annotations

import contextlib
import re
import socket
import ssl
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest
import uvicorn
from browsing import Served
from pydantic import ValidationError

from servoscope.core.networks import is_member
from servoscope.service.access import WebSettings
from servoscope.service.health import HealthReport, serve_health
from servoscope.web.connections import ConnectionTable, HttpProtocol

HALF = b"GET / HTTP/1.1\r\nHost: localhost\r\n"
WHOLE = HALF + b"\r\n"


class Impatient(HttpProtocol):
    """Deadlines that a test can wait for."""

    HEADER_S, BODY_S, BODY_RATE, DRAIN_S = 0.5, 0.5, 1000.0, 0.5


async def app(scope: dict[str, Any], receive: Callable[[], Any], send: Callable[[dict[str, Any]], Any]) -> None:
    """Take the body; answer with as many bytes as the address names, and for ``/stream`` without end."""
    while scope["method"] == "POST" and (await receive()).get("more_body"):
        pass
    body = b"x" * int(scope["path"].rpartition("/")[2] or 0)
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": body, "more_body": scope["path"].startswith("/stream")})
    if scope["path"].startswith("/stream"):
        while (await receive())["type"] != "http.disconnect":
            pass


@contextlib.contextmanager
def serving(most: int = 100, most_per_address: int = 100, proxies: tuple[str, ...] = ()) -> Iterator[tuple[str, int]]:
    listening = socket.create_server(("127.0.0.1", 0))
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    table = ConnectionTable(most, most_per_address, proxies)
    protocol: Any = partial(Impatient, table)
    config = uvicorn.Config(app, http=protocol, ws="none", log_level="error", lifespan="off")  # type: ignore[arg-type]
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, args=([listening],))
    thread.start()
    try:
        yield listening.getsockname()
    finally:
        server.should_exit = server.force_exit = True
        thread.join()
        listening.close()


def opened(address: tuple[str, int], data: bytes = b"", source: str = "127.0.0.1") -> socket.socket:
    connection = socket.create_connection(address, timeout=20.0, source_address=(source, 0))
    connection.sendall(data)
    return connection


def is_closed(connection: socket.socket) -> bool:
    """Whether the server has closed a connection; what it has sent before is read."""
    connection.settimeout(0.0)
    try:
        while connection.recv(65536):
            pass
    except BlockingIOError:
        return False
    except ConnectionError:
        pass
    return True


def close_time(connection: socket.socket, data: bytes = b"", every: float = 0.1) -> float:
    """Return how long a connection lasts while data is sent bit by bit [s]."""
    start = time.monotonic()
    while time.monotonic() < start + 20.0 and not is_closed(connection):
        with contextlib.suppress(OSError):
            connection.send(data)
        time.sleep(every)
    connection.close()
    return time.monotonic() - start


@pytest.mark.parametrize(
    ("begin", "trickle"),
    [
        (b"", b""),
        (HALF, b""),
        (HALF, b"x"),  # a byte now and then is no progress
        (WHOLE, b"G"),  # a second request on the same connection
        (b"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: 100000\r\n\r\n", b""),
        (b"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: 100000\r\n\r\n", b"x"),
    ],
)
def test_a_request_has_to_be_complete_in_time(begin: bytes, trickle: bytes) -> None:
    with serving() as address:
        assert 0.3 < close_time(opened(address, begin), trickle) < 3.0


def test_a_body_that_comes_fast_enough_may_take_longer() -> None:
    with serving() as address, opened(address) as connection:
        size = 20 * 100
        connection.sendall(b"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: %d\r\n\r\n" % size)
        for _ in range(20):
            connection.sendall(b"x" * 100)
            time.sleep(0.06)
        assert connection.recv(100).startswith(b"HTTP/1.1 200")


def test_an_answer_that_is_not_read_is_given_up() -> None:
    with serving() as address, opened(address) as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.sendall(b"GET /30000000 HTTP/1.1\r\nHost: a\r\n\r\n")
        time.sleep(2.0)
        taken = 0
        with contextlib.suppress(ConnectionError):
            while part := connection.recv(1 << 20):
                taken += len(part)
        assert taken < 30_000_000


def test_an_event_stream_is_not_slow() -> None:
    with serving() as address, opened(address, b"GET /stream/10 HTTP/1.1\r\nHost: a\r\n\r\n") as connection:
        time.sleep(1.2)
        assert not is_closed(connection)


@pytest.mark.parametrize("limit", ["most", "most_per_address"])
def test_who_waits_longest_gives_way_and_who_is_answered_does_not(limit: str) -> None:
    with serving(**{limit: 3}) as address, contextlib.ExitStack() as stack:
        stream = stack.enter_context(opened(address, b"GET /stream/10 HTTP/1.1\r\nHost: a\r\n\r\n"))
        assert stream.recv(10)
        first, second, third = (stack.enter_context(opened(address)) for _ in range(3))
        assert third.sendall(WHOLE) is None and third.recv(12) == b"HTTP/1.1 200"
        assert is_closed(first) and not is_closed(second) and not is_closed(stream)


def test_handshakes_are_bounded_and_the_oldest_gives_way(tmp_path: Path) -> None:
    """TLS has ten seconds; until then clients that say nothing must not use up the files of the server."""
    make = "openssl req -x509 -newkey rsa:2048 -nodes -keyout key.pem -out cert.pem -days 2 -subj /CN=localhost"
    subprocess.run(make.split(), cwd=tmp_path, check=True, capture_output=True)
    text = '[sources.s]\nkind = "replay"\n[assets.a]\nbaseline = "b"\nsource = "s"\nfiles = ["f"]\n[web]\n'
    text += 'listen = "127.0.0.1:0"\ncertificate = "cert.pem"\nkey = "key.pem"\nconnections_per_address = 5\n'
    (tmp_path / "hall.toml").write_text(text)
    trusted = ssl.create_default_context(cafile=str(tmp_path / "cert.pem"))
    with Served(tmp_path, "serve", "hall.toml") as served, contextlib.ExitStack() as stack:
        parts = urlsplit(served.url)
        address = (str(parts.hostname), int(parts.port or 0))
        silent = [stack.enter_context(opened(address, b"\x16\x03\x01")) for _ in range(40)]
        with httpx.Client(
            base_url=f"https://localhost:{parts.port}", verify=trusted, timeout=9.0
        ) as client:  # before the first deadline
            assert client.get("/health/live").status_code == 200
            text = client.get("/metrics").text
        assert sum(is_closed(one) for one in silent) >= 35
        found = re.search(r'servoscope_http_connections_cut_total\{why="handshake"\} ([0-9.]+)', text)
        assert found and float(found[1]) >= 35


def test_where_nobody_waits_only_health_is_told() -> None:
    with serving(most_per_address=2) as address, contextlib.ExitStack() as stack:
        for _ in range(2):
            stream = stack.enter_context(opened(address, b"GET /stream/10 HTTP/1.1\r\nHost: a\r\n\r\n"))
            assert stream.recv(10)
        url = f"http://{address[0]}:{address[1]}"
        assert httpx.get(f"{url}/0").status_code == 503
        assert httpx.get(f"{url}/health/0").status_code == 200
        other = stack.enter_context(opened(address, WHOLE, source="127.0.0.2"))
        assert other.recv(12) == b"HTTP/1.1 200"


def test_a_proxy_is_not_counted_by_address() -> None:
    with serving(most_per_address=1, proxies=("127.0.0.0/8",)) as address, contextlib.ExitStack() as stack:
        for _ in range(3):
            stream = stack.enter_context(opened(address, b"GET /stream/10 HTTP/1.1\r\nHost: a\r\n\r\n"))
            assert stream.recv(12) == b"HTTP/1.1 200"


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("slow")
    with Served(folder, "serve", "--store", "new.sqlite", "--listen", "127.0.0.1:0") as served:
        yield served


def test_half_sent_headers_do_not_close_the_server(served: Served) -> None:
    parts = urlsplit(served.url)
    address = (str(parts.hostname), int(parts.port or 0))
    with contextlib.ExitStack() as stack:
        slow = [stack.enter_context(opened(address, HALF)) for _ in range(300)]
        for path in ("/health/live", "/api/v1/assets", "/"):
            assert httpx.get(served.url + path, timeout=5.0).status_code == 200
        assert sum(not is_closed(one) for one in slow) <= 100


def test_half_sent_headers_do_not_use_up_the_threads_of_a_service() -> None:
    server, before = serve_health(HealthReport(bytes, str), "127.0.0.1:0"), threading.active_count()
    try:
        host, port = str(server.server_address[0]), int(server.server_address[1])
        with contextlib.ExitStack() as stack:
            for _ in range(150):
                stack.enter_context(opened((host, port), HALF))
            for _ in range(3):
                assert httpx.get(f"http://{host}:{port}/health/live", timeout=5.0).status_code == 200
            assert threading.active_count() - before <= 70
    finally:
        server.shutdown()
        server.server_close()


def test_a_header_of_a_proxy_is_believed_only_from_it(tmp_path: Path) -> None:
    """Failed logins count per address: whoever could choose an address would not be limited."""
    from servoscope.service.access import Users

    Users(tmp_path / "users.json").add("vera", "viewer", "a long password")
    for proxies, answers in (('["127.0.0.0/8"]', [401] * 7), ('["192.0.2.0/24"]', [401] * 5 + [429] * 2)):
        text = 'name = "hall"\n[sources.s]\nkind = "replay"\n[assets.a]\nbaseline = "b"\nsource = "s"\nfiles = ["f"]\n'
        text += f'[web]\nlisten = "127.0.0.1:0"\nusers = "users.json"\nproxies = {proxies}\n'
        (tmp_path / "hall.toml").write_text(text)
        (tmp_path / "history.sqlite").unlink(missing_ok=True)
        with Served(tmp_path, "serve", "hall.toml") as served, served.client() as client:
            said = [
                client.post(
                    "/session",
                    json={"user": f"user{k}", "password": "wrong"},
                    headers={"X-Forwarded-For": f"198.51.100.{k}"},
                ).status_code
                for k in range(7)
            ]
            assert said == answers


def test_a_network_is_one() -> None:
    assert is_member("10.1.2.3", ["10.0.0.0/8"]) and is_member("::ffff:10.1.2.3", ["10.0.0.0/8"])
    assert is_member("fe80::1%eth0", ["fe80::/10"]) and not is_member("localhost", ["0.0.0.0/0", "::/0"])
    with pytest.raises(ValidationError, match="no network"):
        WebSettings(proxies=("a.b",))
