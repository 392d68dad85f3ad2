"""Where values stand in messages, what time stamps may say, when a message is acknowledged, births and deaths."""

from __future__ import annotations

import json
import math
import time
import tomllib
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
import plant_writers as plants
import pytest
from commands import one_line, run
from halls import files
from inboxes import HandInbox
from pydantic import ValidationError

from servoscope.core.errors import ConfigError, MessageError
from servoscope.models.loop import Columns
from servoscope.service.mapping.influx import parse_lines
from servoscope.service.mapping.paths import RowPath, TextPattern, find
from servoscope.service.mapping.rows import MessageMapping
from servoscope.service.mapping.settings import PayloadSettings
from servoscope.service.mapping.sparkplug import SparkplugDecoder, encode_rebirth, payload_class
from servoscope.service.sources import inbox as inbox_module
from servoscope.service.sources.block import ResumePosition
from servoscope.service.sources.message import RejectionCounter, SourceAsset
from servoscope.signals.readers import read

NEW_YEAR = 1767225600.0  # 2026-01-01T00:00:00Z, the time of the page's examples
AHEAD_S = 60.0


def settings(**keys: Any) -> PayloadSettings:
    return PayloadSettings.model_validate({"topics": ["plant/{asset}"], **keys})


class Line:
    """An inbox of the asset press at 100 Hz, and which messages it has acknowledged."""

    def __init__(self, *, limit: int = 1000, last: ResumePosition | None = None, **keys: Any) -> None:
        self.rejections, self.acknowledged = RejectionCounter(), list[int]()
        asset = SourceAsset(SimpleNamespace(sample_rate=100.0), None, AHEAD_S)  # type: ignore[arg-type]
        table = settings(**{"time": {"t": "s"}, "block": 0.1, **keys})
        self.inbox = HandInbox(table, {"press": asset}, self.rejections, limit)
        self.inbox.begin({} if last is None else {"press": last})
        self.sent, self.requested = 0, list[tuple[str, bytes]]()
        self.inbox.transport.send = lambda *request: self.requested.append(request)  # type: ignore[method-assign]

    def send(self, plain: Any, topic: str = "plant/press", **how: bool) -> None:
        number, content = self.sent, plain if isinstance(plain, bytes) else json.dumps(plain).encode()
        self.sent += 1
        self.inbox.add(topic, content, lambda: self.acknowledged.append(number), **how)

    def rows(self, start: float, count: int, first: int = 0) -> None:
        for k in range(first, first + count):
            self.send({"t": start + 0.01 * k, "r": k, "u": -k, "y": 2 * k})

    def refused(self) -> dict[str, int]:
        return {one.kind: one.count for one in self.rejections.take()}


@pytest.mark.parametrize("name", [name for name in plants.WRITERS if plants.form(name)[1]])
def test_the_examples_of_the_page_are_read_as_they_stand(name: str) -> None:
    table, example = plants.form(name)
    refused: list[tuple[str, ...]] = []
    found = PayloadSettings.model_validate(tomllib.loads(table))
    mapping = MessageMapping(
        found,
        {"press": 100.0, "lift": 100.0} if "lift" in table else {"press": 100.0},
        lambda *one: refused.append(one),
    )
    topic = next(
        one
        for one in mapping.addresses()
        if "press" in one or not found.names_assets or "+" in one or "/" not in one or "press" in example
    )
    topic = topic.replace("press/r", "press/y").replace("+", "north")
    content = mapping.read(topic if "lift" not in topic else topic.replace("lift", "press"), example.encode(), 0.0)
    values = {(one.signal, one.t): one.value for one in content.values["press"]}
    first = {0: 0.1, 1: 2.3, 2: 0.099}
    assert values and not refused
    assert {k: v for (k, t), v in values.items() if t == NEW_YEAR} == {k: first[k] for k, t in values if t == NEW_YEAR}


def test_patterns_and_paths_find_what_they_name() -> None:
    pattern = TextPattern("plant/{line}/{asset}/{signal}")
    assert pattern.match("plant/north/press/y") == {"line": "north", "asset": "press", "signal": "y"}
    assert pattern.match("plant/north/press") is None and pattern.match("plant/a/b/c/d") is None
    known = {"asset": frozenset({"press", "lift"}), "signal": frozenset({"y"})}
    assert pattern.filters(known) == {"plant/+/press/y", "plant/+/lift/y"}
    assert TextPattern("a/x-{line}.{asset}/b").filters(known) == {"a/+/b"}  # a filter has whole levels only
    tree = {"a": [{"b": 1}, {"b": 2}], "c": {"press": [[1, 2]], "lift": []}}
    assert find(tree, ("a", 1, "b")) == 2
    assert [around[0] for around, _ in RowPath("a").rows(tree)] == tree["a"]
    assert [(around[0], names) for around, names in RowPath("c.{asset}").rows(tree)] == [([1, 2], {"asset": "press"})]
    assert [around[0] for around, _ in RowPath("a.*.b").rows(tree)] == [1, 2]


@pytest.mark.parametrize(
    ("stamp", "time_of"),
    [
        ({"t": "2026-01-01T01:00:00.25+01:00"}, {"t": "iso"}),
        ({"t": "2026-01-01T00:00:00.250000000"}, {"t": "iso"}),
        ({"t": "1767225600250"}, {"t": "ms"}),
        ({"t": 1767225600250000}, {"t": "us"}),
        ({"t": 1767225600250000000}, {"t": "ns"}),
        ({"head": {"day": 1767225600, "ms": 250}}, {"head.day": "s", "head.ms": "ms"}),
    ],
)
def test_times_in_any_unit_are_one_time(stamp: dict[str, Any], time_of: dict[str, str]) -> None:
    mapping = MessageMapping(settings(time=time_of, scale={"y": 0.001}), {"press": 100.0}, print)
    found = mapping.read("plant/press", json.dumps({**stamp, "r": 1, "u": None, "y": "5e3"}).encode(), 0.0)
    (r, u, y) = found.values["press"]
    assert r.t == u.t == y.t == NEW_YEAR + 0.25 and (r.value, y.value) == (1.0, 5.0) and math.isnan(u.value)


def test_local_times_are_those_of_their_zone_also_in_the_hour_that_comes_twice(tmp_path: Path) -> None:
    """Messages and columns of a file have the same rule: rows after the step back belong to the second hour."""
    began = datetime(2026, 10, 25, 0, 59, 50, tzinfo=UTC).timestamp()  # ten seconds before clocks are put back
    utc = began + 0.5 * np.arange(50)
    local = [datetime.fromtimestamp(t, ZoneInfo("Europe/Berlin")).replace(tzinfo=None).isoformat(" ") for t in utc]
    mapping = MessageMapping(settings(time={"t": "iso"}, time_zone="Europe/Berlin"), {"press": 2.0, "lift": 2.0}, print)
    rows = [json.dumps({"t": t, "r": k, "u": k, "y": k}).encode() for k, t in enumerate(local)]
    mapping.read("plant/lift", rows[-1], 0.0)  # another asset's clock says nothing of this one's
    times = [mapping.read("plant/press", row, 0.0).values["press"][0].t for row in rows]
    assert times == utc.tolist()
    (tmp_path / "log.csv").write_text("t,r,u,y\n" + "".join(f"{t},{k},{k % 7},{k % 5}\n" for k, t in enumerate(local)))
    recording = read(tmp_path / "log.csv", columns=Columns(time_zone="Europe/Berlin"))
    assert np.allclose(recording.t, utc - began, rtol=0.0, atol=1e-6)
    aware = json.dumps({"t": "2026-10-25T02:00:00Z", "r": 1, "u": 1, "y": 1}).encode()
    assert mapping.read("plant/press", aware, 0.0).values["press"][0].t == began + 3610.0  # it says its own
    refused: list[tuple[str, ...]] = []
    mapping = MessageMapping(mapping.settings, {"press": 2.0}, lambda *one: refused.append(one))
    assert not mapping.read(
        "plant/press", rows[0].replace(b"2026-10-25 02:59:50", b"9999-12-31 23:59:59.999999"), 0.0
    ).values
    assert refused[0][1] == "times"
    with pytest.raises(ValidationError, match="no zone of the IANA list"):
        settings(time_zone="Europe/Bielefeld")


def test_columns_are_dated_by_their_first_or_last_sample_or_one_by_one() -> None:
    columns = {"r": [1, 2, 3], "u": [4, 5, 6], "y": [7, 8, 9]}
    for more, stamp, t in (
        ({}, 10.0, [10.0, 10.01, 10.02]),
        ({"stamp": "last", "step_s": 0.5}, 10.0, [9.0, 9.5, 10.0]),
        ({}, [10.0, 10.5, 12.0], [10.0, 10.5, 12.0]),
    ):
        mapping = MessageMapping(settings(time={"t": "s"}, **more), {"press": 100.0}, print)
        found = mapping.read("plant/press", json.dumps({"t": stamp, **columns}).encode(), 0.0).values["press"]
        assert [one.t for one in found if one.signal == 2] == pytest.approx(t)
        assert [one.value for one in found] == [1, 2, 3, 4, 5, 6, 7, 8, 9]


@pytest.mark.parametrize(
    ("plain", "kind", "words"),
    [
        (b"[" * 100_000, "not a block", "no JSON"),
        ({"t": 1, "x": 2}, "keys", "none of r, u, y is there, only t, x"),
        ({"t": 1, "r": 1, "u": [], "y": 2}, "lengths", "lists of 0 and 1"),
        ({"t": 1, "r": 1, "u": "full", "y": 2}, "wrong type", "u: 'full' is no number"),
        ({"t": 1, "r": 1, "u": {}, "y": 2}, "wrong type", "u: '{}' is no number"),
        ({"r": 1, "u": 1, "y": 2}, "times", "no time stamp at 't', only r, u, y"),
        ({"t": "noon", "r": 1, "u": 1, "y": 2}, "wrong type", "'noon' is no number"),
        ({"t": 1e18, "r": 1, "u": 1, "y": 2}, "times", "is its unit right"),
        ({"t": math.nan, "r": 1, "u": 1, "y": 2}, "times", "is its unit right"),
        ({"t": 10**400, "r": 1, "u": 1, "y": 2}, "wrong type", "no number that a computer can hold"),
        ([1, 2], "keys", "none of r, u, y is there, only int 2"),
    ],
)
def test_what_cannot_be_read_costs_itself_and_says_why(plain: Any, kind: str, words: str) -> None:
    line = Line()
    line.rows(time.time(), 15)
    line.send(plain)
    line.rows(time.time(), 10)
    found = line.rejections.take()
    assert (found[0].asset, found[0].kind) == ("press", kind) and words in found[0].reason
    assert 15 in line.acknowledged  # it does not come again


def test_what_is_not_mapped_is_told_unless_it_is_to_be_ignored() -> None:
    row = {"t": time.time(), "r": 1, "u": 2, "y": 3, "temperature": 40}
    for ignore, expected in ((False, {"extra": 1}), (True, {})):
        line = Line(ignore_extra=ignore)
        line.send(row)
        assert line.refused() == expected
    line = Line(topics=["plant"], rows="{asset}")
    line.send({"press": row, "presse": row}, "plant")
    (told,) = line.rejections.take()
    assert (told.asset, told.kind) == ("", "extra") and "row of 'presse'" in told.reason


def test_a_message_is_acknowledged_when_all_its_samples_are_stored_and_not_before() -> None:
    line, start = Line(), time.time() - 5.0
    line.rows(start, 25)
    blocks = line.inbox.poll(100)
    assert [block.sequence for block in blocks] == [0, 1] and not line.acknowledged
    np.testing.assert_array_equal(np.concatenate([block.y for block in blocks]), 2.0 * np.arange(20))
    line.inbox.acknowledge("press", 1)
    assert line.acknowledged == list(range(10))
    line.inbox.acknowledge("press", 1)
    assert line.acknowledged == list(range(20))
    # a service that was killed behind the first block gets the others again, and begins behind what it has stored
    again = Line(last=ResumePosition(0, start, 0, float(blocks[0].t[-1])))
    again.rows(start, 20, first=5)
    (block,) = again.inbox.poll(100)
    assert block.sequence == 1 and block.signals.tobytes() == blocks[1].signals.tobytes()
    assert again.acknowledged == list(range(5))  # they are in what was stored
    again.inbox.acknowledge("press", 1)
    assert again.acknowledged == list(range(15))


def test_what_is_behind_ahead_or_sent_twice_is_counted_apart_and_not_used() -> None:
    line, now = Line(), time.time()
    line.rows(now - 10.0, 12)
    line.send({"t": now - 10.0, "r": 0, "u": 0, "y": 0})  # sent twice: the same words
    line.send({"t": now - 3600.0, "r": 0, "u": 9, "y": 0})
    line.send({"t": now + 7200.0, "r": 0, "u": 9, "y": 0})
    line.rows(now - 10.0, 18, first=12)
    blocks = line.inbox.poll(100)
    assert line.refused() == {"repeated": 1, "late": 3, "future": 1 * 3}
    np.testing.assert_array_equal(np.concatenate([block.y for block in blocks]), 2.0 * np.arange(10 * len(blocks)))
    line.inbox.acknowledge("press", len(blocks))
    assert set(range(15)) <= set(line.acknowledged)  # what is refused is not sent again


def test_a_signal_that_does_not_come_is_missing_and_a_pause_is_a_gap(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inbox_module, "MAX_QUIET_S", 0.0)
    t0 = time.time() - 5.0
    for hold_s, missing, samples in ((0.0, [3], 8), (1.0, [], 12)):
        line = Line(hold_s=hold_s, block=0.05)
        for k in (0, 1, 2, 3, 4, 9, 10, 11):
            line.send({"t": t0 + 0.01 * k, "r": 0.0, "u": k, **({} if k == 3 else {"y": k})})
        time.sleep(0.2)
        blocks = line.inbox.poll(100)
        y = np.concatenate([block.y for block in blocks])
        assert y.size == samples and np.flatnonzero(np.isnan(y)).tolist() == missing
        assert line.refused() == ({"gap": 4} if hold_s == 0.0 else {})


def test_fewer_messages_than_a_block_needs_do_not_stop_a_broker_that_waits_for_acknowledgements() -> None:
    line = Line(limit=8, block=10.0)
    line.rows(time.time(), 5)
    assert [block.t.size for block in line.inbox.poll(10)] == [5]


def test_a_signal_that_is_too_slow_makes_no_samples_that_would_look_like_a_fault() -> None:
    line, t0, noise = Line(), time.time() - 30.0, np.random.default_rng(1).normal(size=300)
    for k in range(150):
        line.send({"t": t0 + 0.1 * k, "r": noise[k], "u": noise[k], "y": noise[k]})
    assert line.inbox.asset_troubles["press"].why.startswith("r comes every 100 ms, the loop needs 10")
    assert line.refused()["slow"] > 50


def test_signals_in_messages_of_their_own_may_come_one_after_the_other() -> None:
    line, t0 = Line(topics=["plant/{asset}/{signal}"], value="v"), time.time() - 5.0
    for start in range(0, 60, 10):
        for name in "ruy":
            for k in range(start, start + 10):
                line.send({"t": t0 + 0.01 * k, "v": k}, f"plant/press/{name}")
    blocks = line.inbox.poll(100)
    assert np.concatenate([block.u for block in blocks]).tolist() == list(range(10 * len(blocks))) and len(blocks) >= 4


# r, u, y, i8: -1, on, n, gone, big: -5, encoded with the schema of Eclipse Tahu as pysparkplug 0.6.1 has compiled it
TAHU = bytes.fromhex(
    "0880d0eab6b73312130a017210001880d0eab6b7332009650000003f12140a017510011881d0eab6b733200350feffffff0f1217"
    "0a017910021882d0eab6b733200a69f2d24d621058b93f12120a02693810031883d0eab6b733200150ff0112110a026f6e100418"
    "84d0eab6b733200b700112110a016e10051885d0eab6b733200c7a0178120a0a04676f6e65200a380112220a0362696720044a0e"
    "0a04756e69741206080c42026d6d58fbffffffffffffffff011803"
)


def test_sparkplug_is_read_as_tahu_writes_it() -> None:
    rows = SparkplugDecoder().decode({"message": "NBIRTH", "group": "g", "node": "n"}, TAHU)
    found = {row["name"]: row["value"] for row in rows}
    assert found == {"r": 0.5, "u": -2, "y": 0.099, "i8": -1, "gone": None, "big": -5}
    assert [row["timestamp"] for row in rows][:3] == [1767225600000, 1767225600001, 1767225600002]


def metrics(*found: dict[str, Any], t: float = NEW_YEAR) -> bytes:
    one = payload_class()(timestamp=round(1e3 * t))
    for metric in found:
        one.metrics.add(**metric)
    return bytes(one.SerializeToString())


def test_an_alias_needs_its_birth_and_after_a_death_nothing_holds() -> None:
    line, t0 = (
        Line(
            form="sparkplug",
            topics=["spBv1.0/{group}/{message}/{node}/{asset}", "spBv1.0/{group}/{message}/{node}"],
            time={"timestamp": "ms"},
        ),
        round(time.time()) - 10.0,
    )
    assert "spBv1.0/+/+/+/press" in line.inbox.mapping.addresses()

    def data(k: int) -> bytes:
        return metrics(*({"alias": a, "double_value": float(k)} for a in (1, 2, 3)), t=t0 + 0.01 * k)

    line.send(data(0), "spBv1.0/g/DDATA/n/press")
    assert [topic for topic, _ in line.requested] == ["spBv1.0/g/NCMD/n"] and line.refused() == {"no birth": 1}
    line.send(metrics({"name": "bdSeq", "datatype": 8, "long_value": 4}), "spBv1.0/g/NBIRTH/n")
    birth = metrics(
        *({"name": x, "alias": a, "datatype": 10, "double_value": 0.0} for a, x in enumerate("ruy", 1)), t=t0
    )
    line.send(birth, "spBv1.0/g/DBIRTH/n/press")
    assert len(line.requested) == 1
    for k in range(1, 15):
        line.send(data(k), "spBv1.0/g/DDATA/n/press")
    line.send(metrics({"name": "bdSeq", "datatype": 8, "long_value": 3}), "spBv1.0/g/NDEATH/n")  # of an earlier session
    assert not line.inbox.asset_troubles
    line.send(metrics({"name": "bdSeq", "datatype": 8, "long_value": 4}), "spBv1.0/g/NDEATH/n")
    assert line.inbox.asset_troubles["press"].state == "silent" and "NDEATH" in line.inbox.asset_troubles["press"].why
    birth = metrics(
        *({"name": x, "alias": a, "datatype": 10, "double_value": 9.0} for a, x in enumerate("ruy", 1)), t=t0 + 2.0
    )
    line.send(birth, "spBv1.0/g/DBIRTH/n/press")
    for k in range(201, 215):
        line.send(data(k), "spBv1.0/g/DDATA/n/press")
    assert not line.inbox.asset_troubles
    blocks = line.inbox.poll(100)
    t = np.concatenate([block.t for block in blocks])
    assert not ((t > t0 + 0.145) & (t < t0 + 1.99)).any()  # nothing was held over the time in which it was gone
    rebirth = payload_class().FromString(encode_rebirth(NEW_YEAR)).metrics[0]
    assert (rebirth.name, rebirth.boolean_value, rebirth.datatype) == ("Node Control/Rebirth", True, 11)


def test_lines_are_read_as_their_protocol_says() -> None:
    text = (
        "# a comment\n\nmy\\ axis,asset=press\\,1,line=a\\=b "
        'r=1,u=2i,y=-3.5e-2,on=t,"x\\ y"="a, b=\\"c\\" d" 1767225600\r\n'
        "axis,asset=lift r=1u\n"
    )
    first, second = parse_lines(text.encode())
    assert first["name"] == "my axis" and first["tags"] == {"asset": "press,1", "line": "a=b"}
    assert first["timestamp"] == 1767225600 and {k: first["fields"][k] for k in ("r", "u", "y", "on")} == {
        "r": 1.0,
        "u": 2,
        "y": -0.035,
        "on": True,
    }
    assert second == {"name": "axis", "tags": {"asset": "lift"}, "fields": {"r": 1}}
    for wrong in (
        b"axis",
        b"axis r=",
        b"axis r=1 2 3",
        b"axis,a r=1",
        b"axis r=1,u=one 5",
        b"\xff",
        b"axis r=" + b"a" * 100_000,
    ):
        with pytest.raises(MessageError):
            parse_lines(wrong)


def test_a_mapping_that_cannot_work_is_refused_in_one_line(tmp_path: Path) -> None:
    files(tmp_path)

    def check(payload: str) -> Any:
        (tmp_path / "hall.toml").write_text(
            f'[sources.plant]\nkind = "mqtt"\nhost = "h"\n[sources.plant.payload]\n{payload}\n'
            '[assets.press]\nbaseline = "baseline.json"\nsource = "plant"\n'
            '[assets.lift]\nbaseline = "baseline.json"\nsource = "plant"\n'
        )
        return run("run", tmp_path / "hall.toml", "--check")

    assert check('topics = ["plant/{asset}"]').code == 0
    for payload, words in (
        (
            'topics = ["plant/data"]',
            "nothing says of which asset a message is, write {asset} into topics, rows or match",
        ),
        ('topics = ["plant/+/data"]', "write a name in braces for a level that may be anything"),
        ('topics = ["{asset}"]\ntime = { t = "min" }', "time.t"),
        ('topics = ["{asset}"]\ntimes = "t"', "did you mean 'time'?"),
        ('topics = ["{asset}"]\nvalue = "v"', "say by {signal} in topics, rows or match of which signal it is"),
        ('topics = ["{asset}/{signal}", "{asset}"]', "{signal} must stand in all of them, or in none"),
        ('topics = ["{asset}"]\nfields = { r = "y" }', "r, u and y must be different ones, and so must covariates"),
        ('topics = ["{asset}"]\ncalled = { pres = "Device" }', "there is no asset 'pres' of this source"),
        ('form = "telegraf"', "topics: missing"),
    ):
        one_line(check(payload), words)
    with pytest.raises(ConfigError, match="two assets of this source are called the same"):
        MessageMapping(settings(called={"press": "lift"}), {"press": 1.0, "lift": 1.0}, print)
    with pytest.raises(ValidationError):
        settings(hold_s=-1.0)
