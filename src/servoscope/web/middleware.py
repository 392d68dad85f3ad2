"""Checks of every request before the application: host, origin, login, token, size; and the headers of answers."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterable
from hmac import compare_digest
from http.cookies import CookieError, SimpleCookie
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from servoscope.core.errors import AccessError
from servoscope.core.messages import current_language, languages, speak
from servoscope.service.access import AllowedHosts, Session
from servoscope.web.dependencies import LOCAL_PRINCIPAL, Context, Principal
from servoscope.web.errors import problem_response
from servoscope.web.metrics import WebMetrics

API = "/api/v1"
CSRF = "x-csrf-token"
SAFE_METHODS = ("GET", "HEAD", "OPTIONS")
SESSION_PATH = f"{API}/session"  # asked without login: how one logs in
CLOCK_COOKIE = "clock"  # the time zone of the browser
LANGUAGE_COOKIE = "language"  # which the page sets, and whose value is checked
MAX_BODY_BYTES = 1_000_000  # bytes, but for uploads
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
# browsers respect it over HTTPS and on loopback, and complain of it on every page elsewhere
OPENER_HEADER = {"cross-origin-opener-policy": "same-origin"}


class RequestRejection(HTTPException):
    """A request is refused."""


def cookie_name(secure: bool) -> str:
    """Return the name of a session's cookie; browsers restrict the longer one to HTTPS and this host."""
    return "__Host-servoscope" if secure else "servoscope"


class SecurityMiddleware:
    """Lets a request pass to the application, or answers in its place."""

    def __init__(self, app: ASGIApp, context: Context, metrics: WebMetrics) -> None:
        self._app, self._context, self._metrics = app, context, metrics
        self._settings = settings = context.settings
        self._hosts = AllowedHosts.of(settings.listen, settings.hosts)
        # behind a proxy that ends TLS it listens on loopback
        is_respected = settings.secure or not self._hosts.numeric
        self._headers = HEADERS | (OPENER_HEADER if is_respected else {})

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request pass, or answer in its place."""
        if scope["type"] == "lifespan":
            return await self._app(scope, receive, send)
        if scope["type"] != "http":  # there are no web sockets here: none is opened for anybody
            await receive()
            return await send({"type": "websocket.close", "code": 1008})
        start, status = time.perf_counter(), 500

        async def answer(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                self._add_headers(MutableHeaders(scope=message), scope["path"])
            await send(message)

        try:
            most = self._authorise(scope)
            asked = Headers(scope=scope)
            with speak(request_language(asked), _read_cookie(asked.getlist("cookie"), CLOCK_COOKIE)):
                await self._app(scope, _limit_body(receive, most), answer)
        except RequestRejection as rejection:
            await problem_response(rejection.status_code, rejection.detail, scope["path"])(scope, receive, answer)
        finally:
            self._metrics.observe(scope, status, time.perf_counter() - start)

    def _authorise(self, scope: Scope) -> int:
        """Return how many bytes the body may have; raises RequestRejection if the request may not pass."""
        headers, path, method = Headers(scope=scope), str(scope["path"]), str(scope["method"])
        host = _single_header(headers.getlist("host"))
        if host is None or not self._hosts.known(host):
            raise RequestRejection(421, f"this server is not called {host!r}: name it in [web] hosts")
        origin = _single_header(headers.getlist("origin"))
        if origin is not None and not AllowedHosts.same(origin, host, scope["scheme"]):
            raise RequestRejection(403, "the request comes from a page of another server")
        site = headers.get("sec-fetch-site", "same-origin")
        is_link = method == "GET" and headers.get("sec-fetch-mode") == "navigate"  # which reads nothing
        if site not in ("same-origin", "none") and not is_link:
            raise RequestRejection(403, "the request comes from a page of another server")
        if path == "/metrics" or path.startswith("/api"):
            who = authenticate(headers, self._context)
            if who is not None:
                scope["who"] = who
            elif path != SESSION_PATH:
                raise RequestRejection(401, "log in first")
            is_login = path == SESSION_PATH and method == "POST"  # a login has no token yet
            if method not in SAFE_METHODS and who is not None and who.session is not None and not is_login:
                self._check_token(headers, who.session)
        return self._check_size(headers, path)

    @staticmethod
    def _check_token(headers: Headers, session: Session) -> None:
        if not compare_digest(headers.get(CSRF, "").encode(), session.csrf.encode()):
            raise RequestRejection(403, f"the header {CSRF} must repeat the csrf of GET {API}/session")

    def _check_size(self, headers: Headers, path: str) -> int:
        most = round(self._settings.upload_mb * 1e6) if path == f"{API}/uploads" else MAX_BODY_BYTES
        length = headers.get("content-length", "0")
        if not length.isdecimal():
            raise RequestRejection(400, "Content-Length is no number")
        if len(length) > 18 or int(length) > most:
            raise RequestRejection(413, f"the body is larger than {most / 1e6:g} MB")
        return most

    def _add_headers(self, headers: MutableHeaders, path: str) -> None:
        for name, value in self._headers.items():
            headers.setdefault(name, value)
        headers.setdefault("content-security-policy", POLICY)
        if path.startswith("/api") or path == "/metrics":
            headers.setdefault("cache-control", "no-store")
        if self._settings.secure:
            headers.setdefault("strict-transport-security", "max-age=31536000")


def authenticate(headers: Headers, context: Context) -> Principal | None:
    """Return the user of a request; None: nobody is logged in. Raises RequestRejection for who may not come in."""
    settings, users = context.settings, context.users
    if not settings.login:
        return LOCAL_PRINCIPAL
    if settings.sign_on is not None:
        try:
            signed_on = settings.sign_on.identify(headers.getlist, context.proxy_secret)
        except AccessError as error:
            raise RequestRejection(403, str(error)) from None
        if signed_on is not None:
            return Principal(*signed_on)
    secret = _read_cookie(headers.getlist("cookie"), cookie_name(settings.secure))
    session = context.sessions.find(secret, time.monotonic())
    # role and password as they are now: a session ends with its user, and with the user's password
    role = users.all().get(session.user) if session is not None and users is not None else None
    if session is None or users is None or role is None or users.stamp(session.user) != session.stamp:
        return None
    return Principal(session.user, role, session, secret)


def request_language(headers: Headers) -> str:
    """Return the language that a reader has chosen on the page, else the browser's, else the server's own."""
    chosen = _read_cookie(headers.getlist("cookie"), LANGUAGE_COOKIE)
    wanted = []
    for preference in headers.get("accept-language", "").split(","):
        name, _, weight = preference.partition(";q=")
        with contextlib.suppress(ValueError):
            wanted.append((-float(weight or 1.0), name.strip()[:2].lower()))
    asked = [chosen, *(name for _, name in sorted(wanted, key=lambda entry: entry[0]))]
    return next((name for name in asked if name in languages()), current_language())


def _read_cookie(headers: Iterable[str], name: str) -> str | None:
    for text in headers:
        try:
            cookies = SimpleCookie(text)
        except CookieError:
            continue
        if name in cookies:
            return cookies[name].value
    return None


def _single_header(values: list[str]) -> str | None:
    """Return a header's value; one that comes twice is a value that nothing equals."""
    return ",".join(values) if values else None


def _limit_body(receive: Receive, most: int) -> Receive:
    """Return a receiver that refuses a body that becomes too large, whatever its Content-Length."""
    taken = 0

    async def bounded() -> Message:
        nonlocal taken
        message: dict[str, Any] = dict(await receive())
        if message["type"] == "http.request":
            taken += len(message.get("body", b""))
            if taken > most:
                raise RequestRejection(413, f"the body is larger than {most / 1e6:g} MB")
        return message

    return bounded
