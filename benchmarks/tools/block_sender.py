"""Sends blocks of many assets to a broker, evenly, as cheaply as Python can: a process of its own.

Each second of samples is encoded once per group of assets, the packets of MQTT 5 (OASIS 2019, 3.3) are written by hand
around it, and the socket takes many at once. Acknowledgements are read and counted.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from typing import NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.service.mqtt.payload import encode_binary, encode_json
from servoscope.service.mqtt.topics import data_topic
from servoscope.service.sources.block import Block

GROUPS = 20  # of assets: one begins its seconds a twentieth of a second after the other, and elsewhere in the recording
OFFSET_S = 3  # in the recording, from group to group
TICK_S = 0.01  # what falls due within it is sent together
PIECES = 512  # buffers that the socket takes at once; Linux allows 1024
CONNACK, PUBLISH, PUBACK, DISCONNECT = 0x20, 0x32, 0x40, bytes([0xE0, 0])
RECEIVE_MAXIMUM = 0x21  # property of the broker's answer: messages that may be out unacknowledged
NOBODY, FAILURE = 0x10, 0x80  # reason codes of an acknowledgement: nobody has subscribed; from here on it is refused


class Feed(NamedTuple):
    """What is sent: `blocks` of a second of each asset, at `speed` times the true one; 0: as they are taken."""

    port: int
    assets: int
    blocks: int
    speed: float
    rate: float  # of samples [Hz]
    binary: bool
    ahead: int = 0  # with `speed` 0, blocks of each asset that may be sent and not yet counted


class SenderReport(NamedTuple):
    """How many blocks are sent and acknowledged by the broker, and what it says of them; how late the last one was."""

    sent: int
    acknowledged: int
    unheard: int
    refused: int
    late_s: float


def variable_length(n: int) -> bytes:
    """Return a length as MQTT writes it (1.5.5)."""
    found = bytearray()
    while n > 127:
        found.append(n & 127 | 128)
        n >>= 7
    return bytes([*found, n])


def text(value: str) -> bytes:
    """Return a text as MQTT writes it (1.5.4)."""
    return len(value).to_bytes(2, "big") + value.encode()


class PacketSender:
    """A connection to a broker that publishes with quality 1, and never has too much unacknowledged."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port))
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        body = text("MQTT") + bytes([5, 2, 0, 0, 0]) + text("sender")  # clean start, no pings, no properties
        self._socket.sendall(bytes([0x10]) + variable_length(len(body)) + body)
        answer = self._socket.recv(4096)  # which is short, and comes whole
        if answer[0] != CONNACK or answer[3]:
            raise ConnectionError(f"the broker refuses: {answer!r}")
        at = answer.find(RECEIVE_MAXIMUM, 5)
        self._limit = min(60_000, int.from_bytes(answer[at + 1 : at + 3], "big") if at > 0 else 60_000)
        self._rest, self._mid = b"", 0
        self.sent = self.acknowledged = self.unheard = self.refused = 0

    def send(self, messages: list[tuple[bytes, bytes]]) -> None:
        """Send pairs of topic, as MQTT writes it, and payload."""
        pieces = list[bytes]()
        for topic, payload in messages:
            while self.sent + len(pieces) // 2 - self.acknowledged >= self._limit:
                self._write(pieces)
                self.read_acks(wait=True)
                pieces = []
            self._mid = self._mid % 65535 + 1
            head = variable_length(len(topic) + 3 + len(payload))
            pieces += (b"".join((b"\x32", head, topic, self._mid.to_bytes(2, "big"), b"\0")), payload)
            if len(pieces) >= PIECES:
                self._write(pieces)
                pieces = []
        self._write(pieces)
        self.read_acks(wait=False)

    def _write(self, pieces: list[bytes]) -> None:
        if pieces:
            done = self._socket.sendmsg(pieces)
            if done < sum(map(len, pieces)):
                self._socket.sendall(memoryview(b"".join(pieces))[done:])
            self.sent += len(pieces) // 2

    def read_acks(self, *, wait: bool) -> None:
        """Count acknowledgements; `wait` for at least one piece of them."""
        try:
            data = self._rest + self._socket.recv(2**18, 0 if wait else socket.MSG_DONTWAIT)
        except BlockingIOError:
            return
        at = 0
        while at + 2 <= len(data) and at + 2 + data[at + 1] <= len(data):  # all are short
            if data[at] == PUBACK:
                reason = data[at + 4] if data[at + 1] > 2 else 0
                self.acknowledged += 1
                self.unheard += reason == NOBODY
                self.refused += reason >= FAILURE
            elif data[at] == DISCONNECT[0]:
                raise ConnectionError(f"the broker ends the connection: {data[at:]!r}")
            at += 2 + data[at + 1]
        self._rest = data[at:]

    def close(self) -> None:
        """Wait for all acknowledgements, and disconnect."""
        while self.acknowledged < self.sent:
            self.read_acks(wait=True)
        self._socket.sendall(DISCONNECT)
        self._socket.close()

    def report(self, late_s: float) -> SenderReport:
        """Return what is counted."""
        return SenderReport(self.sent, self.acknowledged, self.unheard, self.refused, late_s)


def batches(feed: Feed, recording: FloatArray, began: float) -> Iterator[tuple[float, list[tuple[bytes, bytes]]]]:
    """Yield what is sent together, and when it is due, behind the beginning [s]; `recording`: r, u, y, shape (3, N)."""
    encode: Callable[[Block], bytes] = encode_binary if feed.binary else encode_json
    n, groups = round(feed.rate), min(GROUPS, feed.assets)
    names = [text(data_topic("servoscope", f"axis{i:05d}")) for i in range(feed.assets)]
    for k in range(feed.blocks):
        for g in range(groups):
            begin = (k + g * OFFSET_S) * n
            t = began + k + g / groups + np.arange(n) / n
            payload = encode(Block("", k, t, *recording[:, begin : begin + n]))
            members = names[g::groups]
            ticks = max(1, min(len(members), round(1.0 / groups / TICK_S)))
            for tick in range(ticks):
                due = k + 1.0 + (g + (tick + 1) / ticks) / groups
                yield due, [(name, payload) for name in members[tick::ticks]]


def send_blocks(feed: Feed, recording: FloatArray, parent: Connection) -> None:
    """Send all; report to the parent once a second. With speed 0 it says how many blocks the service has counted."""
    sender = PacketSender(feed.port)
    start, counted, reported, late_s = time.monotonic(), 0, 0.0, 0.0
    # no time stamp lies ahead of the clock
    began = time.time() - (feed.blocks * max(0.0, 1.0 - 1.0 / feed.speed) if feed.speed else feed.blocks + 2.0)
    for due, messages in batches(feed, recording, began):
        if feed.speed:
            late_s = time.monotonic() - start - due / feed.speed
            time.sleep(max(0.0, -late_s))
        while not feed.speed and sender.sent + len(messages) > counted + feed.ahead * feed.assets:
            counted = parent.recv()
        while parent.poll():
            counted = parent.recv()
        sender.send(messages)
        if time.monotonic() - reported > 1.0:
            reported = time.monotonic()
            parent.send(sender.report(late_s))
    sender.close()
    parent.send(sender.report(late_s))
    while True:  # until somebody has read our processor time, and ends us
        parent.recv()
