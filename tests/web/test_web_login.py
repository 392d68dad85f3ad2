"""Guesses of passwords that come all at once: counted before they are hashed, in a queue with an end."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from pages_context import open_context

from servoscope.service.access import Role, Users, WebSettings
from servoscope.web.app import create_app

PASSWORD = "a long password of hers"


class CountedUsers(Users):
    """Users whose checks are counted, wait for `go`, and compare without a hash."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.checks: list[str] = []
        self.go = threading.Event()
        self.go.set()

    def check(self, name: str, password: str) -> Role | None:
        self.checks.append(name)
        assert self.go.wait(60.0)
        return "viewer" if (name, password) == ("vera", PASSWORD) else None


@pytest.fixture
def users(tmp_path: Path) -> CountedUsers:
    found = CountedUsers(tmp_path / "users.json")
    found.add("vera", "viewer", PASSWORD)
    return found


@pytest.fixture
def app(users: CountedUsers, tmp_path: Path) -> Iterator[Any]:
    with open_context(tmp_path, WebSettings(users="users.json"), users) as context:
        yield create_app(context)


async def try_to_log_in(app: Any, user: str, password: str, address: str = "192.0.2.1") -> httpx.Response:
    transport = httpx.ASGITransport(app, client=(address, 1))
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
        return await client.post("/api/v1/session", json={"user": user, "password": password})


def test_guesses_at_once_do_not_pass_the_limit(app: Any, users: CountedUsers) -> None:
    async def attack() -> list[int]:
        guesses = (try_to_log_in(app, "vera", f"guess {k}") for k in range(60))
        return sorted(one.status_code for one in await asyncio.gather(*guesses))

    assert asyncio.run(attack()) == [401] * 5 + [429] * 55
    assert len(users.checks) == 5


@pytest.mark.parametrize("many", ["names", "addresses"])
def test_the_limit_holds_for_each_address_and_each_name(app: Any, users: CountedUsers, many: str) -> None:
    async def attack() -> list[int]:
        tries = [(f"user{k}", "192.0.2.1") if many == "names" else ("vera", f"192.0.2.{k}") for k in range(20)]
        answers = await asyncio.gather(*(try_to_log_in(app, user, "a guess", address) for user, address in tries))
        return sorted(one.status_code for one in answers)

    assert asyncio.run(attack()) == [401] * 5 + [429] * 15
    assert len(users.checks) == 5


def test_an_attempt_that_succeeds_counts_no_more(app: Any) -> None:
    async def visit() -> list[int]:
        return [(await try_to_log_in(app, "vera", PASSWORD)).status_code for _ in range(7)]

    assert asyncio.run(visit()) == [200] * 7


def test_the_queue_has_an_end_and_what_it_refuses_is_not_counted(app: Any, users: CountedUsers) -> None:
    async def attack() -> list[int]:
        users.go.clear()
        tries = [asyncio.create_task(try_to_log_in(app, f"u{k}", "a guess", f"192.0.2.{k}")) for k in range(100)]
        try:
            done: set[asyncio.Task[httpx.Response]] = set()
            waiting = set(tries)
            while len(done) < 50:  # those beyond the queue are answered while no hash is done
                more, waiting = await asyncio.wait(waiting, timeout=20.0, return_when=asyncio.FIRST_COMPLETED)
                assert more, "a queue without an end"
                done |= more
            assert {one.result().status_code for one in done} == {503}
            assert all("retry-after" in one.result().headers for one in done)
            assert len(users.checks) <= 2
        finally:
            users.go.set()
        await asyncio.gather(*waiting)
        return [(await try_to_log_in(app, "u99", "a guess", "192.0.2.99")).status_code for _ in range(6)]

    assert asyncio.run(attack()) == [401] * 5 + [429]


def test_a_client_that_has_gone_is_not_hashed_for(app: Any, users: CountedUsers) -> None:
    body = json.dumps({"user": "vera", "password": "a guess"}).encode()
    headers = [(b"host", b"localhost"), (b"content-type", b"application/json")]

    async def send_and_go() -> None:
        messages = iter([{"type": "http.request", "body": body, "more_body": False}])

        async def receive() -> dict[str, Any]:
            return next(messages, {"type": "http.disconnect"})

        async def send(_: Any) -> None:
            pass

        path = "/api/v1/session"
        scope = {"type": "http", "method": "POST", "path": path, "raw_path": path.encode(), "headers": headers}
        more = {"scheme": "http", "query_string": b"", "http_version": "1.1", "client": ("192.0.2.1", 1)}
        await app({**scope, **more, "root_path": "", "server": ("localhost", 80)}, receive, send)

    async def attack() -> int:
        for _ in range(10):
            await send_and_go()
        return (await try_to_log_in(app, "vera", PASSWORD)).status_code

    assert asyncio.run(attack()) == 200  # nobody was told anything: nothing was guessed
    assert users.checks == ["vera"]
