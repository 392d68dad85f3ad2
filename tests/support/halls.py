"""Service files with real recordings behind them: a baseline, a healthy minute and one with a leak from 30 s on."""

from __future__ import annotations

import functools
import sqlite3
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from servoscope.baseline.baseline import Baseline
from servoscope.learning.learn import nominal_baseline
from servoscope.models.loop import Loop
from servoscope.service.assets.asset import AssetPolicy
from servoscope.service.assets.groups import BlockResult, QuietBlocks
from servoscope.service.assets.records import StepResult, TableRow
from servoscope.service.build import build_components
from servoscope.service.config import AlarmSettings, DiagnosisSettings, ServiceFile
from servoscope.service.service import Service
from servoscope.service.sources.block import Block
from servoscope.service.store import Store
from servoscope.service.store.bundles import restore_times
from servoscope.signals import Recording, writers
from servoscope.signals.quality import QualitySettings
from servoscope.simulation import FaultEvent, reference, simulate

LOOP = Path(__file__).parents[2] / "src/servoscope/simulation/reference-rig.toml"
BEGAN = 1767225580.0  # 2025-12-31T23:59:40Z: coefficients are stored in the middle of what is sent
POLICY = AssetPolicy(
    DiagnosisSettings(window_s=20.0, every_s=30.0), QualitySettings(), AlarmSettings.model_validate({}), 2.0
)
LEAK = FaultEvent.parse("C_ie=1.2@30")

# What has to be the same whatever has happened to the process: all rows, and all that the next block depends on.
RESULTS = {
    "residuals": "SELECT * FROM residuals ORDER BY asset, number",
    "diagnoses": "SELECT * FROM diagnoses ORDER BY asset, number",
    "transitions": "SELECT * FROM transitions ORDER BY asset, number",
    "recent": "SELECT * FROM recent ORDER BY asset, sequence",
    "states": "SELECT asset, sequence, state, status FROM checkpoints WHERE asset <> 'hall' ORDER BY asset",
}


def service_of(config: Path) -> Service:
    """Return the service of a service file, not yet running."""
    settings = ServiceFile.load(config)
    return Service(settings, build_components(settings))


@functools.cache
def baseline() -> Baseline:
    """Return what healthy looks like, from the rig's nominal parameters."""
    return nominal_baseline(Loop.load(LOOP))


@functools.cache
def recorded(seed: int, *faults: FaultEvent, seconds: float = 60.0) -> Recording:
    """Return a recording of the rig."""
    loop = Loop.load(LOOP)
    return simulate(loop, reference("multisine", seconds, loop.sample_rate), faults=faults, seed=seed)[0]


def files(folder: Path) -> None:
    """Put baseline.json, healthy.csv and leaky.csv into a folder."""
    folder.mkdir(exist_ok=True)
    baseline().save(folder / "baseline.json")
    writers.write_recording(folder / "healthy.csv", recorded(1))
    writers.write_recording(folder / "leaky.csv", recorded(2, LEAK))


def hall(folder: Path, name: str, *, speed: float = 0.0, store: str = "", more: str = "") -> Path:
    """Write a service file for two assets, one of which begins to leak, in a folder that has the `files`."""
    text = f"""
        name = "hall"
        [service]
        listen = ""
        commit_every_s = 0.01
        log = "error"
        [store]
        url = "{store or name + ".sqlite"}"
        residual_every_s = 2.0
        [diagnosis]
        window_s = 40.0
        every_s = 60.0
        [sources.line]
        kind = "replay"
        speed = {speed}
        block = 0.5
        start = 2026-01-01T00:00:00Z
        [assets.press]
        baseline = "baseline.json"
        source = "line"
        files = ["healthy.csv", "leaky.csv", "healthy.csv"]
        [assets.lift]
        baseline = "baseline.json"
        source = "line"
        files = ["healthy.csv", "healthy.csv", "healthy.csv"]
        {more}
    """
    path = folder / f"{name}.toml"
    path.write_text("\n".join(line.strip() for line in text.splitlines()), encoding="utf-8")
    return path


def block_rows(processed: Iterable[BlockResult | QuietBlocks]) -> Iterator[tuple[str, list[TableRow]]]:
    """Yield the rows to which each block has led, with its asset; those of quiet blocks as if they were alone."""
    for one in processed:
        if isinstance(one, QuietBlocks):
            for i, (asset, (number, *_, samples, regular)) in enumerate(zip(one.assets, one.packed, strict=True)):
                values = {"sequence": number, "samples": samples, "regular": regular}
                yield asset.name, [TableRow("recent", values), *(row for place, row in one.history if place == i)]
        else:
            assert isinstance(one.result, StepResult), one.result
            yield one.block.asset, one.result.rows


def stored_block(asset: str, row: TableRow) -> Block:
    """Return the block of an asset whose samples a row has."""
    samples = restore_times(row.values["samples"]) if row.values["regular"] else row.values["samples"]
    return Block.unpack(asset, row.values["sequence"], samples)


def asked(config: Path, query: str) -> list[Any]:
    """Return what a query finds in the SQLite store of a service file; its `recent` has all recent samples."""
    found = ServiceFile.load(config)
    path = found.folder / found.store.url
    connection = sqlite3.connect(path, timeout=10.0)
    try:
        if " recent" in query:
            connection.execute("CREATE TEMP TABLE recent (asset, sequence, samples)")  # in front of the stored one
            connection.executemany("INSERT INTO recent VALUES (?, ?, ?)", recent_rows(str(path)))
        return connection.execute(query).fetchall()
    finally:
        connection.close()


def recent_rows(url: str) -> list[Any]:
    """Return all recent samples of a store, block by block."""
    store = Store.open(url, lock_timeout_s=10.0)
    blocks = sorted(store.recent_samples_of(store.checkpoint_times()))
    store.close()
    return [(asset, *block) for asset, of_asset in blocks for block in of_asset]
