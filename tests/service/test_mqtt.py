"""Blocks over a real broker: nothing lost or doubled through kills, refused where it is no block, told back."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import halls
import numpy as np
import pytest
from brokers import BEGAN, Running, Sender, Taker, block, publisher, started_broker, until
from halls import RESULTS, asked
from inboxes import STUB
from reliability.servers import Mosquitto, mosquitto

from servoscope.core.errors import ConfigError, SourceError
from servoscope.service.build import build_components
from servoscope.service.config import ServiceFile
from servoscope.service.mqtt import payload
from servoscope.service.mqtt.source import MqttSourceSettings
from servoscope.service.service import Service
from servoscope.service.sources.inbox import Inbox
from servoscope.signals import clean, writers

MISSING = "Mosquitto is not on this machine: scripts/install-test-servers installs it"
STREAM = round(BEGAN * 1e6)


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    server = started_broker(tmp_path)
    yield server
    server.stop()


@pytest.fixture
def sender(broker: Mosquitto) -> Iterator[Sender]:
    one = Sender(broker.port)
    yield one
    one.close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with press.csv, a minute of nothing much: 120 blocks."""
    made = tmp_path_factory.mktemp("plant")
    t = 0.01 * np.arange(6000)
    signals = np.random.default_rng(5).normal(size=(3, t.size))
    writers.write_recording(made / "press.csv", clean(t, *signals, name="press", sample_rate=100.0))
    return made


def test_what_is_published_counts_once_whoever_is_killed(folder: Path, broker: Mosquitto) -> None:
    taker, sending = Taker(broker.port), Running(publisher(folder, broker.port, speed=20.0))
    for turn in range(3):
        taker.start()
        taker.until(lambda turn=turn: taker.kept.get("press") and len(taker.kept["press"][1]) > 15 * (turn + 1))
        until(lambda: taker.turn(commit=False) or True)
        broker.stop(signal.SIGKILL)  # with it goes what it has not yet written down, sessions included
        taker.die()
        time.sleep(0.1)
        broker.start()
    with pytest.raises(SourceError, match="not known to be safe; the same start goes on"):
        sending.end(stop=True)
    sending = Running(publisher(folder, broker.port))  # another process: it goes on behind what is safe
    taker.start()
    taker.until(lambda: not sending.alive)
    sending.end()
    taker.die()
    counted, order = taker.kept["press"]
    assert order == [(STREAM, k) for k in range(120)] and counted.lost == 0


def test_a_stream_that_began_before_another_is_refused(folder: Path, broker: Mosquitto, sender: Sender) -> None:
    taker = Taker(broker.port)
    taker.start()
    sender.send(payload.encode_binary(block(0, stream=STREAM + 1), oldest=0))
    taker.until(lambda: taker.kept)
    taker.die()
    with pytest.raises(SourceError, match=r"press: the service has a stream that began at 2026-.*: give a later start"):
        publisher(folder, broker.port).run()


def test_what_others_lose_or_send_twice_is_counted(broker: Mosquitto, sender: Sender) -> None:
    taker = Taker(broker.port)
    taker.start()
    restarted = block(1)
    restarted.t[:] += 100.0  # numbers fall back, time goes on
    sender.send(block(7), block(8), block(8), block(11), block(9), restarted)
    taker.until(lambda: taker.kept and taker.kept["press"][0].sequence == 1)
    counted, order = taker.kept["press"]
    assert [sequence for _, sequence in order] == [7, 8, 11, 1]  # taken up at 7, 9 came too late
    assert (counted.lost, counted.repeated) == (2, 2)
    taker.die()


def test_a_block_that_its_sender_keeps_waits_for_those_before_it(broker: Mosquitto, sender: Sender) -> None:
    taker = Taker(broker.port)
    source = taker.start()
    blocks = [block(k, stream=5) for k in range(6)]
    for k, oldest in ((0, 0), (2, 0), (1, 0), (2, 0), (5, 4), (4, 4)):  # 3 is gone for good, its sender says
        sender.send(payload.encode_binary(blocks[k], oldest))
    taker.until(lambda: taker.kept and taker.kept["press"][0].sequence == 4)
    counted, order = taker.kept["press"]
    assert [sequence for _, sequence in order] == [0, 1, 2, 4] and (counted.lost, counted.repeated) == (1, 0)
    assert [(one.kind, one.count) for one in source.rejections.take()] == [("ahead", 2)]
    sender.client.subscribe("servoscope/v1/ack/press")
    until(lambda: sender.heard == {"servoscope/v1/ack/press": {"stream": 5, "sequence": 4}})
    taker.die()


def test_the_broker_is_answered_only_when_results_are_stored(broker: Mosquitto, sender: Sender) -> None:
    taker = Taker(broker.port)
    taker.start()
    sender.send(*(block(k) for k in range(5)))
    until(lambda: taker.turn(commit=False) or len(taker._now.get("press", (0, []))[1]) == 5)
    taker.die()
    sender.send(block(5))  # while nobody is there
    taker.start()
    taker.until(lambda: taker.kept and len(taker.kept["press"][1]) == 6)
    time.sleep(0.2)
    taker.die()
    taker.start()  # and now all of them are: nothing comes again
    time.sleep(0.3)
    assert not taker.source.poll(10)
    taker.die()


def test_what_is_no_block_is_refused_and_named(broker: Mosquitto, sender: Sender) -> None:
    taker = Taker(broker.port)
    source = taker.start()
    binary = payload.encode_binary(block(1))
    sender.send(b"", b"\0" * 100, b"[" * 10_000, binary[:-1], binary + b"0", binary[:-1] + bytes([binary[-1] ^ 1]))
    sender.send(b"SVSB\x02" + binary[5:], b'{"version": 1}', bytes(2**20 + 1))
    sender.send(block(1), asset="nobody")
    sender.send(block(1))
    taker.until(lambda: taker.kept)
    expected = {"not a block": 3, "truncated": 1, "oversized": 2, "checksum": 1, "version": 1, "wrong type": 1}
    found = {(one.asset, one.kind): one.count for one in source.rejections.take()}
    assert found == {("press", kind): count for kind, count in expected.items()}  # nobody's block does not come here
    taker.die()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # paho 2 leaves refused sockets open
def test_tls_and_password(tmp_path: Path) -> None:
    program = mosquitto()
    if program is None:
        pytest.skip(MISSING)
    curve = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "2"]
    names = ["-subj", "/CN=127.0.0.1", "-addext", "subjectAltName=IP:127.0.0.1", "-keyout", "key.pem", "-out", "ca.pem"]
    subprocess.run(["openssl", "req", "-x509", *curve, *names], check=True, capture_output=True, cwd=tmp_path)
    subprocess.run(["mosquitto_passwd", "-b", "-c", "users", "hall", "secret"], check=True, cwd=tmp_path)
    files = (f"certfile {tmp_path}/ca.pem", f"keyfile {tmp_path}/key.pem", f"password_file {tmp_path}/users")
    server = Mosquitto(tmp_path, program, *files, "allow_anonymous false")
    (tmp_path / "password").write_text("secret\n")
    server.start()

    def source(**keys: object) -> Inbox:
        given = {"tls": True, "ca_file": "ca.pem", "user": "hall", "password_file": "password", **keys}
        settings = MqttSourceSettings.model_validate(
            {"kind": "mqtt", "host": "127.0.0.1", "port": server.port, **given}
        )
        return settings.create("hall", {"press": STUB}, tmp_path)

    try:
        for keys, trouble in (({}, ""), ({"user": "guest"}, "Not authorized"), ({"ca_file": None}, "self-signed")):
            one = source(**keys)
            one.open({})
            until(lambda one=one, trouble=trouble: trouble in one.trouble if trouble else one.connected)
            one.close()
        with pytest.raises(ConfigError, match=r"nowhere: the password cannot be read \(No such file"):
            source(password_file="nowhere")
        with pytest.raises(ConfigError, match="its certificates cannot be used"):
            source(ca_file="users")
        with pytest.raises(ConfigError, match="certificates are given, but not tls = true"):
            source(tls=False)
    finally:
        server.stop()


def test_through_the_whole_service_and_back(tmp_path: Path, broker: Mosquitto, sender: Sender) -> None:
    """Results are those of a replay of the same file, and are told to the broker."""
    sender.client.subscribe([("servoscope/v1/status/+", 1), ("plant/alarms", 1)])
    halls.baseline().save(tmp_path / "baseline.json")
    writers.write_recording(tmp_path / "press.csv", halls.recorded(2, halls.LEAK))
    address = f'host = "127.0.0.1"\nport = {broker.port}'
    common = (
        'name = "hall"\n[service]\nlisten = ""\nlog = "error"\n[store]\nurl = "{name}.sqlite"\nresidual_every_s = 2.0\n'
        '[diagnosis]\nwindow_s = 40.0\nevery_s = 60.0\n[assets.press]\nbaseline = "baseline.json"\nsource = "line"\n'
    )
    replayed, subscribed = tmp_path / "replayed.toml", tmp_path / "subscribed.toml"
    replay = '[sources.line]\nkind = "replay"\nspeed = 0.0\nblock = 0.5\nstart = 2026-01-01T00:00:00Z\n'
    replayed.write_text(common.format(name="replayed") + 'files = ["press.csv"]\n' + replay)
    subscribed.write_text(
        common.format(name="subscribed") + f'[sources.line]\nkind = "mqtt"\n{address}\n'
        f'[outlets.plant]\nkind = "mqtt"\n{address}\n'
        f'[actions.mqtt.scada]\nalarms = ["fault"]\ntopic = "plant/alarms"\n[actions.mqtt.scada.broker]\n{address}\n'
    )
    service = Running(Service(ServiceFile.load(subscribed), build_components(ServiceFile.load(subscribed))))
    Running(publisher(tmp_path, broker.port)).end()
    sender.send(b"no block")
    status = until(lambda: (one := sender.heard.get("servoscope/v1/status/press")) and one["faults"] and one)
    assert (status["asset"], status["faults"][0]["name"]) == ("press", "leakage")  # silent, by then
    assert status["summary"].startswith("Fault") and status["ne107"]
    assert status["faults"][0]["ratio"] == pytest.approx(1.2, abs=0.05)
    alarm = until(lambda: sender.heard.get("plant/alarms"))
    assert (alarm["asset"], alarm["alarm"], alarm["after"]) == ("press", "fault", "unacknowledged") and alarm["key"]
    refused = 'servoscope_refused_total{asset="press",kind="not a block",source="line"} 1.0'
    until(lambda: refused in service.one.metrics.render().decode())
    assert 'servoscope_source_up{source="line"} 1.0' in service.one.metrics.render().decode()
    service.end(stop=True)
    (refused,) = asked(subscribed, "SELECT document FROM audit WHERE what = 'refused'")
    assert json.loads(refused[0])["kind"] == "not a block"
    Service(ServiceFile.load(replayed), build_components(ServiceFile.load(replayed))).run()
    for table, query in RESULTS.items():
        if table != "states":  # where the stream's name stands
            found = asked(subscribed, query)
            assert found[: len(asked(replayed, query))] == asked(replayed, query), table
