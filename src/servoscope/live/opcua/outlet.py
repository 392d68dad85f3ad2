"""Verdicts offered as an OPC UA server: an object per asset, its variables for everybody to read or subscribe to."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from servoscope.errors import ConfigError, SourceError
from servoscope.live.logs import log
from servoscope.live.opcua.settings import asyncua
from servoscope.live.outlet import Statuses
from servoscope.settings import Settings, Word

__all__ = ["NAMESPACE", "VARIABLES", "OpcuaOutlet", "OpcuaOutletSettings", "shown"]

URI, NAMESPACE = "urn:servoscope", "urn:servoscope:assets"
STARTS_S = 120.0  # thousands of nodes of the standard are made first; a busy machine takes its time
VARIABLES: Mapping[str, Any] = {  # of each asset, with what they hold before anything is known
    "Verdict": "undetermined",
    "Summary": "",
    "Since": datetime.fromtimestamp(0.0, UTC),
    "T2": 0.0,
    "Level": 0.0,
    "Fault": "",
    "Parameter": "",
    "Ratio": 1.0,
    "NE107": "",
    "LastSample": datetime.fromtimestamp(0.0, UTC),
}


class OpcuaOutletSettings(Settings):
    """An outlet of kind ``opcua``.

    Parameters
    ----------
    listen
        Address, ``host:port``.
    cert_file, key_file
        The server's certificate and its key (DER or PEM). With them only signed and encrypted connections are taken.
    """

    kind: Literal["opcua"]
    listen: Annotated[str, Field(strict=True, pattern=r"^.+:\d{1,5}$")] = "127.0.0.1:4841"
    cert_file: Word | None = None
    key_file: Word | None = None

    @model_validator(mode="after")
    def _together(self) -> Self:
        if (self.cert_file is None) != (self.key_file is None):
            raise ValueError("cert_file and key_file belong together")
        return self


def shown(status: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the variables of an asset hold for a status; T^2 is over its limit, a ratio to healthy."""
    faults = status.get("faults") or []
    fault = faults[0] if len(faults) == 1 else {}
    names = " + ".join(one["name"] for one in faults)
    return {
        "Verdict": status["verdict"],
        "Summary": status["summary"],
        "Since": datetime.fromtimestamp(status["since"], UTC),
        "T2": float(status.get("statistic") or 0.0),
        "Level": float(status.get("level") or 0.0),
        "Fault": names,
        "Parameter": fault.get("parameter", ""),
        "Ratio": float(fault.get("ratio", 1.0)),
        "NE107": status["ne107"],
        "LastSample": datetime.fromtimestamp(status["counted"]["t"], UTC),
    }


class OpcuaOutlet:
    """Offers the newest status of each asset.

    Parameters
    ----------
    settings
        Of the outlet.
    folder
        What files are relative to.
    """

    def __init__(self, settings: OpcuaOutletSettings, folder: Path) -> None:
        asyncua()
        self.settings, self._folder = settings, folder
        for name in (settings.cert_file, settings.key_file):
            if name is not None and not (folder / name).is_file():
                raise ConfigError(f"{folder / name}: no such file, give the certificate's path")
        self._nodes: dict[str, dict[str, Any]] = {}
        self._newest: dict[str, Mapping[str, Any]] = {}
        self._lock = threading.Lock()
        self._loop = asyncio.new_event_loop()
        self._started, self._over = threading.Event(), asyncio.Event()
        self._trouble = ""
        self._thread = threading.Thread(target=self._serve, name="opcua-server", daemon=True)

    def open(self, statuses: Statuses) -> None:
        """Begin to listen.

        Raises
        ------
        SourceError
            If the address cannot be had.
        """
        self.tell(statuses)
        self._thread.start()
        if not self._started.wait(STARTS_S) or self._trouble:
            raise SourceError(f"OPC UA server on {self.settings.listen}: {self._trouble or 'does not start'}")

    def tell(self, statuses: Statuses) -> None:
        """Show what has been stored."""
        with self._lock:
            self._newest |= {name: one for name, one in statuses.items() if "verdict" in one}
        if self._started.is_set() and not self._loop.is_closed():
            with contextlib.suppress(RuntimeError):  # closed in between
                self._loop.call_soon_threadsafe(lambda: self._loop.create_task(self._show()))

    def _serve(self) -> None:
        try:
            self._loop.run_until_complete(self._run())
        except Exception as error:  # a library's, of which nobody knows all
            self._trouble = f"{type(error).__name__}: {error}"
            log("error", "OPC UA server stopped", why=self._trouble)
        finally:
            self._started.set()
            self._loop.close()

    async def _run(self) -> None:
        from asyncua import ua

        server: Any = asyncua().Server()
        await server.init()
        server.set_endpoint(f"opc.tcp://{self.settings.listen}/servoscope")
        server.set_server_name("servoscope")
        await server.set_application_uri(URI)
        if self.settings.cert_file is not None and self.settings.key_file is not None:
            server.set_security_policy([ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt])
            await server.load_certificate(str(self._folder / self.settings.cert_file))
            await server.load_private_key(str(self._folder / self.settings.key_file))
        else:
            server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        index = await server.register_namespace(NAMESPACE)
        self._root = await server.nodes.objects.add_object(f"ns={index};s=servoscope", f"{index}:servoscope")
        self._index = index
        await self._show()
        async with server:
            self._started.set()
            await self._over.wait()

    async def _show(self) -> None:
        with self._lock:
            newest, self._newest = self._newest, {}
        for name, status in newest.items():
            if name not in self._nodes:
                at = f"ns={self._index};s={name}"
                asset = await self._root.add_object(at, f"{self._index}:{name}")
                self._nodes[name] = {
                    key: await asset.add_variable(f"{at}.{key}", f"{self._index}:{key}", value)
                    for key, value in VARIABLES.items()
                }
            for key, value in shown(status).items():
                await self._nodes[name][key].write_value(value)

    def close(self) -> None:
        """Stop listening."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._over.set)
            self._thread.join(STARTS_S)
