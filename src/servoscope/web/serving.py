"""Serves the application: opens what it stands on, listens, and stops in order."""

from __future__ import annotations

import os
import socket
import sys
import threading
from pathlib import Path
from typing import Any

import uvicorn

from servoscope.access import Sessions, Users, WebSettings
from servoscope.access.hosts import split
from servoscope.errors import ConfigError
from servoscope.live.config import Config
from servoscope.store import Store
from servoscope.web.app import application
from servoscope.web.context import Context
from servoscope.web.folder import Folder
from servoscope.web.hub import Hub
from servoscope.web.jobs import Jobs, Limits

__all__ = ["serve"]

STORE_PATIENCE = 5.0  # s
STOPS_WITHIN_S = 5
BACKLOG = 1024
SEND_BUFFER = 1 << 17  # bytes of each connection; Linux takes them twice


class Server(uvicorn.Server):
    """Lets readers of events go before it waits for requests to end.

    Parameters
    ----------
    config
        Of uvicorn.
    hub
        Whom they read.
    """

    def __init__(self, config: uvicorn.Config, hub: Hub) -> None:
        super().__init__(config)
        self._hub = hub

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stop."""
        self._hub.close()
        await super().shutdown(sockets)


def serve(settings: WebSettings, store: Store, config: Config | None, folder: Path, *, with_parent: bool) -> None:
    """Serve until stopped by a signal.

    Parameters
    ----------
    settings
        The section ``[web]``.
    store
        What is shown; closed at the end.
    config
        The service file, if there is one.
    folder
        What paths in the settings are relative to.
    with_parent
        Whether it ends when stdin does: with the service that started it, however that ends.

    Raises
    ------
    ServoscopeError
        If the address or a file cannot be had.
    """
    users = Users(folder / settings.users) if settings.users is not None else None
    if users is not None and not users.all():
        file = folder / str(settings.users)
        what = "has no users" if file.exists() else "no such file"
        raise ConfigError(f"{file}: {what}, add one: servoscope users add NAME --users {file}")
    hub = Hub(store)
    context = Context(
        settings=settings,
        store=store,
        config=config,
        folder=Folder(folder / settings.folder),
        hub=hub,
        jobs=Jobs(Limits(settings.job_s, settings.job_memory_mb)),
        users=users,
        sessions=Sessions(settings.session_hours * 3600.0),
    )
    tls = {}
    if settings.certificate is not None and settings.key is not None:
        tls = {"ssl_certfile": folder / settings.certificate, "ssl_keyfile": folder / settings.key}
        for path in tls.values():
            if not path.is_file():
                raise ConfigError(f"{path}: no such file, see [web] certificate and key")
    listening = _listen(settings.listen)
    try:
        server = Server(_config(context, tls), hub)
        if with_parent:
            threading.Thread(target=_wait_for_parent, args=(server,), daemon=True).start()
        _announce(settings, listening)
        server.run([listening])
    finally:
        listening.close()
        store.close()


def _config(context: Context, tls: dict[str, Any]) -> uvicorn.Config:
    return uvicorn.Config(
        application(context),
        log_level="warning",
        access_log=False,
        server_header=False,
        proxy_headers=False,  # whoever connects could write them
        timeout_graceful_shutdown=STOPS_WITHIN_S,
        h11_max_incomplete_event_size=65536,
        limit_concurrency=1000,
        lifespan="on",
        **tls,
    )


def _listen(address: str) -> socket.socket:
    host, port = split(address)
    try:
        family, *_, where = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.socket(family, socket.SOCK_STREAM)
        try:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            # what stands in the kernel cannot be replaced by news: a slow reader is behind by that much, and no more
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
            listening.bind(where)
            listening.listen(BACKLOG)  # who reads where it is to be found may come at once
        except BaseException:
            listening.close()
            raise
    except (OSError, OverflowError) as error:
        why = getattr(error, "strerror", None) or error
        raise ConfigError(f"[web] listen: {address} cannot be had ({why}), choose another address") from None
    return listening


def _announce(settings: WebSettings, listening: socket.socket) -> None:
    """Say where it is to be found, and who may come in."""
    host, port = listening.getsockname()[:2]
    name = f"[{host}]" if ":" in host else host
    scheme = "https" if settings.secure else "http"
    who = "with login" if settings.login else "no login: whoever uses this machine may do everything"
    print(f"servoscope: {scheme}://{name}:{port}/ ({who})", file=sys.stderr, flush=True)
    if settings.login and not settings.secure:
        print("servoscope: without TLS passwords can be read on the way: [web] certificate, key", file=sys.stderr)


def _wait_for_parent(server: uvicorn.Server) -> None:
    while os.read(sys.stdin.fileno(), 4096):
        pass
    server.should_exit = True
