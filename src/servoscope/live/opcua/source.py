"""Blocks from an OPC UA server: arrays as they are written, or single values put on one clock; history fills gaps."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections import deque
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from servoscope.errors import ConfigError
from servoscope.live.block import Block, Resume
from servoscope.live.logs import log
from servoscope.live.opcua.following import Arrays, Followed, Scalars
from servoscope.live.opcua.settings import Nodes, OpcuaSettings, asyncua, password, reach
from servoscope.live.refusals import Refusal, Refusals

__all__ = ["OpcuaSource"]

POLL_S = 0.02
HOLDS_S = 2.0  # behind the server's clock: what has not been told to have changed by then, has not changed
AGAIN_S = 1.0  # between two attempts to connect
BUFFERED = 10_000  # blocks that wait to be polled; then the oldest are let go, which is told


class _Handler:
    """Hears a subscription."""

    def __init__(self, heard: deque[tuple[Any, Any]]) -> None:
        self._heard, self.ended = heard, ""

    def datachange_notification(self, node: Any, _value: Any, data: Any) -> None:
        """Take a value."""
        self._heard.append((node.nodeid, data.monitored_item.Value))

    def status_change_notification(self, status: Any) -> None:
        """Take note of the end."""
        self.ended = str(status.Status)


class OpcuaSource:
    """Follows the nodes of several assets.

    Parameters
    ----------
    settings
        Of the source.
    assets
        Nodes and sample rate [Hz] of each asset.
    folder
        What files are relative to.
    """

    pace = 1.0

    def __init__(self, settings: OpcuaSettings, assets: Mapping[str, tuple[Nodes, float]], folder: Path) -> None:
        asyncua()
        self.settings, self._folder, self._secret = settings, folder, password(settings, folder)
        for name in (settings.cert_file, settings.key_file, settings.server_cert_file):
            if name is not None and not (folder / name).is_file():
                raise ConfigError(f"{folder / name}: no such file, give the certificate's path")
        self._assets = dict(assets)
        self._refusals = Refusals()
        self._waiting: deque[Block] = deque()
        self._over = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()), name="opcua", daemon=True)
        self._followed: list[Followed] = []
        self._beat = self._server_time = math.nan
        self._trouble = ""
        self.up = False

    def open(self, resume: Mapping[str, Resume]) -> None:
        """Connect, now or as soon as the server is there."""
        for name, (nodes, rate) in self._assets.items():
            at = resume.get(name, Resume(-1, math.nan))
            if nodes.block is not None:
                self._followed.append(Arrays(name, nodes.block, at, self._take, self._refusals))
            else:
                signals = [node for node in (nodes.r, nodes.u, nodes.y) if node is not None]
                size = max(1, round(self.settings.block * rate))
                self._followed.append(Scalars(name, signals, rate, size, at, self._take, self._refusals))
        self._thread.start()

    def _take(self, block: Block) -> None:
        if len(self._waiting) >= BUFFERED:
            lost = self._waiting.popleft()
            self._refusals.add(lost.asset, "overflow", "blocks wait longer than there is room for them")
        self._waiting.append(block)

    async def _run(self) -> None:
        """Follow the server through its restarts, in a thread of its own."""
        while not self._over.is_set():
            try:
                client = await reach(self.settings, self._secret, self._folder)
                async with client:
                    await self._follow(client)
            except Exception as error:  # whatever a library, a network or a server comes up with: try again
                if not self._over.is_set():
                    self._tell(f"{type(error).__name__}: {' '.join(str(error).split())[:200]}")
            self.up = False
            await asyncio.sleep(AGAIN_S if not self._over.is_set() else 0.0)

    def _tell(self, trouble: str) -> None:
        if trouble != self._trouble:
            log("error", "OPC UA server cannot be followed", url=self.settings.url, why=trouble)
        self._trouble = trouble

    async def _follow(self, client: Any) -> None:
        """Subscribe, make up for what was missed, and go on until the server is silent."""
        from asyncua import ua

        by_node: dict[Any, list[tuple[Followed, int]]] = {}
        for one in self._followed:
            for k, node in enumerate(one.nodes):
                by_node.setdefault(ua.NodeId.from_string(node), []).append((one, k))
        heard: deque[tuple[Any, Any]] = deque()
        subscribed = await self._subscribe(client, heard)
        beat = ua.NodeId.from_string(self.settings.heartbeat)
        now, period = self._time_of(await client.get_node(beat).read_data_value()), self.settings.publishing_s
        for one in self._followed:
            await one.catch_up(client, now)
        self.up, self._trouble, self._beat = True, "", time.monotonic()
        log("info", "OPC UA server followed", url=self.settings.url)
        while not self._over.is_set():
            await asyncio.sleep(period / 2.0)
            while heard:
                node, value = heard.popleft()
                if node == beat:
                    self._server_time, self._beat = self._time_of(value), time.monotonic()
                for one, k in by_node.get(node, ()):
                    one.take(k, value)
            if time.monotonic() - self._beat > self.settings.heartbeat_s:
                raise ConnectionError(f"no heartbeat for {self.settings.heartbeat_s:g} s")
            if subscribed.ended:
                raise ConnectionError(f"the server has ended the subscription ({subscribed.ended})")
            for one in self._followed:
                one.make(self._server_time - max(HOLDS_S, 4.0 * period))

    async def _subscribe(self, client: Any, heard: deque[tuple[Any, Any]]) -> _Handler:
        """Ask for all nodes and the heartbeat."""
        from asyncua import ua
        from asyncua.ua.attribute_ids import AttributeIds

        handler, period = _Handler(heard), self.settings.publishing_s
        subscription = await client.create_subscription(1000.0 * period, handler)
        stamped = ua.DataChangeFilter(Trigger=ua.DataChangeTrigger.StatusValueTimestamp)
        wanted = {node: (one.sampling_ms, one.queue(period)) for one in self._followed for node in one.nodes}
        wanted[self.settings.heartbeat] = (1000.0 * period, 1)
        items = [
            ua.MonitoredItemCreateRequest(
                ua.ReadValueId(NodeId=ua.NodeId.from_string(node), AttributeId=AttributeIds.Value),
                ua.MonitoringMode.Reporting,
                ua.MonitoringParameters(ClientHandle=k, SamplingInterval=sampling, QueueSize=queue, Filter=stamped),
            )
            for k, (node, (sampling, queue)) in enumerate(wanted.items(), 1)
        ]
        for node, answer in zip(wanted, await subscription.create_monitored_items(items), strict=True):
            if not isinstance(answer, int):
                raise ConfigError(f"{node} cannot be subscribed to ({answer.name})")
        return handler

    @staticmethod
    def _time_of(value: Any) -> float:
        """Return the time that a beat tells."""
        beat = value.Value.Value if value.Value is not None else None
        stamp = beat if isinstance(beat, datetime) else value.SourceTimestamp or value.ServerTimestamp
        return (stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)).timestamp() if stamp else math.nan

    def poll(self, most: int) -> list[Block]:
        """Return blocks in the order in which they came."""
        return [self._waiting.popleft() for _ in range(min(most, len(self._waiting)))]

    def acknowledge(self, asset: str, blocks: int) -> None:
        """Do nothing: a server does not ask, and what was not stored is read from its history after a restart."""

    def refused(self) -> list[Refusal]:
        """Return what could not be used since the last call."""
        return self._refusals.taken()

    @property
    def waits(self) -> float:
        """How long until the next block may be due [s]."""
        return 0.0 if self._waiting else POLL_S

    def close(self) -> None:
        """Disconnect."""
        self._over.set()
        self._thread.join(2.0 * self.settings.heartbeat_s)
