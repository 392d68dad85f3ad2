"""What every request passes first: host, origin, login, token, size; and what answers carry."""

from __future__ import annotations

import time
from collections.abc import Iterable
from hmac import compare_digest
from http.cookies import CookieError, SimpleCookie
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from servoscope.access import Hosts, Session, Sessions, Users, WebSettings
from servoscope.web.context import LOCAL, Who
from servoscope.web.metrics import Metrics
from servoscope.web.problems import problem

__all__ = ["API", "CSRF", "POLICY", "Guard", "cookie_name", "identify"]

API = "/api/v1"
CSRF = "x-csrf-token"
SAFE = ("GET", "HEAD", "OPTIONS")
OPEN = (f"{API}/session",)  # asked without login: how one logs in
BODY = 1_000_000  # bytes, but for uploads
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "font-src 'self'; form-action 'self'; frame-src 'self'; base-uri 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=()",
}


# Browsers heed it over HTTPS and on loopback, and complain of it on every page elsewhere.
OPENER = {"cross-origin-opener-policy": "same-origin"}


class Refused(HTTPException):
    """A request that goes no further."""


def cookie_name(secure: bool) -> str:
    """Return what the cookie of a session is called; browsers hold the longer name to HTTPS and this one host."""
    return "__Host-servoscope" if secure else "servoscope"


class Guard:
    """Stands before an application.

    Parameters
    ----------
    app
        What answers.
    settings
        The section ``[web]``.
    users, sessions
        Who may come in; no users: no login.
    metrics
        Told of every answer.
    """

    def __init__(
        self, app: ASGIApp, settings: WebSettings, users: Users | None, sessions: Sessions, metrics: Metrics
    ) -> None:
        self._app, self._settings, self._users = app, settings, users
        self._sessions, self._metrics = sessions, metrics
        self._hosts = Hosts.of(settings.listen, settings.hosts)
        # behind a proxy that ends TLS it listens on loopback
        heeded = settings.secure or not self._hosts.numeric
        self._headers = HEADERS | (OPENER if heeded else {})

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request pass, or answer in its place."""
        if scope["type"] == "lifespan":
            return await self._app(scope, receive, send)
        if scope["type"] != "http":  # there are no web sockets here: none is opened for anybody
            await receive()
            return await send({"type": "websocket.close", "code": 1008})
        begun, seen = time.perf_counter(), {"status": 500}

        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                seen["status"] = message["status"]
                self._dress(MutableHeaders(scope=message), scope["path"])
            await send(message)

        try:
            most = self._check(scope)
            await self._app(scope, _bounded(receive, most), answer)
        except Refused as refused:
            await problem(refused.status_code, refused.detail, scope["path"])(scope, receive, answer)
        finally:
            self._metrics.answered(scope, seen["status"], time.perf_counter() - begun)

    def _check(self, scope: Scope) -> int:
        """Return how many bytes the body may have.

        Raises
        ------
        Refused
            If the request may not pass.
        """
        headers, path, method = Headers(scope=scope), str(scope["path"]), str(scope["method"])
        host = _only(headers.getlist("host"))
        if host is None or not self._hosts.known(host):
            raise Refused(421, f"this server is not called {host!r}: name it in [web] hosts")
        origin = _only(headers.getlist("origin"))
        if origin is not None and not Hosts.same(origin, host, scope["scheme"]):
            raise Refused(403, "the request comes from a page of another server")
        site = headers.get("sec-fetch-site", "same-origin")
        followed = method == "GET" and headers.get("sec-fetch-mode") == "navigate"  # a link, which reads nothing
        if site not in ("same-origin", "none") and not followed:
            raise Refused(403, "the request comes from a page of another server")
        if path == "/metrics" or path.startswith("/api"):
            who = identify(headers, self._settings, self._users, self._sessions)
            if who is not None:
                scope["who"] = who
            elif path not in OPEN:
                raise Refused(401, "log in first")
            begins = path in OPEN and method == "POST"  # a login has no token yet
            if method not in SAFE and who is not None and who.session is not None and not begins:
                self._check_token(headers, who.session)
        return self._check_size(headers, path)

    @staticmethod
    def _check_token(headers: Headers, session: Session) -> None:
        if not compare_digest(headers.get(CSRF, "").encode(), session.csrf.encode()):
            raise Refused(403, f"the header {CSRF} must repeat what GET {API}/session tells")

    def _check_size(self, headers: Headers, path: str) -> int:
        most = round(self._settings.upload_mb * 1e6) if path == f"{API}/uploads" else BODY
        length = headers.get("content-length", "0")
        if not length.isdecimal():
            raise Refused(400, "Content-Length is no number")
        if len(length) > 18 or int(length) > most:
            raise Refused(413, f"the body is larger than {most / 1e6:g} MB")
        return most

    def _dress(self, headers: MutableHeaders, path: str) -> None:
        for name, value in self._headers.items():
            headers.setdefault(name, value)
        headers.setdefault("content-security-policy", POLICY)
        if path.startswith("/api") or path == "/metrics":
            headers.setdefault("cache-control", "no-store")
        if self._settings.secure:
            headers.setdefault("strict-transport-security", "max-age=31536000")


def identify(headers: Headers, settings: WebSettings, users: Users | None, sessions: Sessions) -> Who | None:
    """Return who sends a request; None: nobody knows."""
    if users is None:
        return LOCAL
    secret = _cookie(headers.getlist("cookie"), cookie_name(settings.secure))
    session = sessions.find(secret, time.time())
    # role and password as they are now: who was removed, or has a new password, is out
    role = users.all().get(session.user) if session is not None else None
    if session is None or role is None or users.stamp(session.user) != session.stamp:
        return None
    return Who(session.user, role, session, secret)


def _cookie(headers: Iterable[str], name: str) -> str | None:
    for text in headers:
        try:
            found = SimpleCookie(text)
        except CookieError:
            continue
        if name in found:
            return found[name].value
    return None


def _only(values: list[str]) -> str | None:
    """Return a header's value; one that comes twice is as good as another name."""
    return values[0] if len(values) == 1 else (None if not values else ",".join(values))


def _bounded(receive: Receive, most: int) -> Receive:
    """Return a receiver that refuses a body that becomes larger than it may, whatever its length was said to be."""
    taken = 0

    async def bounded() -> Message:
        nonlocal taken
        message: dict[str, Any] = dict(await receive())
        if message["type"] == "http.request":
            taken += len(message.get("body", b""))
            if taken > most:
                raise Refused(413, f"the body is larger than {most / 1e6:g} MB")
        return message

    return bounded
