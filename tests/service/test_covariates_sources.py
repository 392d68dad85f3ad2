"""Covariates from wherever samples come: single values, a plant's messages, OPC UA, Kafka, lakes; and silent ones."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from brokers import BEGAN, kafka_brokers, kafka_cluster, until
from halls import asked, service_of
from hypothesis import given, settings
from hypothesis import strategies as st
from inboxes import HandInbox
from opcua_plant import NODES
from test_covariates_live import LOOP, WEAR, carry, hall
from test_opcua import RATE, Plant, source_assets
from test_opcua_foreign import ForeignPlant
from test_opcua_foreign import nodes as foreign_nodes

import servoscope as ss
from servoscope.detection.covariate_monitor import fill_channels
from servoscope.fleet.baselines import Baselines
from servoscope.fleet.lake import AssetDay
from servoscope.fleet.rows import Rows
from servoscope.fleet.tasks import ExamineTask
from servoscope.models.loop import Columns
from servoscope.service.kafka.source import KafkaSourceSettings
from servoscope.service.mapping.settings import PayloadSettings
from servoscope.service.opcua.settings import OpcuaNodes
from servoscope.service.opcua.source import OpcuaSourceSettings
from servoscope.service.sources.block import Block
from servoscope.service.sources.inbox import Inbox
from servoscope.service.sources.message import RejectionCounter, SourceAsset
from servoscope.service.sources.resample import Resampler
from servoscope.signals import clean, writers

pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


@given(st.lists(st.tuples(st.integers(0, 10), st.floats(0.0, 1.0), st.integers(0, 9)), max_size=20), st.booleans())
@settings(max_examples=60)
def test_covariates_make_no_samples_and_each_sample_has_the_newest(told: list[Any], held: bool) -> None:
    """Oracle: the newest value up to each sample; where nothing holds, only the first sample behind a value has it."""
    t, y = BEGAN + 0.1 * np.arange(11), np.arange(11.0)
    values = {float(t[k] - 0.04 * ahead): float(value) for k, ahead, value in told}
    one = Resampler(1, 0.1, hold_s=math.inf if held else 0.0, covariates=1)
    one.restart(0.0)
    for moment, value in zip(t, y, strict=True):
        one.add(0, moment, value)
    for when, value in values.items():
        one.add(1, when, value)
    made = one.take_samples(-math.inf, t[-1] + 1.0)
    assert np.array_equal(made.t, t) and np.array_equal(made.values[0], y) and not made.gaps and not one.take_late()
    for moment, found in zip(t, made.values[1], strict=True):
        newest = max((when for when in values if when <= moment), default=-math.inf)
        expected = values[newest] if newest > (-math.inf if held else moment - 0.05) else math.nan
        np.testing.assert_equal(found, expected)


def line(**keys: Any) -> tuple[HandInbox, RejectionCounter]:
    """Return an inbox of presses at 100 Hz, of which only press wants the temperature of its oil."""
    rejections = RejectionCounter()
    loop: Any = SimpleNamespace(sample_rate=100.0)
    assets = {"press": SourceAsset(loop, None, covariates=("oil",)), "lift": SourceAsset(loop, None)}
    table = PayloadSettings.model_validate({"topics": ["plant/{asset}"], "time": {"t": "s"}, "block": 0.1, **keys})
    inbox = HandInbox(table, assets, rejections, 1000)
    inbox.begin()
    return inbox, rejections


FIELDS = {"fields": {"covariates": {"load": "F", "oil": "T"}}, "scale": {"covariates": {"oil": 0.1}}}


def send(inbox: HandInbox, plain: Any, topic: str = "plant/press") -> list[int]:
    acknowledged: list[int] = []
    inbox.add(topic, json.dumps(plain).encode(), lambda: acknowledged.append(1))
    return acknowledged


def test_a_row_may_bring_a_covariate_now_and_then() -> None:
    inbox, rejections = line(**FIELDS)
    for k in range(20):
        for asset in ("press", "lift"):
            also = {"T": 400 + k, "F": 1.0} if k % 5 == 0 else {}
            send(inbox, {"t": BEGAN + 0.01 * k, "r": k, "u": -k, "y": 2 * k, **also}, f"plant/{asset}")
    found = {block.asset: block for block in inbox.poll(10)[::-1]}
    assert not rejections.take()
    np.testing.assert_array_equal(found["press"].covariates, [[40.0, *[math.nan] * 4, 40.5, *[math.nan] * 4]])
    assert len(found["lift"].covariates) == 0 and found["lift"].y.tolist() == (2.0 * np.arange(10)).tolist()


def test_lists_of_samples_may_have_one_temperature_or_one_each() -> None:
    inbox, rejections = line(**FIELDS)
    samples = {"r": [1] * 10, "u": [2] * 10, "y": list(range(10))}
    send(inbox, {"t": BEGAN, **samples, "T": 400})
    send(inbox, {"t": BEGAN + 0.1, **samples, "T": [410 + k for k in range(10)]})
    first, second = inbox.poll(10)
    assert first.covariates[0, 0] == 40.0 and np.isnan(first.covariates[0, 2:]).all()
    np.testing.assert_allclose(second.covariates[0], 41.0 + 0.1 * np.arange(10))
    send(inbox, {"t": BEGAN + 0.2, **samples, "T": [1, 2]})  # neither one nor one each
    assert [one.kind for one in rejections.take()] == ["lengths"]


def test_a_covariate_in_messages_of_its_own_belongs_to_the_next_sample() -> None:
    topics = {"topics": ["{asset}/{signal}"], "value": "v", "fields": {"covariates": {"oil": "T_oil"}}}
    inbox, rejections = line(**topics)
    for k in range(40):
        if k in (3, 13):
            assert send(inbox, {"t": BEGAN + 0.01 * k - 0.004, "v": 40 + k}, "press/T_oil") == []
        for signal in "ruy":
            send(inbox, {"t": BEGAN + 0.01 * k, "v": k}, f"press/{signal}")
    first, second, *_ = [*inbox.poll(10)]
    assert np.flatnonzero(~np.isnan(first.covariates[0])).tolist() == [3] and first.covariates[0, 3] == 43.0
    assert second.covariates[0, 3] == 53.0 and not rejections.take()


def test_a_thermometer_beside_a_machine_that_is_off_keeps_no_messages_open() -> None:
    """A broker sends no more than `in_flight` before it hears of the first: nor would it, once the machine runs."""
    inbox, rejections = line(**FIELDS)
    told: list[int] = []
    for k in range(1000):
        told += [send(inbox, {"t": BEGAN + k, "T": k})]  # lists, into which the acknowledgements come
    assert sum(not one for one in told) <= 500
    for k in range(30):
        send(inbox, {"t": BEGAN + 1000.0 + 0.01 * k, "r": k, "u": -k, "y": 2 * k})
    first, *_ = inbox.poll(10)
    np.testing.assert_array_equal(first.covariates, [[99.9, *[math.nan] * 9]])
    assert not rejections.take()


def test_a_thermometer_whose_clock_is_set_back_is_believed() -> None:
    one = Resampler(1, 0.1, hold_s=math.inf, covariates=1)
    one.restart(0.0)
    for t, value in ((BEGAN, 40.0), (BEGAN - 3600.0, 50.0), (BEGAN - 3599.0, 51.0)):
        one.add(0, t, value)
        one.add(1, t, value)
        made = one.take_samples(-math.inf, t + 0.05)
        assert made.values[:, -1].tolist() == [value, value]


def collect(source: Inbox, blocks: int) -> list[Block]:
    found: list[Block] = []
    until(lambda: (found.extend(source.poll(100)), len(found) >= blocks)[1], 60.0)
    source.close()
    return found


def test_kafka_carries_them(tmp_path: Path) -> None:
    producer = kafka_cluster()
    topics = {"topics": ["plant/{asset}"], "time": {"t": "s"}, "block": 0.1, **FIELDS}
    settings = KafkaSourceSettings.model_validate(
        {"kind": "kafka", "brokers": kafka_brokers(producer), "start": "beginning", "payload": topics}
    )
    assert settings.carries("oil", None) and not settings.carries("pressure", None)
    asset = SourceAsset(SimpleNamespace(sample_rate=100.0), None, covariates=("oil",))  # type: ignore[arg-type]
    for k in range(30):
        row = {"t": BEGAN + 0.01 * k, "r": k, "u": -k, "y": 2 * k, "T": 400 + k}
        producer.produce("plant", key="press", value=json.dumps(row))
    producer.flush(10.0)
    source = settings.create("hall.line", {"press": asset}, tmp_path)
    source.open({})
    blocks = collect(source, 2)
    np.testing.assert_allclose(np.concatenate([one.covariates[0] for one in blocks[:2]]), 40.0 + 0.1 * np.arange(20))


def received(settings: OpcuaSourceSettings, nodes: OpcuaNodes, count: int) -> list[Block]:
    """Return the first blocks of an asset whose loop names one covariate, oil."""
    source = settings.create("hall.line", source_assets(nodes, RATE, ("oil",)), Path())
    source.open({})
    return collect(source, count)


@pytest.mark.parametrize("kind", ["array", "single"])
def test_opcua_carries_them(kind: str) -> None:
    plant = Plant("nothing")
    covariates = {"oil": NODES["temperature"]}
    nodes = OpcuaNodes(block=NODES["warm"])
    if kind == "single":
        nodes = OpcuaNodes(r=NODES["r"], u=NODES["u"], y=NODES["y"], covariates=covariates)
    url = f"opc.tcp://127.0.0.1:{plant.port}/plant"
    settings = OpcuaSourceSettings.model_validate({"kind": "opcua", "url": url, "block": 0.25})
    assert settings.carries("oil", nodes) and settings.carries("load", nodes) == (kind == "array")
    try:
        blocks = received(settings, nodes, 8)
    finally:
        plant.close()
    t, _, _, y, oil = np.concatenate([block.signals for block in blocks], axis=1)
    np.testing.assert_array_equal(oil, y // 20)
    assert np.ptp(oil) >= 1.0 and (np.rint((t - plant.began) * RATE) == y).all()


def test_another_stack_carries_them() -> None:
    plant = ForeignPlant()
    nodes = foreign_nodes("lift").model_copy(update={"covariates": {"oil": "ns=1;s=lift.temperature"}})
    settings = OpcuaSourceSettings.model_validate(
        {"kind": "opcua", "url": f"opc.tcp://127.0.0.1:{plant.port}/plant", "block": 0.5}
    )
    try:
        blocks = received(settings, nodes, 6)
    finally:
        plant.kill()
    _, _, u, _, oil = np.concatenate([block.signals for block in blocks], axis=1)
    assert np.ptp(u) > 0.5 and np.isfinite(oil).all()
    assert set(np.diff(oil)) == {0.0, 1.0}  # one more every twenty samples


@pytest.fixture(scope="module")
def baseline() -> ss.Baseline:
    loop = LOOP.model_copy(update={"monitor": LOOP.monitor.model_copy(update={"covariate_hold_s": 5.0})})
    return ss.learn(loop, [carry(load, i) for i, load in enumerate((1.0, 3.0, 5.0))])


def silent_sensor(hold: bool = False) -> ss.Recording:
    """Twenty seconds under a load of 1, twenty under 5; the load cell falls silent in between, or sticks."""
    before, after = carry(1.0, 8), carry(5.0, 9)
    columns = {name: np.append(getattr(before, name), getattr(after, name)) for name in ("r", "u", "y")}
    load = np.where(np.arange(2 * before.samples) < before.samples, 1.0, 1.0 if hold else math.nan)
    t = np.arange(load.size) / before.sample_rate
    return clean(t, **columns, sample_rate=before.sample_rate, name="both", channels={"load": load})


def test_a_monitor_is_not_ready_where_a_covariate_is_too_old(baseline: ss.Baseline) -> None:
    one = ss.Monitor(baseline)
    for hold in (False, True):
        made = silent_sensor(hold)
        state, parts = one.init(), []
        cuts = np.arange(0, made.samples, 97 if hold else 211)
        for rows in np.split(np.arange(made.samples), cuts[1:]):
            part = made.rows(slice(rows[0], rows[-1] + 1))
            state, trace = one.run(state, part.r, part.u, part.y, part.restart, channels=part.channels)
            parts.append((trace.t, trace.exceeded, trace.ready))
        t, exceeded, ready = (np.concatenate(column) for column in zip(*parts, strict=True))
        late = t > 25.5
        # a sensor that is stuck is not told from another load by its own value; one that is silent is
        assert exceeded[late].any() == hold and ready[late].any() == hold
        assert ready[(t > 5.0) & (t < 19.0)].all()
        assert ("load" in one.covariate_history(state)) == hold
    whole, _ = one.run(one.init(), made.r, made.u, made.y, made.restart, channels=made.channels)
    np.testing.assert_array_equal(whole, state)


def test_a_recording_says_that_its_sensor_fell_silent(baseline: ss.Baseline) -> None:
    found = ss.diagnose(baseline, silent_sensor())
    assert found.verdict == "undetermined"
    assert "load has had no new value for more than 5 s" in str(found.headline)


def test_a_service_says_so_and_raises_no_alarm(baseline: ss.Baseline, tmp_path: Path) -> None:
    baseline.save(tmp_path / "baseline.json")
    columns = LOOP.columns
    writers.write_recording(tmp_path / "both.csv", silent_sensor(), columns)
    source = 'kind = "replay"\nblock = 0.5\nstart = 2026-01-01T00:00:00Z\nspeed = 0.0'
    config = hall(tmp_path, "silent", source, 'files = ["both.csv"]')
    service_of(config).run()
    status = json.loads(dict(asked(config, "SELECT asset, status FROM checkpoints"))["axis"])
    assert status["verdict"] == "undetermined"
    assert "load has had no new value for more than 5 s" in status["summary"]
    assert not asked(config, "SELECT t FROM diagnoses WHERE verdict = 'fault'")
    assert not asked(config, "SELECT t FROM transitions WHERE after = 'unacknowledged' AND alarm = 'fault'")


def test_what_a_monitor_knows_fills_what_minutes_lack() -> None:
    history = {"oil": (np.array([-2.0, 0.0]), np.array([40.0, 42.0])), "load": (np.zeros(1), np.array([3.0]))}
    t = np.array([-3.0, -1.0, 0.0])
    filled = fill_channels({"load": np.array([math.nan, 7.0, math.nan]), "oil": np.full(3, math.nan)}, t, history)
    assert list(filled) == ["load", "oil"]
    np.testing.assert_array_equal(filled["oil"], [40.0, 41.0, 42.0])
    np.testing.assert_array_equal(filled["load"], [math.nan, 7.0, math.nan])  # it has one of its own


def lake_day(folder: Path, name: str, made: ss.Recording, baseline: ss.Baseline, **more: Any) -> dict[str, Any]:
    """Write a recording as a day of a lake, and return its result."""
    begin = np.datetime64(datetime.fromtimestamp(BEGAN, UTC).replace(tzinfo=None), "us")
    t = begin + np.round(1e6 * made.t).astype("timedelta64[us]")
    table = pa.table({"t": t, "r": made.r, "u": made.u, "y": made.y, **more})
    pq.write_table(table, folder / f"{name}.parquet", row_group_size=700)
    baseline.save(folder / "baseline.json")
    item = AssetDay(name, "all", (str(folder / f"{name}.parquet"),), "stamp")
    # columns that a user gave say nothing of covariates
    return ExamineTask(item, str(folder / "baseline.json"), "", 1, Columns(), 60.0, None).run()


def test_lakes_carry_them(baseline: ss.Baseline, tmp_path: Path) -> None:
    healthy, worn = carry(2.0, 18), carry(4.0, 19, WEAR, seconds=30.0)
    slow = pa.array([2.0 if k % 100 == 30 else None for k in range(healthy.samples)])  # a load cell of 2 Hz
    assert lake_day(tmp_path, "healthy", healthy, baseline, load=slow)["diagnosis"]["verdict"] == "healthy"
    found = lake_day(tmp_path, "worn", worn, baseline, load=worn.channels["load"])
    assert found["diagnosis"]["verdict"] == "fault" and found["alarm_us"] > found["first_us"] + 15e6  # when it began
    assert "load was not logged" in lake_day(tmp_path, "none", healthy, baseline)["error"]
    silent = silent_sensor()
    found = lake_day(tmp_path, "silent", silent, baseline, load=pa.array(silent.channels["load"], from_pandas=True))
    assert found["diagnosis"]["verdict"] == "undetermined" and found["alarm_us"] is None
    assert Baselines.from_source(baseline, 1, 60.0).day_monitor("press").baseline.logged_covariates == ("load",)


def test_rows_keep_their_channels_packed_sorted_and_joined() -> None:
    t = np.array([3, 1, 2])
    rows = Rows(t, *np.arange(9.0).reshape(3, 3), {"oil_temperature": np.array([30.0, 10.0, math.nan])})
    for one in (rows, replace(rows, channels={})):
        again = Rows.unpack(one.pack()).sort_by_time()
        assert again.t_us.tolist() == [1, 2, 3] and again.y.tolist() == [7.0, 8.0, 6.0]
        assert set(again.channels) == set(one.channels)
        assert len(Rows.concatenate([Rows.empty(), one, one[:0], one])) == 6
    without = Rows.concatenate([replace(rows, channels={}), rows])  # a file has the column, and another one has not
    np.testing.assert_array_equal(without.channels["oil_temperature"], [*[math.nan] * 3, 30.0, 10.0, math.nan])
    np.testing.assert_array_equal(Rows.unpack(rows.pack()).channels["oil_temperature"], [30.0, 10.0, math.nan])
