"""Blocks from an OPC UA server: arrays as they are written, or single values on one clock; history fills gaps."""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from servoscope.core.addresses import show_address
from servoscope.core.errors import ConfigError
from servoscope.core.messages import message, render
from servoscope.core.settings import NonEmptyStr
from servoscope.service.assets.reception import Reception
from servoscope.service.config_types import Seconds, matching, read_password
from servoscope.service.log import log
from servoscope.service.network import ConnectionSettings
from servoscope.service.opcua.settings import (
    CertificateSettings,
    OpcuaNodes,
    check_files,
    check_nodes,
    describe_expiry,
    import_asyncua,
)
from servoscope.service.opcua.subscriptions import (
    QUEUE_MARGIN,
    ArraySubscription,
    ItemTerms,
    ScalarSubscription,
    monitor_nodes,
    shorten_interval,
    timestamp,
)
from servoscope.service.sources.block import Block, ResumePosition
from servoscope.service.sources.inbox import Inbox
from servoscope.service.sources.message import BlockDecoder, InboxMessage, SourceAsset, ThreadTransport
from servoscope.service.sources.settings import SourceSettings

SETTLING_S = 2.0  # behind the server's clock: a change that has not been reported by then has not happened
RETRY_NODES_S = 30.0  # between two attempts to subscribe to nodes that the server has refused
RECONNECT_S = 1.0  # between two attempts to connect
SERVER_TIME = "i=2258"  # Server_ServerStatus_CurrentTime, which every server has


# the message does not name the address, which may hold a password
URL_CHECK = matching(r"opc\.tcp://[^\s/]+(/.*)?", "is no address, write opc.tcp://host:4840")


class OpcuaSourceSettings(ConnectionSettings, CertificateSettings, SourceSettings):
    """A source of kind ``opcua``."""

    asset_key: ClassVar[str] = "nodes"
    asset_example: ClassVar[str] = "nodes: nodes = { r = ..., u = ..., y = ... }"

    kind: Literal["opcua"]
    # of the server, ``opc.tcp://host:4840``
    url: Annotated[str, Field(strict=True), URL_CHECK]
    # user, password_file: who we are; the password is the first line of a file, relative to the service file
    user: NonEmptyStr | None = None
    password_file: NonEmptyStr | None = None
    server_cert_file: NonEmptyStr | None = None  # the certificate that the server must have; None: any
    publishing_s: Seconds = 0.2  # how often the server sends what has changed [s]
    block: Seconds = 1.0  # length of the blocks that are made of single values [s]
    # node whose time shows that the server is alive: a date, or any value with a time stamp of its source
    heartbeat: NonEmptyStr = SERVER_TIME
    heartbeat_s: Seconds = 5.0  # without a heartbeat for so long, the connection is made anew [s]

    def create(self, name: str, assets: Mapping[str, SourceAsset], folder: Path) -> Inbox:
        """Return the source of these nodes."""
        return Inbox(OpcuaTransport(self, assets, folder), BlockDecoder(), assets)

    def carries(self, covariate: str, address: OpcuaNodes) -> bool:
        """Arrays have what the loop's columns name; single values, what the nodes name."""
        return address.block is not None or covariate in address.covariates


async def create_opcua_client(settings: OpcuaSourceSettings, password: str | None, folder: Path) -> Any:
    """Return a client that is not yet connected."""

    class CheckedOpcuaClient(import_asyncua().Client):  # type: ignore[misc]  # the library is loaded only here
        """Connects to an address that was checked, and not to a name that may mean another one by then."""

        async def connect_socket(self) -> None:
            host, port = self.server_url.hostname, self.server_url.port
            await self.uaclient.connect_socket(await asyncio.to_thread(settings.rules.resolve, host, port), port)

    client = CheckedOpcuaClient(settings.url, timeout=settings.heartbeat_s)
    client.name, client.application_uri = "servoscope", "urn:servoscope:client"
    if settings.user is not None:
        client.set_user(settings.user)
        client.set_password(password or "")
    if certificate := settings.certificate(folder):
        from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256

        server = str(folder / settings.server_cert_file) if settings.server_cert_file else None
        await client.set_security(SecurityPolicyBasic256Sha256, *certificate, server_certificate=server)
    return client


class _SubscriptionHandler:
    """Queues what a subscription reports; the library calls its methods."""

    def __init__(self, values: deque[tuple[Any, Any]]) -> None:
        self._values, self.end_status = values, ""

    def datachange_notification(self, node: Any, _value: Any, data: Any) -> None:
        """Queue a value."""
        self._values.append((node.nodeid, data.monitored_item.Value))

    def status_change_notification(self, status: Any) -> None:
        """Note that the server has ended the subscription."""
        self.end_status = str(status.Status)


class OpcuaTransport(ThreadTransport):
    """Subscribes to the nodes of several assets, and makes blocks of their values.

    A server waits for no acknowledgement: what was not stored is read from its history after a restart.
    """

    keeps = False

    def __init__(self, settings: OpcuaSourceSettings, assets: Mapping[str, SourceAsset], folder: Path) -> None:
        super().__init__()
        import_asyncua()
        self.settings, self._folder = settings, folder
        self._password = read_password(settings.password_file, folder)
        check_files(folder, settings.cert_file, settings.key_file, settings.server_cert_file)
        self._assets = dict(assets)
        check_nodes(settings.heartbeat, *(node for asset in self._assets.values() for node in asset.address.given))
        self._handles = 1  # of the next item that is monitored
        self.ends_within_s = 2.0 * settings.heartbeat_s
        self._subscriptions: list[ArraySubscription | ScalarSubscription] = []
        self._last_heartbeat = self._server_time = math.nan
        self.trouble, self.connected = render(message("service.trouble.connecting")), False

    @property
    def asset_troubles(self) -> dict[str, Reception]:  # type: ignore[override]
        """Assets whose nodes are refused, or come too slowly."""
        return {
            subscription.asset: subscription.trouble
            for subscription in self._subscriptions
            if subscription.trouble is not None
        }

    @property
    def update_intervals_s(self) -> dict[tuple[str, str], float]:  # type: ignore[override]
        """Time between two updates, as measured, by asset and signal [s]."""
        return {
            (subscription.asset, name): value
            for subscription in self._subscriptions
            for name, value in subscription.intervals_s.items()
        }

    def open(self, resume: Mapping[str, ResumePosition]) -> None:
        """Connect, now or as soon as the server is there."""
        for name, asset in self._assets.items():
            nodes, rate, wanted = asset.address, asset.loop.sample_rate, asset.covariates
            at, common = resume.get(name, ResumePosition(-1, math.nan)), (self._enqueue, self.rejections)
            if nodes.block is not None:
                self._subscriptions.append(ArraySubscription(name, [nodes.block], at, *common, wanted))
            else:
                signals = [*nodes.signals, *(nodes.covariates[covariate] for covariate in wanted)]
                size = max(1, round(self.settings.block * rate))
                self._subscriptions.append(ScalarSubscription(name, signals, at, *common, rate, size, wanted))
        super().open(resume)

    def _enqueue(self, block: Block) -> None:
        self.waiting.append(InboxMessage(block.asset, block, block.completed_at))

    def _run(self) -> None:
        asyncio.run(self._follow())

    async def _follow(self) -> None:
        """Follow the server through its restarts."""
        while not self._stop_event.is_set():
            try:
                async with await create_opcua_client(self.settings, self._password, self._folder) as client:
                    await self._run_subscription(client)
            except Exception as error:  # whatever a library, a network or a server comes up with: try again
                if not self._stop_event.is_set():
                    words = " ".join(str(error).split())[:200]
                    self._log_trouble(
                        render(message("service.trouble.unreachable", reason=words or type(error).__name__))
                    )
            self.connected = False
            await asyncio.sleep(RECONNECT_S if not self._stop_event.is_set() else 0.0)

    def _log_trouble(self, trouble: str) -> None:
        if trouble != self.trouble:
            log("error", "OPC UA server cannot be followed", url=show_address(self.settings.url), why=trouble)
        self.trouble = trouble

    async def _run_subscription(self, client: Any) -> None:
        """Subscribe, read what was missed, and continue until the server is silent."""
        from asyncua import ua

        by_node: dict[Any, list[tuple[ArraySubscription | ScalarSubscription, int]]] = {}
        for feed in self._subscriptions:
            for k, node in enumerate(feed.nodes):
                by_node.setdefault(ua.NodeId.from_string(node), []).append((feed, k))
        values: deque[tuple[Any, Any]] = deque()
        handler, period = _SubscriptionHandler(values), self.settings.publishing_s
        subscription = await client.create_subscription(1000.0 * period, handler)
        grants = dict[str, ItemTerms]()
        period = await self._subscribe(subscription, grants)
        heartbeat = ua.NodeId.from_string(self.settings.heartbeat)
        now = _parse_heartbeat(await client.get_node(heartbeat).read_data_value())
        for feed in self._subscriptions:
            await feed.read_missed(client, now)
        self.connected, self._last_heartbeat = True, time.monotonic()
        self.trouble = describe_expiry(client, self._folder, self.settings, datetime.now(UTC))
        retry_at = time.monotonic() + RETRY_NODES_S
        log("info", "OPC UA server followed", url=show_address(self.settings.url))
        while not self._stop_event.is_set():
            await asyncio.sleep(period / 2.0)
            while values:
                node, value = values.popleft()
                if node == heartbeat:
                    self._server_time, self._last_heartbeat = _parse_heartbeat(value), time.monotonic()
                for feed, k in by_node.get(node, ()):
                    feed.add_value(k, value)
            if time.monotonic() - self._last_heartbeat > self.settings.heartbeat_s:
                raise ConnectionError(f"no heartbeat for {self.settings.heartbeat_s:g} s")
            if handler.end_status:
                raise ConnectionError(f"the server has ended the subscription ({handler.end_status})")
            for feed in self._subscriptions:
                feed.emit_blocks(self._server_time - max(SETTLING_S, 4.0 * period))
            missing = any(grant.refusal for grant in grants.values())
            if missing and time.monotonic() >= retry_at:  # the PLC may have been given its program meanwhile
                retry_at = time.monotonic() + RETRY_NODES_S
                period = await self._subscribe(subscription, grants)

    async def _subscribe(self, subscription: Any, grants: dict[str, ItemTerms]) -> float:
        """Subscribe to the heartbeat and to all nodes that are not yet granted; return the publishing interval [s].

        A server may grant less than it was asked for: where its queues are shorter, messages have to come sooner.
        """
        period = float(subscription.parameters.RequestedPublishingInterval) / 1000.0  # as the server has revised it [s]
        heartbeat = self.settings.heartbeat
        wanted = {
            node: ItemTerms(subscription.sampling_ms, subscription.queue_size(period))
            for subscription in self._subscriptions
            for node in subscription.nodes
        }
        wanted[heartbeat] = ItemTerms(1000.0 * period, 1)
        missing = {node: terms for node, terms in wanted.items() if node not in grants or grants[node].refusal}
        changed = [
            subscription for subscription in self._subscriptions if not missing.keys().isdisjoint(subscription.nodes)
        ]
        grants |= await monitor_nodes(subscription, missing, self._handles)
        self._handles += len(missing)
        if grants[heartbeat].refusal:
            raise ConfigError(render(message("service.trouble.node", node=heartbeat, reason=grants[heartbeat].refusal)))
        longest = min(
            (subscription.longest_interval_s(grants) for subscription in self._subscriptions), default=math.inf
        )
        if longest < period:
            period = await shorten_interval(subscription, longest / QUEUE_MARGIN)
        for feed in changed:
            feed.check_grants(grants, period)
        return period


def _parse_heartbeat(value: Any) -> float:
    """Return the time of a heartbeat [UTC s]: its value if that is a date, else its time stamp."""
    beat = value.Value.Value if value.Value is not None else None
    stamp = beat if isinstance(beat, datetime) else value.SourceTimestamp or value.ServerTimestamp
    return timestamp(stamp) if stamp else math.nan
