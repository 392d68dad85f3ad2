"""Verdicts and alarms offered as an OPC UA server: an object per asset with its variables, and events of its alarms."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from servoscope.core.errors import SourceError
from servoscope.service.log import log
from servoscope.service.opcua import device_health
from servoscope.service.opcua.conditions import AlarmConditions
from servoscope.service.opcua.reconnection import follow_standard
from servoscope.service.opcua.settings import CertificateSettings, check_files, import_asyncua, import_ua
from servoscope.service.publishers.base import AlarmCommand, PublisherSettings, StatusByAsset

URI, NAMESPACE = "urn:servoscope", "urn:servoscope:assets"
START_TIMEOUT_S = 120.0  # thousands of nodes of the standard are created first; a busy machine takes its time
MAX_CONNECTIONS = 64  # as many as the server of health takes; further ones are closed
HANDSHAKE_S = 10.0  # until a client must have a session
REFRESH_SEVERITY = 100  # of the events around a refresh
EPOCH = datetime.fromtimestamp(0.0, UTC)
VARIABLES: Mapping[str, Any] = {  # of each asset, with their values before anything is known
    "Verdict": "undetermined", "Summary": "", "Since": EPOCH, "T2": 0.0, "Level": 0.0, "Fault": "", "Parameter": "",
    "Ratio": 1.0, "NE107": "", "LastSample": EPOCH,
}  # fmt: skip


class OpcuaServerSettings(CertificateSettings, PublisherSettings):
    """An outlet of kind ``opcua``; with a certificate only signed and encrypted connections are accepted."""

    listens: ClassVar[bool] = True
    kind: Literal["opcua"]
    listen: Annotated[str, Field(strict=True, pattern=r"^.+:\d{1,5}$")] = "127.0.0.1:4841"
    operate: Annotated[bool, Field(strict=True)] = False  # whether clients may acknowledge, reset and shelve alarms

    def create(self, name: str, folder: Path) -> OpcuaServer:
        """Return the server."""
        return OpcuaServer(self, folder, name)


def variable_values(status: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of an asset's variables; T^2 is relative to its limit, a ratio to healthy."""
    ua = import_ua()
    faults = status.get("faults") or []
    fault = faults[0] if len(faults) == 1 else {}
    return {
        "Verdict": status["verdict"],
        "Summary": status["summary"],
        "Since": datetime.fromtimestamp(status["since"], UTC),
        "T2": float(status.get("statistic") or 0.0),
        "Level": float(status.get("level") or 0.0),
        "Fault": " + ".join(fault["name"] for fault in faults),
        "Parameter": fault.get("parameter", ""),
        "Ratio": float(fault.get("ratio", 1.0)),
        "NE107": status["ne107"],
        "LastSample": datetime.fromtimestamp(status["counted"]["t"], UTC),
        "DeviceHealth": ua.Variant(device_health.HEALTH_OF_NE107[status["ne107"]], ua.VariantType.Int32),
    }


class OpcuaServer:
    """Offers the newest status of each asset, from a thread of its own."""

    def __init__(self, settings: OpcuaServerSettings, folder: Path, name: str = "opcua") -> None:
        import_asyncua()
        self.settings, self._folder, self._name = settings, folder, name
        self.address = settings.listen  # once open with the port that the system gave in the place of 0
        check_files(folder, settings.cert_file, settings.key_file)
        self._nodes: dict[str, dict[str, Any]] = {}
        self._assets: dict[str, Any] = {}
        self._newest: dict[str, Mapping[str, Any]] = {}
        self._lock, self._writing = threading.Lock(), asyncio.Lock()
        self._loop = asyncio.new_event_loop()
        self._started, self._stop_event = threading.Event(), asyncio.Event()
        self._trouble = ""
        self._thread = threading.Thread(target=self._serve, name="opcua-server", daemon=True)

    def open(self, statuses: StatusByAsset) -> None:
        """Listen; raises SourceError if the address is not available."""
        self.publish(statuses)
        self._thread.start()
        if not self._started.wait(START_TIMEOUT_S) or self._trouble:
            raise SourceError(f"OPC UA server on {self.settings.listen}: {self._trouble or 'does not start'}")

    def publish(self, statuses: StatusByAsset) -> None:
        """Show what has been stored."""
        with self._lock:
            self._newest |= statuses
        if self._started.is_set() and not self._loop.is_closed():
            with contextlib.suppress(RuntimeError):  # closed in between
                self._loop.call_soon_threadsafe(lambda: self._loop.create_task(self._write_values()))

    def _serve(self) -> None:
        try:
            self._loop.run_until_complete(self._run())
        except Exception as error:  # a library's, whose errors are not all known
            self._trouble = f"{type(error).__name__}: {error}"
            log("error", "OPC UA server stopped", why=self._trouble)
        finally:
            self._started.set()
            for task in asyncio.all_tasks(self._loop):  # sessions of the library, which wait for their end
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    self._loop.run_until_complete(task)
            self._loop.close()

    async def _run(self) -> None:
        ua = import_ua()
        server: Any = import_asyncua().Server()
        server.iserver.bind_condition_methods = REFRESH_SEVERITY
        follow_standard(server.iserver)
        await server.init()
        server.iserver.max_connections, server.iserver.max_pending_activation_seconds = MAX_CONNECTIONS, HANDSHAKE_S
        server.set_endpoint(f"opc.tcp://{self.settings.listen}/servoscope")
        server.set_server_name("servoscope")
        await server.set_application_uri(URI)
        if certificate := self.settings.certificate(self._folder):
            server.set_security_policy([ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt])
            await server.load_certificate(certificate[0])
            await server.load_private_key(certificate[1])
        else:
            server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        self._index = await server.register_namespace(NAMESPACE)
        names = f"ns={self._index};s=servoscope", f"{self._index}:servoscope"
        self._root = await server.nodes.objects.add_object(*names)
        self._health_index, types = await device_health.add_types(server)
        self._conditions = AlarmConditions(server, self._index, types, self._name, operate=self.settings.operate)
        await self._conditions.link()
        await self._write_values()
        async with server:
            self.address = f"{server.bserver.hostname}:{server.bserver.port}"
            self._started.set()
            await self._stop_event.wait()

    async def _write_values(self) -> None:
        async with self._writing:  # one after the other: statuses keep their order
            with self._lock:
                newest, self._newest = self._newest, {}
            for name, status in newest.items():
                if "verdict" in status:
                    await self._write_asset(name, status)
                await self._conditions.update(self._assets.get(name, self._root), name, status)

    async def _write_asset(self, name: str, status: Mapping[str, Any]) -> None:
        if name not in self._nodes:
            node = f"ns={self._index};s={name}"
            self._assets[name] = asset = await self._root.add_object(node, f"{self._index}:{name}")
            self._nodes[name] = {
                key: await asset.add_variable(f"{node}.{key}", f"{self._index}:{key}", value)
                for key, value in VARIABLES.items()
            }
            health = await device_health.add_health(asset, self._health_index, f"{node}.DeviceHealth")
            self._nodes[name]["DeviceHealth"] = health
            await device_health.add_interface(asset, self._health_index)
        for key, value in variable_values(status).items():
            await self._nodes[name][key].write_value(value)

    def take_requests(self) -> list[AlarmCommand]:
        """Return what clients have commanded since the last call."""
        return self._conditions.take_requests()

    def close(self) -> None:
        """Stop listening."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stop_event.set)
            self._thread.join(START_TIMEOUT_S)
