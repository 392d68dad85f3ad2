"""Samples from a real OPC UA server, killed and cut off; single values on one clock; verdicts offered as a server."""

from __future__ import annotations

import asyncio
import math
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from brokers import BEGAN, until
from hypothesis import given, settings
from hypothesis import strategies as st
from opcua_plant import NODES
from reliability.servers import Cable

from servoscope.core.errors import ConfigError, MessageError
from servoscope.service.opcua import server as opcua_server
from servoscope.service.opcua.server import OpcuaServer, OpcuaServerSettings
from servoscope.service.opcua.settings import OpcuaNodes
from servoscope.service.opcua.source import OpcuaSourceSettings
from servoscope.service.opcua.subscriptions import _AnswerRecorder, parse_block, parse_value, read_history
from servoscope.service.sources.block import Block, ResumePosition
from servoscope.service.sources.inbox import Inbox
from servoscope.service.sources.message import SourceAsset
from servoscope.service.sources.resample import Resampler

RATE = 20.0
# asyncua leaves sockets of connections that were cut to the garbage collector
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


def source_assets(nodes: OpcuaNodes, rate: float, covariates: tuple[str, ...] = ()) -> dict[str, SourceAsset]:
    """One asset as a source is told of it."""
    return {"press": SourceAsset(SimpleNamespace(sample_rate=rate), nodes, covariates=covariates)}  # type: ignore[arg-type]


@given(st.data())
@settings(max_examples=60)
def test_values_that_change_now_and_then_are_held_on_one_clock(data: st.DataObject) -> None:
    """Oracle: all values of every sample; only changes are told, in any order, looked at after any of them."""
    n = data.draw(st.integers(5, 60))
    truth = np.array(data.draw(st.lists(st.integers(0, 2), min_size=3 * n, max_size=3 * n)), dtype=float).reshape(3, n)
    jitter = np.array(data.draw(st.lists(st.floats(-0.2, 0.2), min_size=n, max_size=n)))
    t = BEGAN + 0.01 * (np.arange(n) + jitter)
    told = np.diff(truth, axis=1, prepend=math.nan) != 0.0
    told[2] = True  # one signal has a value at every sample: the clock
    aligner, found = Resampler(3, 0.01), []
    aligner.restart(0.0)
    for k in range(n):
        for signal in data.draw(st.permutations(range(3))):
            if told[signal, k]:
                aligner.add(signal, t[k], truth[signal, k])
        if data.draw(st.booleans()):
            found.append(aligner.take_samples(-math.inf))
    found.append(aligner.take_samples(t[-1] + 0.009))
    assert np.array_equal(np.concatenate([one.t for one in found]), t)
    assert np.array_equal(np.concatenate([one.values for one in found], axis=1), truth)
    assert not aligner.take_late() and not any(one.gaps for one in found)


def test_a_constant_signal_goes_on_while_the_server_lives_and_a_gap_is_a_gap() -> None:
    aligner = Resampler(2, 0.1)
    aligner.restart(BEGAN)
    aligner.add(0, BEGAN - 50.0, 1.0)  # what holds since long
    aligner.add(1, BEGAN + 1.0, 2.0)
    first = aligner.take_samples(BEGAN + 2.0)
    assert np.allclose(first.t, BEGAN + 1.0 + 0.1 * np.arange(10)) and (first.values == [[1.0], [2.0]]).all()
    aligner.add(1, BEGAN + 1.5, 9.0)
    assert not aligner.take_samples(BEGAN + 1.9).t.size and aligner.take_late() == 1
    aligner.add(1, BEGAN + 1.95, 7.0)  # heard last, and part of no sample yet: nobody knows how long it held
    aligner.restart(BEGAN + 5.0)
    aligner.add(0, BEGAN + 4.0, 3.0)
    aligner.add(1, BEGAN + 4.2, 4.0)  # before the subscription: they tell what holds
    second = aligner.take_samples(BEGAN + 5.3)
    assert second.t[0] == BEGAN + 5.0 and (second.values[:, 0] == [3.0, 4.0]).all()
    assert [(gap.start, gap.end, gap.samples) for gap in second.gaps] == [(pytest.approx(BEGAN + 1.9), BEGAN + 5.0, 30)]
    aligner.add(1, 250e9, 5.0)  # a clock that was set to the year 9892 costs no memory
    assert aligner.take_samples(251e9).t.size <= 20
    for k in range(4):
        aligner.add(1, BEGAN + 6.0 + 0.1 * k, float(k))  # and when it is set back, samples go on
    assert aligner.take_samples(BEGAN).values[1].tolist() == [0.0, 1.0, 2.0]


VALUES = st.one_of(
    st.none(), st.booleans(), st.integers(-(10**400), 10**400), st.floats(), st.text(max_size=3),
    st.lists(st.one_of(st.floats(), st.integers(-(10**400), 10**400), st.text(max_size=1)), max_size=9),
    st.lists(st.floats(0.0, 2e11), min_size=5, max_size=9),
)  # fmt: skip
STAMPS = (
    st.none() | st.datetimes(datetime(1601, 1, 1), datetime(9999, 12, 31)) | st.just(datetime(2026, 1, 1, tzinfo=UTC))
)


@given(VALUES, STAMPS, st.booleans())
@settings(max_examples=300)
def test_whatever_a_node_holds(value: object, stamp: datetime | None, bad: bool) -> None:
    status = SimpleNamespace(is_bad=lambda: bad, name="Bad")
    given_ = SimpleNamespace(
        Value=SimpleNamespace(Value=value), SourceTimestamp=stamp, ServerTimestamp=None, StatusCode=status
    )
    for decode in (parse_value, lambda one: parse_block("press", one)):
        try:
            found = decode(given_)
        except MessageError as error:
            assert error.kind and "\n" not in str(error)
            continue
        if isinstance(found, Block):
            assert found.t.size == found.r.size == found.y.size > 0 and found.sequence >= 0
        else:
            assert found[0] >= 0.0


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


class Plant:
    """The server of `opcua_plant`, behind a cable that can be pulled."""

    def __init__(self, mode: str) -> None:
        self._behind, self.began, self._mode = free_port(), time.time() - 60.0, mode
        self._cable = Cable(self._behind)
        self.port, self.pulled = self._cable.port, self._cable.pulled
        self.start()

    def start(self) -> None:
        words = [sys.executable, str(Path(__file__).parents[1] / "support" / "opcua_plant.py")]
        words += [str(self._behind), str(self.began), str(RATE), self._mode]
        self._process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        assert self._process.stdout is not None and self._process.stdout.readline() == "ready\n"
        self._process.stdout.close()

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()

    def close(self) -> None:
        self.kill()
        self._cable.close()


@pytest.fixture
def plant(request: pytest.FixtureRequest) -> Iterator[Plant]:
    one = Plant(request.param)
    yield one
    one.close()


class Following:
    """A source and what came of it."""

    def __init__(self, plant: Plant, nodes: OpcuaNodes, resume: dict[str, ResumePosition] | None = None) -> None:
        given_ = {"kind": "opcua", "url": f"opc.tcp://127.0.0.1:{plant.port}/plant", "block": 0.25, "heartbeat_s": 3.0}
        self.source = OpcuaSourceSettings.model_validate(given_).create("hall.line", source_assets(nodes, RATE), Path())
        self.source.open(resume or {})
        self.began, self.blocks = plant.began, list[Block]()
        self.refused: dict[str, int] = {}

    def look(self) -> int:
        self.blocks += self.source.poll(1000)
        for one in self.source.rejections.take():
            self.refused[one.kind] = self.refused.get(one.kind, 0) + one.count
        return len(self.blocks)

    def more(self, blocks: int) -> None:
        enough = self.look() + blocks
        until(lambda: self.look() >= enough)

    def samples(self) -> np.ndarray[Any, Any]:
        """Return the numbers of the samples, having checked that each says what its moment held."""
        t, r, u, y = np.concatenate([block.signals for block in self.blocks], axis=1)
        k = np.rint((t - self.began) * RATE).astype(int)
        assert np.abs(t - self.began - k / RATE).max() < 0.2 / RATE
        assert (r == 5.0).all() and (u == k // 3).all() and (y == k).all()
        return k


SCALARS = OpcuaNodes(r=NODES["r"], u=NODES["u"], y=NODES["y"])


@pytest.mark.parametrize("plant", ["history"], indirect=True)
def test_a_cable_that_was_pulled_costs_nothing_where_there_is_history(plant: Plant) -> None:
    one = Following(plant, SCALARS)
    one.more(4)
    plant.pulled.set()
    time.sleep(5.0)  # longer than the heartbeat is waited for
    plant.pulled.clear()
    one.more(30)
    one.source.close()
    k = one.samples()
    assert (np.diff(k) == 1).all() and not one.refused
    assert [block.sequence for block in one.blocks] == list(range(len(one.blocks)))
    # another process goes on behind what was stored, also where u holds what it was before: it changes at every third
    for held in range(3):
        last, ends = next(
            (block, end) for block, end in zip(one.blocks[::-1], k[::-5], strict=True) if (end + 1) % 3 == held
        )
        again = Following(plant, SCALARS, {"press": ResumePosition(last.sequence, 0.0, 0, float(last.t[-1]))})
        again.more(3)
        again.source.close()
        assert again.samples()[0] == ends + 1 and again.blocks[0].sequence == last.sequence + 1
        assert not again.refused


@pytest.mark.parametrize("plant", ["nothing"], indirect=True)
def test_a_server_that_was_killed_leaves_a_gap_that_is_counted(plant: Plant) -> None:
    one = Following(plant, SCALARS)
    one.more(4)
    plant.kill()
    time.sleep(1.0)
    plant.start()
    one.more(8)
    one.source.close()
    k = one.samples()
    steps = np.diff(k)
    assert (steps[steps != 1] > 1).all() and (steps != 1).sum() == 1
    assert one.refused["gap"] == steps.max() - 1


@pytest.mark.parametrize("plant", ["history"], indirect=True)
def test_arrays_come_as_they_are_written(plant: Plant) -> None:
    one = Following(plant, OpcuaNodes(block=NODES["block"]))
    one.more(3)
    plant.pulled.set()
    time.sleep(5.0)
    plant.pulled.clear()
    one.more(8)
    one.source.close()
    assert (np.diff(one.samples()) == 1).all()
    assert (np.diff([block.sequence for block in one.blocks]) == 1).all()


def test_a_server_in_trouble_is_asked_again_and_one_without_history_is_not() -> None:
    from asyncua.ua import uaerrors

    def answer(error: Exception) -> list[Any] | None:
        async def read(*_: object, **__: object) -> list[Any]:
            raise error

        client = SimpleNamespace(get_node=lambda _: SimpleNamespace(read_raw_history=read))
        return asyncio.run(read_history(client, "i=1", 0.0, 1.0))

    assert answer(uaerrors.BadHistoryOperationUnsupported()) is None
    with pytest.raises(uaerrors.BadTimeout):
        answer(uaerrors.BadTimeout())


def test_settings_that_cannot_work_are_told() -> None:
    for wrong, why in (
        ({"r": "i=1"}, "give block, or r, u and y"),
        ({"r": "i=1", "u": "i=2", "y": "i=3", "block": "i=4"}, "give block, or r, u and y"),
    ):
        with pytest.raises(ValueError, match=why):
            OpcuaNodes.model_validate(wrong)
    with pytest.raises(ValueError, match="belong together"):
        OpcuaSourceSettings.model_validate({"kind": "opcua", "url": "opc.tcp://plc", "cert_file": "a.der"})


def certificate(folder: Path, name: str, uri: str) -> dict[str, str]:
    names = ["-subj", f"/CN={name}", "-addext", f"subjectAltName=URI:{uri},IP:127.0.0.1"]
    usage = ["-addext", "keyUsage=digitalSignature,nonRepudiation,keyEncipherment,dataEncipherment,keyCertSign"]
    made = ["-newkey", "rsa:2048", "-nodes", "-days", "2", "-keyout", f"{name}.key.pem", "-out", f"{name}.pem"]
    subprocess.run(["openssl", "req", "-x509", *made, *names, *usage], check=True, capture_output=True, cwd=folder)
    return {"cert_file": f"{name}.pem", "key_file": f"{name}.key.pem"}


STATUS = {
    "verdict": "fault", "summary": "Leakage.", "since": BEGAN, "statistic": 3.5, "level": 2.0, "ne107": "failure",
    "faults": [{"name": "leakage", "parameter": "C_ie", "ratio": 1.2}], "counted": {"t": BEGAN + 60.0},
}  # fmt: skip


def test_verdicts_are_offered_signed_and_encrypted(tmp_path: Path) -> None:
    server = certificate(tmp_path, "server", "urn:servoscope")
    client = certificate(tmp_path, "client", "urn:servoscope:client")
    port = free_port()
    outlet = OpcuaServer(OpcuaServerSettings(kind="opcua", listen=f"127.0.0.1:{port}", **server), tmp_path)
    outlet.open({"press": {**STATUS, "verdict": "healthy"}, "hall": {"service": True}})
    outlet.publish({"press": STATUS})
    url = f"opc.tcp://127.0.0.1:{port}/servoscope"
    nodes = OpcuaNodes(r="ns=2;s=press.T2", u="ns=2;s=press.Level", y="ns=2;s=press.Ratio")

    def source(**keys: str) -> Inbox:
        made = OpcuaSourceSettings.model_validate({"kind": "opcua", "url": url, **keys})
        return made.create("hall.line", source_assets(nodes, 1.0), tmp_path)

    async def read() -> dict[str, Any]:
        from servoscope.service.opcua.source import create_opcua_client

        async with await create_opcua_client(source(**client).transport.settings, None, tmp_path) as one:
            names = ("Verdict", "Fault", "Ratio", "T2", "NE107", "Since")
            return {name: await one.get_node(f"ns=2;s=press.{name}").read_value() for name in names}

    try:
        found = asyncio.run(read())
        assert found.pop("Since").replace(tzinfo=UTC).timestamp() == BEGAN
        assert found == {"Verdict": "fault", "Fault": "leakage", "Ratio": 1.2, "T2": 3.5, "NE107": "failure"}
        secure, open_ = source(**client), source()
        for one in (secure, open_):
            one.open({})
        until(lambda: secure.connected and open_.trouble)  # who does not encrypt is not let in
        assert not open_.connected
        for one in (secure, open_):
            one.close()
        with pytest.raises(ConfigError, match=r"nowhere: no such file"):
            source(cert_file="nowhere", key_file="nowhere")
    finally:
        outlet.close()


def test_values_that_come_while_nodes_are_subscribed_reach_the_session() -> None:
    """The library reports them to what it takes for the session: it once wrote a traceback into the log."""
    session = SimpleNamespace(observer=object())
    assert _AnswerRecorder(session).observer is session.observer


def test_silent_clients_use_up_no_files_of_the_service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opcua_server, "HANDSHAKE_S", 3.0)
    outlet = OpcuaServer(OpcuaServerSettings(kind="opcua", listen=f"127.0.0.1:{free_port()}"), tmp_path)
    outlet.open({"press": STATUS})
    host, port = outlet.settings.listen.split(":")
    silent = list[socket.socket]()

    def files() -> int:
        return len(list(Path("/proc/self/fd").iterdir())) - len(silent)

    before = files()
    for _ in range(2 * opcua_server.MAX_CONNECTIONS):
        silent.append(socket.create_connection((host, int(port)), timeout=5.0))
    until(lambda: files() <= before + opcua_server.MAX_CONNECTIONS, 15.0)
    until(lambda: files() <= before, 30.0)  # and those that say nothing are closed, too

    async def read() -> Any:
        from asyncua import Client

        async with Client(f"opc.tcp://{outlet.settings.listen}/servoscope", timeout=30.0) as client:
            return await client.get_node("ns=2;s=press.Verdict").read_value()

    assert asyncio.run(read()) == STATUS["verdict"]
    outlet.close()
    for one in silent:
        one.close()
