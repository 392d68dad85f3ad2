"""What all sources and publishers guarantee, checked for every built-in kind; and the recipes for new ones."""

from __future__ import annotations

import ast
import importlib
import json
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import halls
import numpy as np
import pytest
from brokers import Sender, kafka_brokers, kafka_cluster, started_broker, until
from brokers import block as mqtt_block
from commands import one_line, run
from test_opcua import NODES, RATE, Plant, free_port
from test_publishers import status

from servoscope.models.loop import Loop
from servoscope.service.kinds import PUBLISHERS, SOURCES, find_kinds
from servoscope.service.opcua.settings import OpcuaNodes
from servoscope.service.sources.block import Block, ResumePosition
from servoscope.service.sources.inbox import Inbox
from servoscope.service.sources.message import CHECKS, Content, InboxMessage, SourceAsset
from servoscope.signals import clean, writers

# asyncua leaves sockets of connections that were cut to the garbage collector
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
BLOCKS = 8
AT_ONCE_S = 1.0  # for twenty calls on a busy machine


class Harness:
    """Makes sources of one kind, of which each has `BLOCKS` blocks of the asset press at least, now or soon."""

    def __init__(self, kind: str, settings: dict[str, Any], asset: SourceAsset, folder: Path) -> None:
        self.settings = find_kinds(SOURCES)[kind].load().model_validate({"kind": kind, **settings})
        self.asset, self.folder = asset, folder

    def create(self) -> Inbox:
        source = self.settings.create("hall.contract", {"press": self.asset}, self.folder)
        assert isinstance(source, Inbox)
        return source

    def open(self, last: Block | None = None) -> Inbox:
        """Return an open source that continues behind a block."""
        source = self.create()
        start = ResumePosition(last.sequence, self.start, last.stream, float(last.t[-1])) if last is not None else None
        source.open({} if start is None else {"press": start})
        return source

    start = 0.0


def collect(source: Inbox, blocks: int, limit: int = 100) -> list[Block]:
    """Poll until there are so many blocks; return these."""
    found: list[Block] = []

    def enough() -> bool:
        polled = source.poll(min(limit, blocks - len(found)))
        assert len(polled) <= limit
        found.extend(polled)
        return len(found) >= blocks

    until(enough, 60.0)
    return found


@pytest.fixture
def replay(tmp_path: Path) -> Iterator[Harness]:
    signals = np.random.default_rng(5).normal(size=(3, 1000))
    writers.write_recording(
        tmp_path / "press.csv", clean(0.01 * np.arange(1000), *signals, name="press", sample_rate=100.0)
    )
    asset = SourceAsset(Loop.load(halls.LOOP), ("press.csv",))
    yield Harness("replay", {"speed": 0.0, "block": 0.5, "start": "2026-01-01T00:00:00Z"}, asset, tmp_path)


@pytest.fixture
def mqtt(tmp_path: Path) -> Iterator[Harness]:
    server = started_broker(tmp_path)
    harness = Harness("mqtt", {"host": "127.0.0.1", "port": server.port}, SourceAsset(LOOP_STUB, None), tmp_path)  # type: ignore[arg-type]
    first = harness.open()  # the broker keeps what is sent from now on
    until(lambda: first.connected)
    time.sleep(0.2)
    first.close()
    sender = Sender(server.port)
    sender.send(*(mqtt_block(k) for k in range(BLOCKS)))
    sender.close()
    yield harness
    server.stop()


TIMES = 1767225600.0 + 0.01 * np.arange(50 * (BLOCKS + 1))
PAYLOAD = {"topics": ["line/{asset}"], "time": {"t": "s"}, "block": 0.5}
SPOOLED = {**PAYLOAD, "topics": ["{asset}/{file}"]}
LOOP_STUB = SimpleNamespace(columns=SimpleNamespace(covariates={}))  # of a source that reads no more of it
AXIS = SourceAsset(SimpleNamespace(sample_rate=100.0), None)  # type: ignore[arg-type]


def rows() -> list[bytes]:
    """Return messages of one sample each."""
    return [json.dumps({"t": t, "r": k, "u": k + 1, "y": k + 2}).encode() for k, t in enumerate(TIMES.tolist())]


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Harness]:
    """A source of kind mqtt that reads a plant's own messages."""
    server = started_broker(tmp_path)
    harness = Harness("mqtt", {"host": "127.0.0.1", "port": server.port, "payload": PAYLOAD}, AXIS, tmp_path)
    first = harness.open()
    until(lambda: first.connected)
    time.sleep(0.2)
    first.close()
    sender = Sender(server.port)
    for one in rows():
        last = sender.client.publish("line/press", one, qos=1)
    last.wait_for_publish(30.0)
    sender.close()
    yield harness
    server.stop()


@pytest.fixture
def kafka(tmp_path: Path) -> Iterator[Harness]:
    """A source of kind kafka, beside the cluster that the client library simulates."""
    producer = kafka_cluster()
    for one in rows():
        producer.produce("line", key=b"press", value=one)
    producer.flush(30.0)
    yield Harness(
        "kafka", {"brokers": kafka_brokers(producer), "start": "beginning", "payload": PAYLOAD}, AXIS, tmp_path
    )
    producer.flush(1.0)


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Harness]:
    """A source of kind folder, in which two files with what the plant's messages hold lie."""
    lines = [f"{t!r},{k},{k + 1},{k + 2}\n" for k, t in enumerate(TIMES.tolist())]
    for name, part in (("b.csv", lines[:250]), ("a.csv", lines[240:])):
        (tmp_path / "share").mkdir(exist_ok=True)
        (tmp_path / "share" / name).write_text("t,r,u,y\n" + "".join(part))
    loop = Loop.load(halls.LOOP)
    assert loop.sample_rate == 100.0
    settings = {"path": "share", "complete_after_s": 0.02, "poll_s": 0.02, "block": 0.5}
    yield Harness("folder", settings, SourceAsset(loop, None), tmp_path)


@pytest.fixture
def opcua(tmp_path: Path) -> Iterator[Harness]:
    plant = Plant("history")
    nodes = OpcuaNodes(r=NODES["r"], u=NODES["u"], y=NODES["y"])
    settings = {"url": f"opc.tcp://127.0.0.1:{plant.port}/plant", "block": 0.25, "heartbeat_s": 3.0}
    yield Harness("opcua", settings, SourceAsset(SimpleNamespace(sample_rate=RATE), nodes), tmp_path)  # type: ignore[arg-type]
    plant.close()


def check_numbering(harness: Harness) -> None:
    source = harness.open()
    assert [block.sequence for block in collect(source, BLOCKS)] == list(range(BLOCKS))
    source.close()


def check_limit(harness: Harness) -> None:
    source = harness.open()
    assert source.poll(0) == []
    assert [block.sequence for block in collect(source, 4, limit=1)] == [0, 1, 2, 3]
    source.close()


def check_idle(harness: Harness) -> None:
    source = harness.open()
    begin = time.monotonic()
    for _ in range(20):
        source.poll(100)
        assert source.next_block_s >= 0.0
    assert time.monotonic() - begin < AT_ONCE_S
    source.close()


def check_repetition(harness: Harness) -> None:
    source = harness.open()
    first = collect(source, 4)
    source.acknowledge("press", 2)
    time.sleep(0.2)
    source.close()
    source = harness.open(first[1])
    for before, again in zip(first[2:], collect(source, 2), strict=True):
        assert before.sequence == again.sequence and np.allclose(before.signals, again.signals, rtol=0.0, atol=1e-6)
    source.close()


def check_resumption(harness: Harness) -> None:
    source = harness.open()
    first = collect(source, 3)
    source.acknowledge("press", 3)
    time.sleep(0.2)
    source.close()
    source = harness.open(first[2])
    (following,) = collect(source, 1)
    assert following.sequence == 3 and following.t[0] > first[2].t[-1]
    source.close()


def check_closing(harness: Harness) -> None:
    for source in (harness.create(), harness.open()):
        source.close()
        source.close()


@pytest.mark.parametrize("check", CHECKS)
@pytest.mark.parametrize("kind", sorted([*find_kinds(SOURCES), "plant"]))
def test_a_source_keeps_its_contract(kind: str, check: str, request: pytest.FixtureRequest) -> None:
    harness: Harness = request.getfixturevalue(kind)
    harness.start = time.time() if kind != "replay" else harness.settings.start.timestamp()
    checks: dict[str, Callable[[Harness], None]] = {name: globals()[f"check_{name}"] for name in CHECKS}
    checks[check](harness)


@pytest.mark.parametrize("kind", sorted(find_kinds(PUBLISHERS)))
def test_publishing_neither_raises_nor_blocks_and_closing_twice_is_no_error(kind: str, tmp_path: Path) -> None:
    port = free_port()
    keys = {
        "mqtt": {"host": "127.0.0.1", "port": port, "every_s": 0.0},
        "opcua": {"listen": f"127.0.0.1:{port}"},
        **{key: {"path": "files", "every_s": 0.01} for key in ("aas", "ros2", "worklist")},
    }[kind]
    settings = find_kinds(PUBLISHERS)[kind].load().model_validate({"kind": kind, **keys})
    publisher = settings.create("hall.contract", tmp_path)
    press = {**status(), "counted": {"began": 0.0, "t": 1767225640.0}}
    publisher.open({"press": press, "hall": {"service": True}})  # nobody listens, no broker is there

    def publish() -> None:
        begin = time.monotonic()
        for k in range(20):
            publisher.publish({"press": {**press, "statistic": float(k)}, "hall": {"service": True}})
        assert time.monotonic() - begin < AT_ONCE_S

    publish()
    publisher.close()
    publisher.close()
    publish()


@pytest.fixture
def follow(tmp_path: Path, project: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """Install a package of `examples/packages`, which CONTRIBUTING.md explains, as `pip install .` would."""

    def write(package: str) -> Path:
        folder = project / "examples" / "packages" / package
        files = {path.name: path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.*"))}
        assert len(files) == 3
        for name, content in files.items():
            (tmp_path / name).write_text(content, encoding="utf-8")
        made = tomllib.loads(files["pyproject.toml"])["project"]
        groups = made["entry-points"]
        info = tmp_path / f"{made['name'].replace('-', '_')}-{made['version']}.dist-info"
        info.mkdir(exist_ok=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {made['name']}\nVersion: {made['version']}\n")
        lines = [f"[{group}]\n" + "\n".join(f"{k} = {v}" for k, v in each.items()) for group, each in groups.items()]
        (info / "entry_points.txt").write_text("\n\n".join(lines))
        monkeypatch.syspath_prepend(str(tmp_path))
        importlib.invalidate_caches()
        if not (tmp_path / "baseline.json").exists():
            halls.files(tmp_path)
        return tmp_path

    return write


def spool(folder: Path, write: Callable[[list[dict[str, float]]], str]) -> None:
    """Write files of ten samples each."""
    (folder / "spool" / "press").mkdir(parents=True)
    samples = list(map(json.loads, rows()))
    for k in range(0, len(samples), 10):
        (folder / "spool" / "press" / f"{k:05}").write_text(write(samples[k : k + 10]))


def lines_of(samples: list[dict[str, float]]) -> str:
    return "\n".join(";".join(repr(row[name]) for name in "truy") for row in samples)


@pytest.mark.parametrize(("package", "limit"), [("spool", 40), ("lines", 30)])
def test_a_transport_and_a_decoder_take_few_lines(project: Path, package: str, limit: int) -> None:
    path = project / "examples" / "packages" / f"servoscope-{package}" / f"servoscope_{package}.py"
    code = ast.unparse(ast.parse(path.read_text(encoding="utf-8"))).splitlines()  # without comments and empty lines
    texts = [line for line in code if line.strip() and not line.strip().startswith('"""')]
    assert len(texts) <= limit, len(texts)


@pytest.mark.parametrize("check", CHECKS)
def test_the_recipe_for_a_transport_keeps_the_contract(follow: Callable[[str], Path], check: str) -> None:
    folder = follow("servoscope-spool")
    spool(folder, json.dumps)
    globals()[f"check_{check}"](Harness("spool", {"path": "spool", "payload": SPOOLED}, AXIS, folder))


@pytest.mark.parametrize("check", CHECKS)
def test_the_recipe_for_a_decoder_keeps_the_contract(follow: Callable[[str], Path], check: str) -> None:
    follow("servoscope-spool")
    folder = follow("servoscope-lines")
    spool(folder, lines_of)
    globals()[f"check_{check}"](Harness("lines", {"path": "spool"}, AXIS, folder))


def test_what_a_decoder_cannot_use_costs_itself_whatever_it_raises(follow: Callable[[str], Path]) -> None:
    follow("servoscope-spool")
    folder = follow("servoscope-lines")
    spool(folder, lambda samples: lines_of(samples) if samples[0]["r"] != 10 else "1;2")
    source = Harness("lines", {"path": "spool"}, AXIS, folder).create()
    decode = source.decoder.decode

    def fail(message: InboxMessage) -> Content:
        return decode(message._replace(content=None) if message.address == "press/00100" else message)

    source.decoder.decode = fail  # type: ignore[method-assign]
    source.open({})
    assert sum(block.t.size for block in collect(source, 5)) == 250
    found = {(one.asset, one.kind): one for one in source.rejections.take()}
    assert found["press", "not a block"].count == 2
    assert "AttributeError: 'NoneType'" in found["press", "not a block"].reason
    source.close()


def test_the_recipes_for_sources_work_in_a_service_file(follow: Callable[[str], Path]) -> None:
    folder = follow("servoscope-spool")
    assert run("run", folder / "hall.toml", "--check").code == 0
    text = (folder / "hall.toml").read_text().replace('"spool"', '"spol"', 1)
    (folder / "wrong.toml").write_text(text)
    one_line(
        run("run", folder / "wrong.toml", "--check"),
        "[sources] line.kind: 'spol' is unknown, choose from folder, kafka, mqtt, opcua, replay, spool",
    )
    (folder / "wrong.toml").write_text(text.replace('"spol"', '"spool"').replace("path", "pth"))
    one_line(run("run", folder / "wrong.toml", "--check"), "[sources] line.pth: unknown key, did you mean 'path'?")
    folder = follow("servoscope-lines")
    assert run("run", folder / "hall.toml", "--check").code == 0


def test_the_recipe_for_a_publisher_works(follow: Callable[[str], Path]) -> None:
    folder = follow("servoscope-board")
    assert run("run", folder / "hall.toml").code == 0
    assert "press: " in (folder / "board.txt").read_text()
