"""Clients of paho-mqtt: one for a few messages, and one that reads and acknowledges many at once."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

from paho.mqtt.client import Client, MQTTMessageInfo, MQTTv5
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode

READ_BYTES = 2**18  # most bytes that are taken from the socket at once
READS = 16  # after so many, what waits to be written has its turn
GATHER_S = 0.05  # most time between two looks at the socket: waking for each message costs three times as much
GATHER_SHARE = 0.25  # of the socket's buffer, beyond which nothing is waited for: the broker must never wait for us
PUBLISH, PUBACK, TYPE_BITS = 0x30, 0x40, 0xF0  # types of packets
QOS_1, QOS_BITS, RETAIN = 0x02, 0x06, 0x01  # bits of a PUBLISH beside its type
ACK = struct.Struct(">BBH")  # type, bytes that follow, number of the message


class CheckedClient(Client):
    """Connects to the `address` that was checked, and not to a name that may mean another one by then."""

    def __init__(self, address: Callable[[], tuple[str, int]], client_id: str, *, manual_ack: bool = False) -> None:
        super().__init__(CallbackAPIVersion.VERSION2, client_id, protocol=MQTTv5, manual_ack=manual_ack)
        self._address = address

    def _create_socket_connection(self) -> socket.socket:
        return socket.create_connection(self._address(), self.connect_timeout)


class ReceivedMessage(NamedTuple):
    """A message, with its quality of service, and its number, by which it is acknowledged."""

    topic: str
    payload: bytes
    qos: int
    mid: int
    retain: bool


class BulkClient(CheckedClient):
    """Hands each message to `on_received`, in their order; they are acknowledged by `ack`.

    paho asks the socket four times for each message, and wakes its thread for each message and each acknowledgement.
    Here the socket is left alone for a moment after it was read, then read in large pieces, and the whole messages in
    them are taken apart at once (MQTT 5.0, OASIS 2019, 3.3). All else, the connection, TLS, pings and every other
    packet, stays with paho.

    Attributes
    ----------
    empty_at
        When the socket was last seen without a message, monotonic [s]: what is read now came after that.
    thread_s
        Processor time of the client's thread so far [s].
    """

    def __init__(
        self, address: Callable[[], tuple[str, int]], client_id: str, on_received: Callable[[ReceivedMessage], None]
    ) -> None:
        super().__init__(address, client_id, manual_ack=True)
        self._on_received = on_received
        self._piece, self._at = b"", 0  # what the socket gave last, and how far it was read
        self._acks, self._acks_lock = list[bytes](), threading.Lock()
        self._read_at, self._gather_s = 0.0, 0.0  # when the socket was read, and how long it is left alone from then on
        self._is_empty, self.empty_at, self.thread_s = True, 0.0, 0.0
        self.on_message = lambda _client, _data, message: on_received(
            # not `message.topic`, which raises where it is no UTF-8, and so ends paho's thread
            ReceivedMessage(
                message._topic.decode("utf-8", "replace"),
                bytes(message.payload),
                message.qos,
                message.mid,
                message.retain,
            )
        )

    def ack(self, mid: int, qos: int) -> MQTTErrorCode:
        """Acknowledge a message, together with others that are acknowledged before the socket is written to."""
        if qos != 1:
            return super().ack(mid, qos)
        with self._acks_lock:
            self._acks.append(ACK.pack(PUBACK, 2, mid))
            wake = self._sockpairW if len(self._acks) == 1 else None
        if wake is not None:
            with suppress(BlockingIOError):  # it has enough to wake up for
                wake.send(b"0")
        return MQTTErrorCode.MQTT_ERR_SUCCESS

    def _take_acks(self) -> bytes:
        with self._acks_lock:
            gathered, self._acks = self._acks, []
        return b"".join(gathered)

    def _packet_queue(
        self, command: int, packet: bytes | bytearray, mid: int, qos: int, info: MQTTMessageInfo | None = None
    ) -> MQTTErrorCode:
        if acks := self._take_acks():  # before anything else that ends the connection
            super()._packet_queue(PUBACK, acks, 0, 0)
        return super()._packet_queue(command, packet, mid, qos, info)

    def loop_write(self) -> MQTTErrorCode:
        """Write what waits; paho's thread calls it."""
        if acks := self._take_acks():
            super()._packet_queue(PUBACK, acks, 0, 0)
        return super().loop_write()

    def _create_socket_connection(self) -> socket.socket:
        self._piece, self._at = b"", 0  # an earlier connection has left it, and its acknowledgements
        self._take_acks()
        return super()._create_socket_connection()

    @property
    def _is_unread(self) -> bool:
        return self._at < len(self._piece)

    def _fill(self) -> bool:
        """Read the socket; return whether there is a connection. Raises BlockingIOError where nothing has come."""
        self._piece, self._at = b"", 0
        self._piece = super()._sock_recv(READ_BYTES)
        return bool(self._piece)

    def _sock_recv(self, bufsize: int) -> bytes:
        if not self._is_unread and not self._fill():
            return b""
        start, self._at = self._at, min(self._at + bufsize, len(self._piece))
        return self._piece[start : self._at]

    def loop_read(self, max_packets: int = 1) -> MQTTErrorCode:
        """Read what has come: nothing of it is left when paho waits for the socket again."""
        now = time.monotonic()  # paho's thread comes here as soon as there is something
        wait_s = self._read_at + self._gather_s - now
        if self._is_empty:
            self.empty_at = self._read_at if wait_s > 0.0 else now
        time.sleep(max(0.0, wait_s))
        received, self._gather_s, self._is_empty = 0, 0.0, False
        for _ in range(READS):
            if not self._is_unread:
                try:
                    is_connected = self._fill()
                except BlockingIOError:
                    self._gather_s, self._is_empty = self._gathering_time(received), True
                    break
                except OSError:
                    is_connected = False
                if not is_connected:
                    return self._loop_rc_handle(MQTTErrorCode.MQTT_ERR_CONN_LOST)
                received += len(self._piece)
            while self._is_unread:
                if not self._in_packet["command"]:
                    self._take_messages()
                if self._is_unread:  # the beginning of a message, or another packet
                    code = super().loop_read()
                    if code or self._sock is None:
                        return code
        self._read_at, self.thread_s = time.monotonic(), time.thread_time()
        return MQTTErrorCode.MQTT_ERR_SUCCESS

    def _gathering_time(self, received: int) -> float:
        """Return how long the socket may be left alone after so many bytes came since it was read before [s]."""
        if not isinstance(self._sock, socket.socket) or not received:
            return 0.0
        room = GATHER_SHARE * self._sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)  # the kernel lets it grow
        return min(GATHER_S, (time.monotonic() - self._read_at) * room / received)

    def _take_messages(self) -> None:
        """Take the whole messages of quality 1, without properties, that come next."""
        piece, end = self._piece, len(self._piece)
        while self._at + 2 <= end and piece[self._at] & (TYPE_BITS | QOS_BITS) == PUBLISH | QOS_1:
            retain, start, size, shift = bool(piece[self._at] & RETAIN), self._at + 1, 0, 0
            while start < end and shift < 28:  # the length: seven bits per byte, the lowest first
                byte = piece[start]
                start, size, shift = start + 1, size | (byte & 0x7F) << shift, shift + 7
                if byte < 0x80:
                    break
            else:
                return
            stop, number = start + size, start + 2 + int.from_bytes(piece[start : start + 2], "big")
            if stop > end or number + 3 > stop or piece[number + 2]:
                return  # not whole, or with properties
            self._at, mid = stop, int.from_bytes(piece[number : number + 2], "big")
            topic = piece[start + 2 : number].decode("utf-8", "replace")
            self._on_received(ReceivedMessage(topic, piece[number + 3 : stop], 1, mid, retain))
