"""What a sample costs on its way through the service, by layer; and what the processor has."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from servoscope.baseline.baseline import Baseline
    from servoscope.signals import Recording

WARM_ASSETS = 16


def measure_layers(baseline: Baseline, recording: Recording, assets: int) -> dict[str, float]:
    """Return the processor time of a sample in each layer of a service [s]: blocks of a second, JSON, SQLite.

    A service in this process follows `assets` replays of the recording, as fast as it can; messages are decoded beside.
    """
    from servoscope.service.log import set_up_logging
    from servoscope.service.mqtt.payload import decode_block, encode_json
    from servoscope.service.sources.block import Block
    from servoscope.signals.writers import write_recording

    n = round(recording.sample_rate)
    signals = np.stack([recording.t, recording.r, recording.u, recording.y])[:, :n]
    messages, repeats = [encode_json(Block("axis", 0, *signals))] * assets, 20
    begin = time.thread_time()
    for _ in range(repeats):
        for message in messages:
            decode_block("axis", message)
    decode = (time.thread_time() - begin) / (repeats * len(messages) * n)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        baseline.save(folder / "baseline.json")
        write_recording(folder / "healthy.parquet", recording, baseline.loop.columns)
        set_up_logging("error")
        _follow_replays(folder / "warm", WARM_ASSETS)  # kernels of several assets compile
        spent = _follow_replays(folder / "all", assets)
    return {"decode": decode} | {layer: each / (assets * recording.samples) for layer, each in spent.items()}


def _follow_replays(folder: Path, assets: int) -> Mapping[str, float]:
    from servoscope.service.build import build_components
    from servoscope.service.config import ServiceFile
    from servoscope.service.service import Service

    axis = '[assets.axis{}]\nbaseline = "../baseline.json"\nsource = "line"\nfiles = ["../healthy.parquet"]'
    lines = ['name = "bench"\n[service]\nlisten = ""\nlog = "error"\n[sources.line]\nkind = "replay"\nspeed = 0.0']
    folder.mkdir()
    (folder / "bench.toml").write_text("\n".join([*lines, *map(axis.format, range(assets))]), encoding="utf-8")
    config = ServiceFile.load(folder / "bench.toml")
    service = Service(config, build_components(config))
    service.run()
    return service.layers.seconds


def vector_bits() -> int:
    """Return how wide the processor's vectors are, as far as servoscope uses them: 128, 256 (AVX2) or 512 (AVX-512)."""
    from llvmlite.binding import get_host_cpu_features

    features = get_host_cpu_features()
    return 512 if features.get("avx512f") else 256 if features.get("avx2") else 128
