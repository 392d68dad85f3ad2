"""Baselines put in force while nobody follows the asset, and states that cannot be used: the others go on."""

from __future__ import annotations

import json
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path

import halls
import numpy as np
import pytest
import sqlalchemy as sa
from commands import one_line, run
from halls import asked

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.history import history_folder, restore_parent
from servoscope.baseline.records import Revision
from servoscope.core.errors import BaselineError
from servoscope.diagnosis.monitor import Monitor
from servoscope.service import baselines, renewal
from servoscope.service.assets.asset import Asset
from servoscope.service.config import ServiceFile
from servoscope.service.sources.block import Block
from servoscope.service.store import Store, tables
from servoscope.service.store.series import read_notes


def test_a_new_state_owes_the_rows_of_diagnoses_under_way_and_keeps_alarms_that_stand() -> None:
    monitor, leaky = Monitor(halls.baseline()), halls.recorded(2, halls.LEAK)
    asset, renewed_asset = (Asset("press", monitor.baselines[0], monitor, halls.POLICY) for _ in range(2))
    for k in range(120):
        rows = slice(50 * k, 50 * k + 50)
        t = halls.BEGAN + np.arange(6000)[rows] / 100.0
        asset.process(Block("press", k, t, leaky.r[rows], leaky.u[rows], leaky.y[rows]))
        if asset.pending_diagnoses and asset.take_state().alarms["fault"].sequence:
            break
    before = asset.take_state()
    (window,) = before.pending_diagnoses
    (owed,) = renewed_asset.begin(before.position, before)
    assert owed.table == "diagnoses" and owed.values["number"] == window.number
    assert owed.values["verdict"] == "undetermined" and "new state" in owed.values["summary"]
    after = renewed_asset.take_state()
    assert after.alarms["fault"].state == "unacknowledged" and not after.pending_diagnoses


def test_blocks_lost_before_one_that_is_ahead_of_the_clock_are_named() -> None:
    monitor, x = Monitor(halls.baseline()), halls.recorded(1)
    asset = Asset("press", monitor.baselines[0], monitor, halls.POLICY)
    t = halls.BEGAN + np.arange(50) / 100.0
    ahead = Block("press", 4, t + 7200.0, x.r[:50], x.u[:50], x.y[:50])
    asset.process(replace(ahead, sequence=0, t=t), halls.BEGAN + 60.0)
    result = asset.process(ahead, halls.BEGAN + 60.0)
    (row,) = result.rows
    assert result.refusal is not None and row.values["what"] == "blocks lost"
    assert row.values["document"] == {"blocks": 3, "after": [0, 0], "before": [0, 4]}
    assert asset.take_state().position.lost == 3
    assert not asset.process(replace(ahead, sequence=5), halls.BEGAN + 60.0).rows


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a service that has followed two assets to the end of their recordings, and was stopped."""
    folder = tmp_path_factory.mktemp("ended")
    halls.files(folder)
    path = halls.hall(folder, "hall")
    path.write_text(path.read_text().replace('"healthy.csv", "leaky.csv", "healthy.csv"', '"healthy.csv"'))
    path.write_text(path.read_text().replace('"healthy.csv", "healthy.csv", "healthy.csv"', '"healthy.csv"'))
    assert run("run", path).code == 0
    return folder


@pytest.fixture
def config(ended: Path, tmp_path: Path) -> Path:
    """The service file of a copy of it."""
    shutil.copytree(ended, tmp_path / "hall")
    return tmp_path / "hall" / "hall.toml"


def follow(config: Path, *words: str) -> None:
    """Let the service follow another recording of each asset, to its end."""
    text = (
        config.read_text()
        .replace("speed = 0.0", "speed = 30.0")
        .replace('["healthy.csv"', '["healthy.csv", "healthy.csv"')
    )
    config.write_text(text)
    assert run("run", config, *words).code == 0


def renewed(number: int = 2, mark: str = "a") -> Baseline:
    """Return a baseline in the place of number ``number - 1``, with a hash of its own."""
    revision = Revision(number=number, kind="healthy", who="ann", why="seal changed", parent=number - 1)
    return halls.baseline().model_copy(update={"hash": mark * 16, "revision": revision})


def put_in_force(config: Path, baseline: Baseline) -> None:
    settings, store = ServiceFile.load(config), Store.open("hall.sqlite", config.parent)
    try:
        stretch = replace(halls.recorded(1), name="press.parquet")
        renewal.put_in_force(settings, store, "press", baseline, stretch, halls.BEGAN)
    finally:
        store.close()


def alarms(config: Path) -> dict[str, dict[str, str]]:
    ((status,),) = asked(config, "SELECT status FROM checkpoints WHERE asset = 'hall'")
    return dict(json.loads(status)["alarms"])


def hashes(config: Path) -> dict[str, str]:
    rows = asked(config, "SELECT asset, status FROM checkpoints WHERE asset <> 'hall'")
    return {name: json.loads(status)["about"]["baseline"] for name, status in rows}


def test_what_was_relearned_while_the_service_was_stopped_is_taken_up(config: Path) -> None:
    put_in_force(config, renewed())
    put_in_force(config, renewed(3, "b"))  # its parent is not what the state belongs to, but that one's parent is
    follow(config)
    assert hashes(config) == {"press": "b" * 16, "lift": halls.baseline().hash}
    assert asked(config, "SELECT asset FROM audit WHERE what = 'began anew'") == [("press",)]
    assert asked(config, "SELECT outcome FROM commands") == [("done",), ("done",)]
    assert "left_out.press" not in alarms(config)
    settings, store = ServiceFile.load(config), Store.open("hall.sqlite", config.parent)
    restored = renewal.go_back(settings, store, "press", "ann", "not run in", halls.BEGAN)
    store.close()
    follow(config)
    assert hashes(config)["press"] == restored.hash == "a" * 16


def test_a_baseline_that_only_the_store_has_is_exported_by_the_service(
    config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(baselines, "export_baseline", lambda *_: None)  # killed before it has written the file
    put_in_force(config, renewed())
    monkeypatch.undo()
    own = config.parent / "baseline.press.json"
    assert not own.exists()
    follow(config)
    assert Baseline.load(own) == renewed() and [path.name for path in history_folder(own).glob("*.json")] == [
        "000001.json"
    ]
    assert asked(config, "SELECT document FROM commands") == [('{"why":"seal changed","accepted":true}',)]


def test_of_two_previews_the_second_is_refused_and_leaves_nothing(url: str, config: Path) -> None:
    config.write_text(config.read_text().replace("hall.sqlite", url))
    settings, store = ServiceFile.load(config), Store.open(url, config.parent, write=True)
    forks = [renewed(mark=mark) for mark in "ab"]
    baselines.announce_baseline(settings, store, "press", 1, forks[0], 1.0)
    for exported in (True, False):  # also before the first one's file is there
        if not exported:
            settings.relearned_file("press").unlink()
        with pytest.raises(BaselineError, match="another baseline was put in force"):
            baselines.announce_baseline(settings, store, "press", 1, forks[1], 2.0)
    assert len(read_notes(store, "press")) == len(store.pending_commands()) == 1
    assert store.fetch(sa.select(tables.audit.c.who)) == [{"who": "ann"}]
    store.close()


def test_an_asset_whose_state_fits_no_baseline_is_left_out_and_the_others_go_on(config: Path) -> None:
    foreign = halls.baseline().model_copy(update={"hash": "f" * 16})
    foreign.save(config.parent / "baseline.press.json")
    with sqlite3.connect(config.parent / "hall.sqlite") as store:
        ((before,),) = store.execute("SELECT state FROM checkpoints WHERE asset = 'press'").fetchall()
    follow(config)
    alarm = alarms(config)["left_out.press"]
    assert alarm["state"] == "unacknowledged" and "another baseline" in alarm["cause"]
    assert asked(config, "SELECT state FROM checkpoints WHERE asset = 'press'") == [(before,)]
    follow(config, "--anew", "press")
    assert alarms(config)["left_out.press"]["state"] == "returned_unacknowledged"
    assert hashes(config)["press"] == foreign.hash


def test_a_torn_own_file_of_a_relearned_asset_is_named(config: Path) -> None:
    put_in_force(config, renewed())
    for file in history_folder(config.parent / "baseline.press.json").glob("*.json"):
        file.write_text("{")
    follow(config)
    assert "000001.json" in alarms(config)["left_out.press"]["cause"]
    with pytest.raises(BaselineError, match=r"000001\.json"):
        restore_parent(config.parent / "baseline.press.json")
    one_line(run("run", config, "--anew", "crane"), "no such asset")
