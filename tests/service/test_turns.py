"""Assets that are followed together: as if each were alone, and as if every state had been stored."""

from __future__ import annotations

import gc
import random
import time
import weakref
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import halls
import numpy as np
import pytest
from halls import BEGAN, POLICY, RESULTS, asked, hall
from prometheus_client.parser import text_string_to_metric_families

from servoscope.core.errors import AlarmError
from servoscope.diagnosis.monitor import Monitor
from servoscope.learning.learn import nominal_baseline
from servoscope.models.loop import Loop
from servoscope.service import service as service_module
from servoscope.service import writer
from servoscope.service.alarms import LifecycleEvent, OperatorCommand
from servoscope.service.assets.asset import Asset
from servoscope.service.assets.checkpoint import pack_state, unpack_state
from servoscope.service.assets.groups import AssetGroups, BlockResult
from servoscope.service.assets.reception import RECEPTION_OK, Reception
from servoscope.service.assets.records import StepResult
from servoscope.service.build import build_components
from servoscope.service.config import ServiceFile
from servoscope.service.metrics import ServiceMetrics
from servoscope.service.service import Service
from servoscope.service.sources.block import Block


@pytest.fixture(scope="module")
def monitors() -> list[Monitor]:
    """Two baselines of one structure, and one that stands alone."""
    content = Loop.load(halls.LOOP).to_dict()
    slow = Loop.from_dict(content | {"monitor": content["monitor"] | {"evaluation_rate": 2.0}})
    leaky = Loop.from_dict(content | {"plant": content["plant"] | {"C_ie": 7e-12}})
    return [Monitor(one) for one in (halls.baseline(), *map(nominal_baseline, (leaky, slow)))]


def streams() -> dict[str, list[Block]]:
    """Blocks of six assets: in step, seven samples ahead, in other lengths, with gaps, NaN, disorder and a leak."""
    found = {}
    for i, lengths in enumerate(((50,), (50,), (7, 50, 50, 50), (50, 30, 20), (50,), (50,))):
        x, blocks, k = halls.recorded(i + 1, *([halls.LEAK] if i == 1 else []), seconds=45.0), list[Block](), 0
        while k < 4400:
            n = lengths[len(blocks) % len(lengths)] if i != 2 or not blocks else 50
            n = 7 if i == 2 and not blocks else n
            rows = slice(k, k + n)
            t = BEGAN + np.arange(k, k + n) / 100.0
            blocks.append(Block(f"asset{i}", len(blocks), t, x.r[rows], x.u[rows], x.y[rows].copy()))
            k += n
        found[f"asset{i}"] = blocks
    found["asset3"] = [one for one in found["asset3"] if one.sequence not in (20, 21)]
    found["asset4"][30].y[10:20] = np.nan
    turned = found["asset4"][40]
    found["asset4"][40] = replace(turned, **{name: getattr(turned, name)[::-1] for name in "truy"})
    for name in ("asset0", "asset1"):  # as sources make them whose messages have a row per moment
        rows = (np.asfortranarray(one.signals) for one in found[name])
        found[name] = [Block.from_signals(name, i, signals) for i, signals in enumerate(rows)]
    return found


def assets(monitors: list[Monitor]) -> dict[str, Asset]:
    """Return them: the first, second and fourth share a baseline, the last has a structure of its own."""
    kinds = [0, 0, 1, 0, 1, 2]
    return {f"asset{i}": Asset(f"asset{i}", monitors[k].baselines[0], monitors[k], POLICY) for i, k in enumerate(kinds)}


def test_assets_of_one_structure_go_together_to_the_bits_that_each_has_alone(monitors: list[Monitor]) -> None:
    assert monitors[0].lane_key == monitors[1].lane_key != monitors[2].lane_key
    alone, together, chance = assets(monitors), assets(monitors), random.Random(1)
    groups, expected, found = AssetGroups(together), dict[str, list[Any]](), dict[str, list[Any]]()
    waiting = {name: list(blocks) for name, blocks in streams().items()}
    for name, blocks in waiting.items():
        expected[name] = [row for block in blocks for row in alone[name].process(block).rows]
    assert sum(row.table == "residuals" for row in expected["asset1"]) > 10
    assert any(row.table == "transitions" for row in expected["asset1"])  # its leak is alarmed
    assert len({row.values["t"] for row in expected["asset0"] if row.table == "sizes"}) == 2
    while any(waiting.values()):
        turn = [blocks.pop(0) for blocks in waiting.values() for _ in range(min(chance.randrange(4), len(blocks)))]
        for name, rows in halls.block_rows(groups.process(turn)):
            found.setdefault(name, []).extend(rows)
    assert found == expected
    for name, asset in alone.items():
        other = together[name]
        assert asset.state is not None and other.state is not None
        assert pack_state(other.state) == pack_state(asset.state), name
        assert other.status(other.state) == asset.status(asset.state)


def disturb(blocks: list[Block], chance: random.Random) -> list[Block]:
    """Return the blocks of an asset with what may happen to them on their way."""
    found = list[Block]()
    for one in blocks:
        way = chance.choices(["sound", "lost", "twice", "late", "early", "turned", "torn", "still"], [150] + [1] * 7)[0]
        if way == "turned":
            one = replace(one, **{name: getattr(one, name)[::-1] for name in "truy"})
        elif way == "torn":
            one = replace(one, y=np.where(np.arange(one.t.size) % 7 == 3, np.nan, one.y))
        elif way == "still":
            one = replace(one, y=np.zeros(one.t.size), u=np.zeros(one.t.size))
        early = [replace(one, t=one.t + 3600.0), one]
        more = {"lost": [], "twice": [one, one], "late": [one, *found[-2:-1]], "early": early}
        found += more.get(way, [one])
    return found


def interfere(asset: Asset, kind: str) -> StepResult:
    """Do what is done to an asset between two blocks."""
    if kind == "silence":
        return asset.advance_time(20.0)
    if kind == "shelve":
        try:
            return asset.execute("fault", OperatorCommand(LifecycleEvent.SHELVE, "ann", until=asset.t + 5.0))
        except AlarmError:  # it is shelved
            pass
    if kind == "slow":
        asset.reception = Reception("slow", "u comes too slowly")
    return StepResult([], [])


@pytest.mark.parametrize("seed", range(2))
def test_whatever_happens_to_some_assets_all_come_to_what_they_come_to_alone(
    monitors: list[Monitor], seed: int
) -> None:
    chance, alone, together = random.Random(seed), assets(monitors), assets(monitors)
    groups, latest, quiet, behind = AssetGroups(together), BEGAN + 100.0, 0, 0
    waiting = {name: disturb(blocks, chance) for name, blocks in streams().items()}
    expected, found = ({name: list[Any]() for name in alone} for _ in range(2))
    saved = dict[str, bytes]()
    while any(waiting.values()):
        turn = [blocks.pop(0) for blocks in waiting.values() for _ in range(min(chance.randrange(3), len(blocks)))]
        for one in turn:
            expected[one.asset] += alone[one.asset].process(one, latest).rows
            alone[one.asset].reception = RECEPTION_OK
        changed = set()
        for result in groups.process(turn, latest):
            for name, rows in halls.block_rows([result]):
                found[name] += rows
            if isinstance(result, BlockResult):
                assert isinstance(result.result, StepResult)
                changed |= set() if result.result.repeatable else {result.block.asset}
                together[result.block.asset].reception = RECEPTION_OK
            else:
                quiet += len(result.blocks)
        name, kind = chance.choice(list(together)), chance.choice(["silence", "shelve", "slow", *["nothing"] * 20])
        if together[name].heard and kind != "nothing":
            expected[name] += interfere(alone[name], kind).rows
            found[name] += interfere(together[name], kind).rows
            changed.add(name)
        saved |= {each: pack_state(state) for each in changed if (state := together[each].state) is not None}
        if chance.random() < 0.3 and name in saved:  # killed: it goes on from its checkpoint and what came since
            killed, reception = together[name], together[name].reception
            together[name] = Asset(name, killed.machine, killed.monitor, POLICY)
            stored = [halls.stored_block(name, one) for one in found[name] if one.table == "recent"]
            groups = AssetGroups(together)
            left = together[name].resume(unpack_state(saved[name], name), stored[-80:])
            behind += len(left)
            again = [row for _, rows in halls.block_rows(groups.process(left)) for row in rows]
            assert all(row in found[name] for row in again)  # nothing that was not stored with these blocks
            together[name].reception = reception
    assert found == expected
    assert quiet > 100 and behind > 5
    for name, asset in alone.items():
        other = together[name]
        assert asset.state is not None and other.state is not None
        assert pack_state(other.state) == pack_state(asset.state), name
        assert other.status(other.state) == asset.status(asset.state)


@pytest.mark.slow
def test_states_that_waited_are_computed_again_after_a_kill(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    halls.files(tmp_path)

    def service(name: str) -> Service:
        config = hall(tmp_path, name)
        config.write_text(config.read_text().replace("commit_every_s = 0.01", "commit_every_s = 0.0"))
        settings = ServiceFile.load(config)
        return Service(settings, build_components(settings))

    service("whole").run()
    monkeypatch.setattr(writer, "MIN_CHECKPOINTS", 0)  # only what cannot wait is written before the end
    monkeypatch.setattr(writer, "CHECKPOINT_SHARE", 10**9)
    monkeypatch.setattr(service_module, "MAX_BLOCKS_PER_POLL", 3)
    chance, behind, config = random.Random(5), 0, tmp_path / "cut.toml"
    for _ in range(6):
        killed = service("cut")
        monkeypatch.setattr(killed, "_commit_all", lambda: None)  # what was not committed is lost
        turns, turn = iter(range(chance.randrange(1, 60))), killed._run_once

        def run_once(one: Service = killed, left: Iterator[int] = turns, run: Any = turn) -> None:
            run()
            if next(left, None) is None:
                one.stop()

        monkeypatch.setattr(killed, "_run_once", run_once)
        killed.run()
        newest = dict(asked(config, "SELECT asset, max(sequence) FROM recent GROUP BY asset"))
        stored = dict(asked(config, "SELECT asset, sequence FROM checkpoints"))
        behind = max(behind, *(newest[name] - stored[name] for name in newest))
    assert behind > 1  # blocks that were acknowledged, without their states
    service("cut").run()
    whole, cut = (
        {table: asked(tmp_path / f"{name}.toml", query) for table, query in RESULTS.items()}
        for name in ("whole", "cut")
    )
    assert cut == whole


def test_rows_of_the_history_that_no_state_knows_keep_their_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a kill a setting is changed, or a new state begins: samples then lead to fewer rows than are stored."""
    halls.files(tmp_path)
    config = hall(tmp_path, "hall")
    monkeypatch.setattr(writer, "MIN_CHECKPOINTS", 0)  # only what cannot wait is written
    monkeypatch.setattr(writer, "CHECKPOINT_SHARE", 10**9)
    monkeypatch.setattr(service_module, "MAX_BLOCKS_PER_POLL", 3)
    killed = halls.service_of(config)
    for _ in range(40):
        killed._run_once()
        killed._commit()
    state = unpack_state(killed.store.checkpoints(["press"])["press"]["state"], "press")
    killed.store.close()
    ((last,),) = asked(config, "SELECT max(number) FROM residuals WHERE asset = 'press'")
    assert last > state.position.rows
    config.write_text(config.read_text().replace("residual_every_s = 2.0", "residual_every_s = 500.0"))
    for restarted in ([], ["press"]):
        found = build_components(ServiceFile.load(config), restarted)
        found.store.close()
        resumed = found.assets["press"].state
        assert resumed is not None and resumed.position.rows == last


class WatchedArray(np.ndarray):
    """Lets another one look each time that something was written into it."""

    def __setitem__(self, key: Any, value: Any) -> None:
        super().__setitem__(key, value)
        self.look()


def test_metrics_are_read_at_any_moment_of_a_turn(monitors: list[Monitor], monkeypatch: pytest.MonkeyPatch) -> None:
    """Their thread comes between any two steps: the newest evaluations may be of fewer assets than those before."""
    together = {f"asset{i}": Asset(f"asset{i}", monitors[0].baselines[0], monitors[0], POLICY) for i in range(3)}
    groups, blocks, texts = AssetGroups(together), streams()["asset0"], list[bytes]()
    writer_now = SimpleNamespace(unavailable_since=None, waiting=0, capacity=1)
    service = SimpleNamespace(
        assets=together, sources={}, troubles={"connection": {}}, layers=groups.layers, writer=writer_now
    )
    service.last_turn = time.monotonic()
    metrics, states = ServiceMetrics(service), groups._fleets[0].states
    states._evaluations = states._evaluations.view(WatchedArray)
    monkeypatch.setattr(WatchedArray, "look", lambda _: texts.append(metrics.render()), raising=False)
    for k, block in enumerate(blocks[:30]):
        awake = list(together)[1 if k % 3 == 2 else 0 :]  # the last asset is now the third, now the second of a turn
        turn = [replace(block, asset=name, sequence=int(groups._assets[name].heard) and k) for name in awake]
        list(groups.process(turn))
    assert len(texts) > 30
    text = metrics.render()
    assert b'servoscope_blocks_total{asset="asset2"} 30.0' in text
    (verdicts,) = (one for one in text_string_to_metric_families(text.decode()) if one.name == "servoscope_verdict")
    shown = {one.labels["asset"]: one.labels["verdict"] for one in verdicts.samples}
    assert shown == {name: one.status(one.state)["verdict"] for name, one in together.items() if one.state is not None}
    before = [weakref.ref(one) for one in states._evaluations if one is not None]
    for asset in together.values():
        asset.take_state()  # as of one that falls silent
    gc.collect()
    assert before and not any(one() for one in before)


def test_what_is_measured_now_is_gathered_into_turns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    halls.files(tmp_path)
    service = halls.service_of(hall(tmp_path, "hall"))
    source = service.sources["line"]
    assert source.next_block_s == 0.0
    service.last_turn, service._next_commit = time.monotonic() + 100.0, np.inf  # it has only just begun
    assert service._pause_s == 0.0  # a recording is replayed as fast as it can be
    monkeypatch.setattr(source, "clock_rate", 1.0)
    assert service._pause_s > 90.0
    service._is_behind, service.last_turn = True, time.monotonic()  # there is a turn's worth of blocks already
    assert service._pause_s == 0.0
    service.store.close()
