"""Messages made to hang, slow down or fill the service: they cost themselves, and at most one restart."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import halls
import pytest
from brokers import Sender, started_broker, until
from halls import asked
from hypothesis import given
from hypothesis import strategies as st
from inboxes import STUB, HandInbox
from reliability.servers import Mosquitto

from servoscope.core.errors import MessageError
from servoscope.core.workers import WorkerError
from servoscope.service.mapping import sparkplug
from servoscope.service.mapping.influx import parse_lines
from servoscope.service.mapping.paths import MAX_ROWS, MAX_TEXT_CHARS, NAME, TextPattern
from servoscope.service.mapping.rows import MAX_BAD_ROWS, TASK, MessageMapping
from servoscope.service.mapping.settings import PayloadSettings
from servoscope.service.mapping.sparkplug import SparkplugDecoder, payload_class
from servoscope.service.sources import guard as guarding
from servoscope.service.sources.guard import MessageGuard


def first_reading(parts: list[str], text: str) -> dict[str, str] | None:
    """Return the first way to read a text, longer contents of the first names first, by trying all of them."""
    if not text.startswith(parts[0]):
        return None
    rest = text[len(parts[0]) :]
    if len(parts) == 1:
        return None if rest else {}
    for n in range(len(rest.partition("/")[0]), 0, -1):
        if (found := first_reading(parts[2:], rest[n:])) is not None:
            return {parts[1]: rest[:n], **found}
    return None


@st.composite
def patterns(draw: st.DrawFn) -> str:
    """Return a pattern in which each name stands once."""
    pieces = draw(st.lists(st.sampled_from(["{}", ".", "..", "x", ".x", "/", "-"]), min_size=1, max_size=7))
    names = iter("abcdefg")
    return "".join(f"{{{next(names)}}}" if piece == "{}" else piece for piece in pieces)


@given(patterns(), st.text("..x/-y", max_size=12))
def test_a_pattern_finds_what_trying_all_readings_finds(pattern: str, text: str) -> None:
    assert TextPattern(pattern).match(text) == first_reading(NAME.split(pattern), text)


def test_a_name_that_stands_twice_has_one_content() -> None:
    pattern = TextPattern("{asset}.{signal}/{asset}")
    assert pattern.match("a.b.y/a.b") == {"asset": "a.b", "signal": "y"} and pattern.match("a.b.y/a") is None
    assert TextPattern("{line}-{line}").match("a-b") is None


@pytest.mark.parametrize("names", [2, 8])
def test_a_pattern_with_many_names_in_a_level_takes_no_longer_than_its_text(names: int) -> None:
    """The service's own expression has one repetition a level; with one for each name this test does not end."""
    pattern = TextPattern("Channel1." + ".".join(f"{{name{k}}}" for k in range(names)))
    assert all(level.count("+") <= 1 for level in pattern._regex.pattern.split("/"))
    assert pattern.match("Channel1." + (MAX_TEXT_CHARS - 9) * "." + "/") is None
    longest = "Channel1." + (MAX_TEXT_CHARS - 9) * "."
    assert pattern.match(longest) is not None and pattern.match(longest + ".") is None
    assert pattern.match("Channel1." + 10**6 * "." + "/") is None


def read_counted(table: dict[str, Any], content: bytes, topic: str = "line/press") -> tuple[int, Counter[str]]:
    """Return how many values a message has, and how many of it were refused, by kind."""
    refused = Counter[str]()
    settings = PayloadSettings.model_validate({"topics": ["line/{asset}"], **table})
    mapping = MessageMapping(settings, {"press": 100.0}, lambda _asset, kind, _why: refused.update([kind]))
    content_read = mapping.read(topic, content, 1.0)
    return sum(map(len, content_read.values.values())), refused


def test_rows_that_cannot_be_used_are_refused_one_by_one_up_to_a_number() -> None:
    good = {"r": 1, "u": 2, "y": 3}
    rows = [good, *({"r": "x"} for _ in range(100_000)), good]
    assert read_counted({}, json.dumps(rows).encode()) == (3, {"wrong type": MAX_BAD_ROWS + 1, "rows": 1})
    some = [good, *({"r": "x"} for _ in range(MAX_BAD_ROWS)), good]
    assert read_counted({}, json.dumps(some).encode()) == (6, {"wrong type": MAX_BAD_ROWS})


@pytest.mark.parametrize("rows", [MAX_ROWS, MAX_ROWS + 1])
def test_the_rows_of_a_message_have_a_limit_in_each_form(rows: int) -> None:
    refused = {"rows": 1} if rows > MAX_ROWS else {}
    other = {"match": {"name": "y{asset}"}, "ignore_extra": True}  # what costs least: nobody wants them
    assert read_counted(other, json.dumps(rows * [{"name": "x"}]).encode()) == (0, refused)
    assert read_counted({"decoder": "influx", **other}, rows * b"x a=1\n") == (0, refused)
    assert len(parse_lines(10 * rows * b"x a=1\n")) <= MAX_ROWS + 1
    payload = payload_class()()
    for _ in range(rows):
        payload.metrics.add(name="x", double_value=1.0)
    table = {"form": "sparkplug", "topics": ["spBv1.0/{message}/{asset}"], "match": {"name": "{signal}"}}
    found = read_counted(table, payload.SerializeToString(), "spBv1.0/DDATA/press")
    assert found == (0, refused)


def birth(*names: str) -> bytes:
    payload = payload_class()()
    for alias, name in enumerate(names, 1):
        payload.metrics.add(name=name, alias=alias, datatype=10, double_value=0.0)
    return bytes(payload.SerializeToString())


def data(alias: int) -> bytes:
    payload = payload_class()()
    payload.metrics.add(alias=alias, double_value=1.0)
    return bytes(payload.SerializeToString())


def topic_names(kind: str, node: str, asset: str = "press") -> dict[str, str]:
    return {"message": kind, "group": "g", "node": node, "asset": asset}


def test_births_are_remembered_as_far_as_something_maps_them(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = PayloadSettings.model_validate({"form": "sparkplug", "match": {"name": "{asset}/{signal}"}})
    mapping = MessageMapping(settings, {"press": 100.0}, lambda *_: None)
    decoder = mapping._sparkplug
    assert decoder is not None
    made_up = birth(*(f"lift{k}/r" for k in range(5000)), *(f"press/made-up{k}" for k in range(5000)), "press/y")
    for k in range(40):
        decoder.decode(topic_names("DBIRTH", f"n{k}"), made_up)
    assert sum(one.size for one in decoder._nodes.values()) == 40 * 3  # y by name and alias, and whose birth it is
    assert [row["name"] for row in decoder.decode(topic_names("DDATA", "n0"), data(10_001))] == ["press/y"]
    assert decoder.decode(topic_names("DDATA", "n0"), data(1)) == []  # born, and mapped by nothing
    assert not decoder.missing_births
    with pytest.raises(MessageError, match="its birth has not come"):
        decoder.decode(topic_names("DDATA", "n0", "other"), data(1))


def test_one_limit_holds_over_all_nodes_and_those_that_are_heard_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sparkplug, "MAX_METRICS", 100)
    monkeypatch.setattr(sparkplug, "MAX_NODES", 20)
    decoder, content = SparkplugDecoder(), birth("r", "u", "y")
    for k in range(200):
        decoder.decode(topic_names("NBIRTH", f"n{k}"), content)
        assert decoder.decode(topic_names("NDATA", "n0"), data(1))[0]["name"] == "r"
        assert sum(one.size for one in decoder._nodes.values()) <= 100 and len(decoder._nodes) <= 20
    for k in range(200):
        with pytest.raises(MessageError):
            decoder.decode(topic_names("NDATA", f"made-up{k}"), data(1))
    assert len(decoder.missing_births) == 20


def test_what_was_asked_for_births_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    decoder, now, asked_for = SparkplugDecoder(), [0.0], list[str]()
    monkeypatch.setattr("servoscope.service.mapping.sparkplug.time.monotonic", lambda: now[0])
    for k in range(3000):
        decoder.missing_births.add(("g", f"n{k % 2000}"))
        asked_for += [topic for topic, _ in decoder.rebirth_requests()]
    assert len(asked_for) == len(set(asked_for)) == len(decoder._asked_at) == sparkplug.MAX_NODES
    assert not decoder.missing_births
    now[0] = 100.0
    decoder.missing_births.add(("g", "n0"))
    assert [topic for topic, _ in decoder.rebirth_requests()] == ["spBv1.0/g/NCMD/n0"]
    assert set(decoder._asked_at) == {("g", "n0")}


SETTINGS = PayloadSettings.model_validate({"topics": ["line/{asset}"]})


def test_only_a_message_that_was_in_hand_is_tried_and_only_one_that_fails_is_set_aside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = list[bytes]()

    def run(_self: Any, _task: str, _settings: Any, _rates: Any, _topic: str, content: bytes, **_: Any) -> None:
        if content:  # else it is only to be ready
            tried.append(content)
        if b"poison" in content:
            raise WorkerError("it took more than 10 s")

    monkeypatch.setattr(guarding.Workers, "run", run)
    path = tmp_path / "hall.in-hand"

    def killed_with(mark: int) -> MessageGuard:
        MessageGuard(path, TASK, SETTINGS, {"press": 100.0}).begin(mark)
        return MessageGuard(path, TASK, SETTINGS, {"press": 100.0})

    guard = killed_with(11)
    guard.check(12, "line/press", b"another")
    guard.check(11, "line/press", b"sound")
    guard.check(11, "line/press", b"sound")
    assert tried == [b"sound"]
    killed_with(21)
    guard = MessageGuard(path, TASK, SETTINGS, {"press": 100.0})  # and killed once more before it came again
    for _ in range(2):
        with pytest.raises(MessageError, match=r"8 bytes .* and once more: it took more") as refused:
            guard.check(21, "line/press", b"poison 1")
        assert refused.value.kind == "set aside"
    assert tried == [b"sound", b"poison 1"] and (tmp_path / "hall.in-hand.15").read_bytes() == b"poison 1"
    for mark in range(1000, 1100):
        guard = killed_with(mark)
    assert len(guard._suspects) == guarding.MAX_SUSPECTS and path.stat().st_size == 512


def test_a_service_goes_on_where_no_mark_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    source = HandInbox(SETTINGS, {"press": STUB})
    source.begin({}, tmp_path / "folder")
    done = list[bool]()
    source.add("line/press", b"[]", lambda: done.append(True))
    assert done == [True]


HANGING = """
import re
from servoscope.service.mapping import rows

parse_json = rows.parse_json

def hang(message):
    if b"poison" in message:
        open({marker!r}, "ab").write(b".")
        re.match("(a+)+$", 60 * "a" + "b")  # it holds the interpreter for years
    return parse_json(message)

rows.parse_json = hang
"""


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    server = started_broker(tmp_path)
    yield server
    server.stop(signal.SIGKILL)


def test_a_message_that_hangs_the_service_is_set_aside_after_a_kill(
    tmp_path: Path, broker: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    marker = tmp_path / "hung"
    (tmp_path / "sitecustomize.py").write_text(HANGING.format(marker=str(marker)))
    halls.files(tmp_path)
    path = tmp_path / "hall.toml"
    path.write_text(
        'name = "hall"\n[service]\nlisten = ""\ncommit_every_s = 0.05\nlog = "error"\n[store]\nurl = "hall.sqlite"\n'
        f'[sources.plant]\nkind = "mqtt"\nhost = "127.0.0.1"\nport = {broker.port}\n'
        '[sources.plant.payload]\ntopics = ["line/{asset}"]\ntime = { t = "s" }\nblock = 0.1\n'
        '[assets.press]\nbaseline = "baseline.json"\nsource = "plant"\n'
    )
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}

    def start() -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-m", "servoscope", "run", str(path)], env=environment)

    def samples() -> int:
        try:
            found = asked(path, "SELECT samples FROM recent WHERE asset = 'press'")
        except Exception:  # the store has not been made yet
            return 0
        return sum(len(one) // 32 for (one,) in found)

    sender, began = Sender(broker.port), time.time() - 60.0

    def send(*rows: int) -> None:
        for k in rows:
            row = {"t": began + 0.01 * k, "r": k, "u": -k, "y": 2 * k}
            sender.client.publish("line/press", json.dumps(row), qos=1).wait_for_publish(30.0)

    service = start()
    try:
        until(lambda: (tmp_path / "hall.sqlite.hall.plant.in-hand").exists(), 60.0)
        until(lambda: (send(0), samples() > 0)[1], 60.0)
        send(*range(1, 50))
        sender.client.publish("line/press", b'{"poison": 1}', qos=1)
        until(marker.exists, 60.0)
        send(*range(50, 100))  # these wait behind it
        time.sleep(0.5)
        assert marker.read_bytes() == b"."
        service.kill()
        service.wait()
        service = start()
        until(lambda: samples() >= 99, 120.0)
        kept = tmp_path.glob("hall.sqlite.hall.plant.in-hand.*")
        assert [one.read_bytes() for one in kept] == [b'{"poison": 1}']
        query = "SELECT asset, document FROM audit WHERE what = 'refused' AND document LIKE '%set aside%'"
        ((of, document),) = until(lambda: asked(path, query), 30.0)
        assert of == "press" and "kept as" in json.loads(document)["why"]
        assert marker.read_bytes() == b".."  # once in the service, once in the process that tried it
        service.terminate()
        assert service.wait(60.0) == 0
        service = start()  # it was acknowledged: it does not come again
        send(*range(100, 130))
        until(lambda: samples() >= 125, 120.0)
        assert marker.read_bytes() == b".."
    finally:
        service.kill()
        service.wait()
        sender.close()
