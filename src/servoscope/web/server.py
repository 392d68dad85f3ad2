"""Serves the application: opens its files, listens, and stops in order."""

from __future__ import annotations

import asyncio
import errno
import socket
import sys
from functools import partial
from pathlib import Path
from typing import Any

import uvicorn

from servoscope.core.errors import ConfigError
from servoscope.core.messages import message, render
from servoscope.core.sandbox import find_user
from servoscope.core.workers import ProcessLimits
from servoscope.service.access import Sessions, Users, WebSettings
from servoscope.service.access.allowed_hosts import UNIX, split_address
from servoscope.service.config import ServiceFile
from servoscope.service.process_supervisor import call_at_end_of_stdin
from servoscope.service.store import Store
from servoscope.web.app import create_app
from servoscope.web.connections import ConnectionTable, HttpProtocol, TlsListener
from servoscope.web.dependencies import Context
from servoscope.web.event_hub import EventHub
from servoscope.web.jobs.queue import JobQueue
from servoscope.web.storage import FileStorage, UploadStorage

STORE_TIMEOUT_S = 5.0  # s
STOPS_WITHIN_S = 5
BACKLOG = 1024
SOCKET_MODE = 0o660  # of a Unix socket: the proxy is in the group of the server
SEND_BUFFER = 1 << 17  # bytes of each connection; Linux takes them twice
MAX_CONNECTIONS = 4000
FILES_ASIDE = 200  # that are open beside connections: store, uploads, jobs
HANDSHAKE_S = 10.0  # within which TLS has to be agreed on


class WebServer(uvicorn.Server):
    """Ends the streams of events before it waits for requests to end."""

    def __init__(self, config: uvicorn.Config, hub: EventHub) -> None:
        super().__init__(config)
        self._hub = hub

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen."""
        if self.config.is_ssl:  # uvicorn has no setting for it, and a minute of asyncio's own is long
            loop = asyncio.get_running_loop()
            setattr(loop, "create_server", partial(loop.create_server, ssl_handshake_timeout=HANDSHAKE_S))  # noqa: B010
        await super().startup(sockets)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stop."""
        self._hub.close()
        await super().shutdown(sockets)


def run_server(
    settings: WebSettings, store: Store, config: ServiceFile | None, folder: Path, *, with_parent: bool
) -> None:
    """Serve until stopped by a signal; the store is closed at the end.

    Paths in the settings are relative to `folder`. `with_parent`: stop when stdin ends, which the service that
    started the server holds. Raises ServoscopeError if the address or a file is not available.
    """
    users = Users(folder / settings.users) if settings.users is not None else None
    if users is not None and not users.all():
        file = folder / str(settings.users)
        what = "has no users" if file.exists() else "no such file"
        raise ConfigError(f"{file}: {what}, add one: servoscope users add NAME --users {file}")
    if settings.job_user is not None:
        find_user(settings.job_user)
    hub, storage = EventHub(store), FileStorage(folder / settings.folder)
    context = Context(
        settings=settings,
        store=store,
        config=config,
        storage=storage,
        uploads=UploadStorage(storage),
        event_hub=hub,
        jobs=JobQueue(ProcessLimits(settings.job_s, settings.job_memory_mb), settings.job_user),
        users=users,
        sessions=Sessions(settings.session_hours * 3600.0),
        proxy_secret=settings.sign_on.load_secret(folder) if settings.sign_on is not None else None,
        connections=ConnectionTable(_available_connections(), settings.connections_per_address, settings.proxies),
    )
    tls = {}
    if settings.certificate is not None and settings.key is not None:
        tls = {"ssl_certfile": folder / settings.certificate, "ssl_keyfile": folder / settings.key}
        for path in tls.values():
            if not path.is_file():
                raise ConfigError(f"{path}: no such file, see [web] certificate and key")
    listening = (
        _bind_unix(folder / settings.listen.removeprefix(UNIX)) if settings.on_socket else _bind(settings.listen)
    )
    if tls:
        listening = TlsListener(fileno=listening.detach())
        listening.table = context.connections
    try:
        server = WebServer(_uvicorn_config(context, tls), hub)
        if with_parent:
            call_at_end_of_stdin(lambda: setattr(server, "should_exit", True))
        _print_address(settings, listening)
        server.run([listening])
    finally:
        listening.close()
        store.close()


def _uvicorn_config(context: Context, tls: dict[str, Any]) -> uvicorn.Config:
    settings = context.settings
    protocol: Any = partial(HttpProtocol, context.connections)  # uvicorn calls it as it calls a class
    return uvicorn.Config(
        create_app(context),
        http=protocol,
        loop="asyncio",  # another one would not accept by the listening socket's own method
        ws="none",  # there are no web sockets here
        log_level="warning",
        access_log=False,
        server_header=False,
        # whoever else connects could write them; a Unix socket is reached by the proxy alone
        proxy_headers=settings.on_socket or bool(settings.proxies),
        forwarded_allow_ips="*" if settings.on_socket else list(settings.proxies),
        timeout_graceful_shutdown=STOPS_WITHIN_S,
        h11_max_incomplete_event_size=65536,
        lifespan="on",
        **tls,
    )


def _available_connections() -> int:
    """Return how many connections there may be, with as many open files as the system allows."""
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MAX_CONNECTIONS + FILES_ASIDE
    if 0 <= soft < wanted:
        soft = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    return MAX_CONNECTIONS if soft < 0 else max(1, min(MAX_CONNECTIONS, soft - FILES_ASIDE))


def _bind_unix(path: Path) -> socket.socket:
    """Listen on a Unix socket, which its group may use; one that a server before this has left is replaced."""
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        if path.is_socket() and listening.connect_ex(str(path)) == errno.ECONNREFUSED:
            path.unlink()
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        listening.bind(str(path))
        path.chmod(SOCKET_MODE)
        listening.listen(BACKLOG)
    except OSError as error:
        listening.close()
        why = error.strerror or error
        raise ConfigError(f"[web] listen: {path} cannot be had ({why}), choose another path") from None
    return listening


def _bind(address: str) -> socket.socket:
    host, port = split_address(address)
    try:
        family, *_, where = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.socket(family, socket.SOCK_STREAM)
        try:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            # what the kernel holds cannot be replaced by newer events: a slow reader is behind by no more than that
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
            listening.bind(where)
            listening.listen(BACKLOG)  # clients may come as soon as the address is printed
        except BaseException:
            listening.close()
            raise
    except (OSError, OverflowError) as error:
        why = getattr(error, "strerror", None) or error
        raise ConfigError(f"[web] listen: {address} cannot be had ({why}), choose another address") from None
    return listening


def _print_address(settings: WebSettings, listening: socket.socket) -> None:
    """Print the address, and whether there is a login, on stderr."""
    if settings.on_socket:
        address = f"{UNIX}{listening.getsockname()}"
    else:
        host, port = listening.getsockname()[:2]
        name = f"[{host}]" if ":" in host else host
        address = f"{'https' if settings.secure else 'http'}://{name}:{port}/"
    login = message("web.login" if settings.login else "web.no_login")
    lines = [message("web.address", address=address, login=login)]
    if settings.login and not (settings.secure or settings.on_socket):
        lines.append(message("web.no_tls"))
    print(*map(render, lines), sep="\n", file=sys.stderr, flush=True)
