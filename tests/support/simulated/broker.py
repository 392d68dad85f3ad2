"""A broker, its clients, and senders: sessions, QoS 1, retained messages, redelivery, reorder across topics, loss."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

from servoscope.service.mqtt import payload, topics
from servoscope.service.sources.block import Block
from simulated.clock import Clock, Process
from simulated.faults import Plan

PREFIX = "servoscope"
LATENCY_S = 0.03
RETRY_S = 1.0  # of a client that found nobody
AHEAD, AGAIN_S = 4, 2.0  # blocks that a sender keeps; after how long it sends its oldest once more
SAMPLES, RATE = 25, 100.0  # of a block


@dataclass
class Session:
    """What the broker keeps of a client that is subscribed."""

    topics: set[str] = field(default_factory=set)
    queue: deque[tuple[str, bytes, bool]] = field(default_factory=deque)
    open: dict[int, tuple[str, bytes, bool]] = field(default_factory=dict)  # sent and not acknowledged, by number
    client: Client | None = None
    next_mid: int = 1


class Broker:
    """Keeps messages for sessions, and hands them over one by one, those of one topic in their order."""

    def __init__(self, clock: Clock, plan: Plan, most_open: int) -> None:
        self.clock, self.plan, self.most, self.up = clock, plan, most_open, True
        self._chance = random.Random(plan.chance.random())
        self.sessions: dict[str, Session] = {}
        self.retained: dict[str, bytes] = {}
        self.listeners: list[Callable[[str, bytes], None]] = []  # senders, which hear acknowledgements
        self.cables = {"service": True}
        self.reorder = False
        self.watch: Callable[[str, bytes], None] = lambda *_: None

    def publish(self, topic: str, content: bytes, retain: bool = False) -> None:
        """Take a message."""
        self.plan.note(topic, content)
        self.watch(topic, content)
        if retain:
            self.retained[topic] = content
        for session in self.sessions.values():
            if topic in session.topics:
                session.queue.append((topic, content, False))
                self._pump(session)
        for listen in self.listeners:
            self.clock.spawn(listen, topic, content, after=LATENCY_S)

    def _pump(self, session: Session) -> None:
        if session.client is not None and not session.client.pumping:
            session.client.pumping = True
            self.clock.spawn(self._deliver, session, session.client, after=self._chance.uniform(0.1, 1.0) * LATENCY_S)

    def _deliver(self, session: Session, client: Client) -> None:
        client.pumping = False
        for _ in range(self._chance.randrange(1, 8)):
            if session.client is not client or not session.queue or len(session.open) >= self.most:
                return
            message = session.queue[0]
            if self.reorder:
                heads = {topic: item for item in reversed(session.queue) for topic in [item[0]]}
                message = heads[self._chance.choice(sorted(heads))]
            session.queue.remove(message)
            mid, session.next_mid = session.next_mid, session.next_mid % 20 + 1  # few numbers, so that they come again
            while mid in session.open:
                mid = mid % 20 + 1
            session.open[mid] = message
            client.take(message, mid)
        self._pump(session)

    def acknowledge(self, client: Client, mid: int) -> tuple[str, bytes, bool] | None:
        """Forget a message that its receiver has."""
        session = self.sessions.get(client.name)
        if session is None or session.client is not client:
            return None
        message = session.open.pop(mid, None)
        self._pump(session)
        return message

    def connect(self, client: Client) -> bool:
        """Let a client have its session; return whether somebody is there."""
        if not self.up or not self.cables[client.cable]:
            return False
        session = self.sessions.setdefault(client.name, Session())
        if session.client is not None:
            session.client.lose()
        session.client = client
        return True

    def lose(self, client: Client) -> None:
        """A connection has ended: what was not acknowledged is sent again in the next one."""
        session = self.sessions.get(client.name)
        if session is not None and session.client is client:
            session.client = None
            session.queue.extendleft(reversed(session.open.values()))
            session.open.clear()

    def restart(self, down_s: float, forgets: bool) -> None:
        """End all connections, for a while; `forgets`: with its sessions and all that waits in them."""
        self.up = False
        for session in list(self.sessions.values()):
            if session.client is not None:
                session.client.lose()
        if forgets:
            self.sessions.clear()
            self.retained.clear()
        self.clock.spawn(self._rise, after=down_s)

    def _rise(self) -> None:
        self.up = True

    def pull(self, cable: str, down_s: float) -> None:
        """Pull a cable for a while."""
        self.cables[cable] = False
        for session in list(self.sessions.values()):
            if session.client is not None and session.client.cable == cable:
                session.client.lose()
        self.clock.spawn(self.cables.__setitem__, cable, True, after=down_s)

    def repeat(self) -> None:
        """Send once more what is not acknowledged yet, as brokers may."""
        for session in self.sessions.values():
            if session.client is not None and session.open:
                client = session.client
                client.lose()


class Client:
    """What `create_mqtt_client` returns to the service: a client of paho-mqtt, as far as it is used.

    As paho's, it has one thread, in which all that it calls follows each other: a connection's end is told after the
    last message of that connection, and before the next one is tried.
    """

    thread_s = 0.0

    def __init__(self, broker: Broker, name: str, receive: Callable[..., None] | None, process: Process | None) -> None:
        self._broker, self.name, self.cable, self._receive = broker, name, "service", receive
        self.on_connect = self.on_connect_fail = self.on_disconnect = lambda *_: None
        self.process, self.pumping, self._wanted, self._connected = process, False, False, False
        self._events, self._works = deque[Callable[[], None]](), False  # what its thread has still to do
        self.acknowledged: Callable[[str, bytes], None] = lambda *_: None
        self.received: Callable[[str], None] = lambda _: None

    @property
    def empty_at(self) -> float:
        """When nothing had come."""
        return self._broker.clock.now

    def connect_async(self, *_: Any, **__: Any) -> None:
        """Note that a connection is wanted."""
        self._wanted = True

    def loop_start(self) -> None:
        """Connect soon."""
        self._put(self._try)

    def _put(self, event: Callable[[], None]) -> None:
        self._events.append(event)
        if not self._works:
            self._works = True
            self._broker.clock.spawn(self._work, process=self.process)

    def _work(self) -> None:
        while self._events:
            self._events.popleft()()
        self._works = False

    def _try(self) -> None:
        self._broker.clock.sleep(LATENCY_S)
        while self._wanted and not self._connected:
            if self._broker.connect(self):
                self._connected = True
                self.on_connect(self, None, None, SimpleNamespace(is_failure=False), None)
                return
            self.on_connect_fail(self, None)
            self._broker.clock.sleep(RETRY_S)

    def lose(self) -> None:
        """The connection ends."""
        if self._connected:
            self._connected = False
            self._broker.lose(self)
            if self.process is None or not self.process.dead:
                self._put(lambda: self.on_disconnect(self, None, None, SimpleNamespace(value=0x80), None))
                self._put(self._try)

    def disconnect(self) -> None:
        """End the connection on purpose, or because the process is gone."""
        self._wanted = False
        if self._connected:
            self._connected = False
            self._broker.lose(self)

    def loop_stop(self) -> None:
        """Stop."""

    def subscribe(self, wanted: list[tuple[str, Any]]) -> None:
        """Subscribe to topics; retained messages of them come."""
        session = self._broker.sessions.get(self.name)
        if self._connected and session is not None:
            session.topics.update(topic for topic, _ in wanted)

    def unsubscribe(self, topic: str) -> None:
        """Unsubscribe."""
        session = self._broker.sessions.get(self.name)
        if session is not None:
            session.topics.discard(topic)

    def publish(self, topic: str, content: bytes, qos: int = 0, retain: bool = False) -> None:
        """Publish."""
        fault = self._point("confirm before")
        if self._connected and fault != "error":
            self._broker.publish(topic, content, retain)
        self._point("confirm after")

    def take(self, message: tuple[str, bytes, bool], mid: int) -> None:
        """Take a message from the broker."""
        from servoscope.service.mqtt.paho_clients import ReceivedMessage

        assert self._receive is not None
        topic, content, retain = message
        self.received(topic)
        receive, received = self._receive, ReceivedMessage(topic, content, 1, mid, retain)
        if self._works:
            self._put(lambda: receive(received))
        else:  # the thread has nothing else to do, and a message takes no time
            receive(received)

    def ack(self, mid: int, qos: int) -> None:
        """Acknowledge a message."""
        self._point("acknowledge before")
        if self._connected and (message := self._broker.acknowledge(self, mid)):
            self.acknowledged(*message[:2])
        self._point("acknowledge after")

    def _point(self, place: str) -> str:
        return point(self._broker.clock, self._broker.plan, place, self.process)


def point(clock: Clock, plan: Plan, place: str, process: Process | None = None) -> str:
    """Let a fault strike at a place in a process, if one is to; return which, if it is left to who calls."""
    process = process or clock.process
    if process is None or process.name != "service" or process.dead:
        return ""
    fault = plan.strikes(place)
    if fault == "kill":
        clock.kill(process)
    elif fault == "delay":
        clock.sleep(plan.chance.uniform(0.5, 4.0))
        return ""
    return fault


class Sender:
    """Sends the blocks of an asset; one that keeps them sends them again until they are stored.

    `sent`: all blocks that it has ever sent, by number; `misdated`: those that a wrong clock has dated.
    """

    def __init__(self, broker: Broker, asset: str, signals: np.ndarray, *, keeps: bool) -> None:
        self._broker, self.asset, self._signals, self.keeps = broker, asset, signals, keeps
        self._clock, self.began = broker.clock, broker.clock.time()
        self.sent: dict[int, Block] = {}
        self.misdated = set[int]()
        self._kept = deque[tuple[int, bytes]]()
        self._made, self._next, self._again_at, self.quiet_until = self.began, 0, 0.0, 0.0
        self.over, self._ahead, self._shift, self.skip = False, 0, 0.0, 0
        self.leaks = False
        broker.cables[asset] = True
        broker.listeners.append(self._hear)

    @property
    def waiting(self) -> int:
        """How many blocks it keeps."""
        return len(self._kept)

    def run(self) -> None:
        """Send until it is over, and then until all is acknowledged."""
        while True:
            self._clock.sleep(SAMPLES / RATE)
            if self._clock.now < self.quiet_until:
                self._made = self._clock.time()
                continue
            if not self.over and len(self._kept) < AHEAD:
                self._make()
            if self.keeps and self._kept and self._clock.now >= self._again_at:
                self.again()

    def _make(self) -> None:
        n, row = self._next, int(self.leaks)
        at = n * SAMPLES % (self._signals.shape[-1] - SAMPLES)
        if self.skip:  # samples are missing
            self._made += self.skip / RATE
            self.skip = 0
        t = self._made + np.arange(SAMPLES) / RATE
        if self._ahead:
            self._ahead -= 1
            self.misdated.add(n)
            t = t + self._shift
        self._made += SAMPLES / RATE
        r, u, y = self._signals[row, :, at : at + SAMPLES]
        block = Block(self.asset, n, t, r, u, y)
        self.sent[n], self._next = block, n + 1
        if not self.keeps:
            self._send(payload.encode_binary(block))
            return
        self._kept.append((n, payload.encode_binary(block, self._kept[0][0] if self._kept else n)))
        if len(self._kept) == 1:
            self._again_at = self._clock.now + AGAIN_S
        self._send(self._kept[-1][1])

    def _send(self, message: bytes) -> None:
        if self._broker.up and self._broker.cables[self.asset]:
            self._broker.publish(topics.data_topic(PREFIX, self.asset), message)

    def again(self) -> None:
        """Send once more all that is kept."""
        self._again_at = self._clock.now + AGAIN_S
        for _, message in self._kept:
            self._send(message)

    def misdate(self, blocks: int, by_s: float) -> None:
        """Date some blocks by a clock that is wrong."""
        self._ahead, self._shift = blocks, by_s

    def _hear(self, topic: str, content: bytes) -> None:
        if self.keeps and topic == topics.ack_topic(PREFIX, self.asset) and self._broker.cables[self.asset]:
            _, sequence = topics.decode_ack(content)
            while self._kept and self._kept[0][0] <= sequence:
                self._kept.popleft()
                self._again_at = self._clock.now + AGAIN_S
