"""Messages that are read in bulk: the same as one by one, wherever the network cuts them, and as many acknowledged."""

from __future__ import annotations

import random
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from brokers import until
from inboxes import STUB

from servoscope.service.mqtt.client import BrokerSettings, create_mqtt_client
from servoscope.service.mqtt.paho_clients import GATHER_S, ReceivedMessage
from servoscope.service.mqtt.payload import encode_binary
from servoscope.service.mqtt.source import MqttSourceSettings
from servoscope.service.sources.block import Block

CONNACK = bytes([0x20, 3, 0, 0, 0])


def length(n: int) -> bytes:
    """Return a length as MQTT writes it (MQTT 5.0, OASIS 2019, 1.5.5)."""
    return bytes([n]) if n < 128 else bytes([n % 128 | 128]) + length(n // 128)


def publish(one: ReceivedMessage, properties: bytes = b"") -> bytes:
    """Return the packet of a message (3.3)."""
    topic = one.topic.encode()
    number = one.mid.to_bytes(2, "big") if one.qos else b""
    body = len(topic).to_bytes(2, "big") + topic + number + length(len(properties)) + properties + one.payload
    return bytes([0x30 | one.qos << 1 | one.retain]) + length(len(body)) + body


def acknowledged(received: bytes) -> list[int]:
    """Return which messages the client's packets acknowledge, in their order; they are all short."""
    found = []
    while received:
        if received[0] == 0x40:
            found.append(int.from_bytes(received[2:4], "big"))
        received = received[2 + received[1] :]
    return found


def serve(
    server: socket.socket, pieces: list[bytes], received: bytearray, ends: Callable[[], bool] | None = None
) -> None:
    """Be a broker that sends these pieces, and keeps what follows the client's first packet; or goes when it `ends`."""
    connection = server.accept()[0]
    with connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.recv(4096)
        connection.sendall(CONNACK)
        for piece in pieces:
            connection.sendall(piece)
            if len(piece) < 20:
                time.sleep(0.001)  # the next one comes by itself
        if ends is not None:
            until(ends, 60.0)
            return
        while data := connection.recv(4096):
            received += data


@pytest.mark.parametrize("qos", [0, 1])
@pytest.mark.parametrize("topic", [b"", b"\xff\xfe"])
def test_topics_that_are_none_do_not_make_a_source_deaf(topic: bytes, qos: int) -> None:
    """An exception in its thread would end the client, and nobody would hear of it."""
    block = Block("press", 0, np.array([1e9]), *np.ones((3, 1)))
    number = bytes([0, 1]) if qos else b""
    body = len(topic).to_bytes(2, "big") + topic + number + b"\x03\x23\0\x01"  # an alias, which we have not allowed
    strange = bytes([0x30 | qos << 1]) + length(len(body)) + body
    good = publish(ReceivedMessage("servoscope/v1/data/press", encode_binary(block), 1, 2, False))
    with socket.create_server(("127.0.0.1", 0)) as server:
        broker = threading.Thread(target=serve, args=(server, [strange, good], bytearray()), daemon=True)
        broker.start()
        settings = MqttSourceSettings(kind="mqtt", host="127.0.0.1", port=server.getsockname()[1])
        source = settings.create("reader", {"press": STUB}, Path())
        source.open({})
        (found,) = until(lambda: source.poll(10), 20.0)
        source.close()
        broker.join(60.0)
    assert found.y.tolist() == [1.0]
    assert [one.kind for one in source.rejections.take()] == ["unknown asset"]


def test_messages_in_pieces_of_any_size_are_those_that_were_sent() -> None:
    chance, sent, packets = random.Random(1), list[ReceivedMessage](), []
    for mid in range(1, 400):
        payload = chance.randbytes(chance.choice([0, 1, 100, 127, 128, 9000, 300_000 if mid % 100 == 0 else 50]))
        one = ReceivedMessage(f"hall/é{mid % 7}", payload, chance.choice([1, 1, 1, 0]), mid, chance.random() < 0.2)
        sent.append(one if one.qos else one._replace(mid=0))
        # a content type, which is a property; or the answer to a ping between two messages
        packets.append(publish(one, b"\x03\0\x04text" if mid % 11 == 0 else b""))
        packets += [b"\xd0\0"] if mid % 13 == 0 else []
    stream, pieces = b"".join(packets), list[bytes]()
    while stream:
        n = chance.choice([1, 3, 1000, 20_000, 500_000])
        pieces.append(stream[:n])
        stream = stream[n:]
    came, received = list[ReceivedMessage](), bytearray()
    with socket.create_server(("127.0.0.1", 0)) as server:
        broker = threading.Thread(target=serve, args=(server, pieces, received))
        broker.start()
        settings = BrokerSettings(host="127.0.0.1", port=server.getsockname()[1])
        client = create_mqtt_client(settings, Path(), "reader", came.append)
        client.connect_async(*settings.address)
        client.loop_start()
        deadline = time.monotonic() + 60.0
        while len(came) < len(sent) and time.monotonic() < deadline:
            time.sleep(0.01)
        for one in came:
            client.ack(one.mid, one.qos)
        client.disconnect()  # not before they are acknowledged
        client.loop_stop()
        broker.join(60.0)
    assert came == sent
    assert acknowledged(bytes(received)) == [one.mid for one in sent if one.qos]


def test_what_is_sent_again_takes_the_place_of_its_earlier_copy() -> None:
    """A service that cannot store for a while holds no message twice, however often the connection is lost."""
    payloads = [encode_binary(Block("press", k, np.array([1e9 + k]), *np.ones((3, 1)))) for k in range(3)]
    topic, received = "servoscope/v1/data/press", bytearray()
    connections = [((1, 0), (2, 1)), ((11, 0), (12, 1), (13, 2))]  # in each: numbers of messages, and which they are

    def send(server: socket.socket) -> None:
        for sent, ends in zip(connections, (lambda: len(source.transport.waiting) == 2, None), strict=True):
            packets = [publish(ReceivedMessage(topic, payloads[k], 1, mid, False)) for mid, k in sent]
            serve(server, packets, received, ends)

    with socket.create_server(("127.0.0.1", 0)) as server:
        settings = MqttSourceSettings(kind="mqtt", host="127.0.0.1", port=server.getsockname()[1])
        source = settings.create("reader", {"press": STUB}, Path())
        broker = threading.Thread(target=send, args=(server,))
        broker.start()
        source.open({})
        until(lambda: len(source.transport.waiting) == 3, 60.0)
        assert [one.sequence for one in source.poll(10)] == [0, 1, 2]
        source.acknowledge("press", 3)
        source.close()
        broker.join(60.0)
    assert acknowledged(bytes(received)) == [11, 12, 13]


def test_what_is_too_large_does_not_wait_in_memory() -> None:
    """It would until its turn: while the store is away as many as may be in flight, each four times the largest."""
    settings = MqttSourceSettings(kind="mqtt", host="127.0.0.1", largest=1024)
    source = settings.create("reader", {"press": STUB}, Path())
    for qos in (0, 1):
        source.transport._on_message(ReceivedMessage("servoscope/v1/data/press", bytes(1025), qos, 1, False))
    assert not source.transport.waiting
    assert [(one.asset, one.kind, one.count) for one in source.rejections.take()] == [("press", "oversized", 2)]


def test_the_socket_is_left_alone_until_a_share_of_its_buffer_is_full() -> None:
    """Otherwise a broker that sends faster than that in a pause would wait for us."""
    client = create_mqtt_client(BrokerSettings(host="127.0.0.1"), Path(), "reader", lambda one: None)
    with socket.socket() as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**17)
        room = one.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) / 4
        client._sock, client._read_at = one, time.monotonic() - 1e6  # so long that the moments of the test are nothing
        assert client._gathering_time(0) == 0.0
        assert client._gathering_time(1000) == GATHER_S
        for speed in (1e6, 1e8):  # bytes per second
            assert speed * client._gathering_time(round(speed * 1e6)) == pytest.approx(
                min(speed * GATHER_S, room), 1e-3
            )
