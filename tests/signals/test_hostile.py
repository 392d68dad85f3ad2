"""Readers and decoders fed with broken input; an asset fed with what they let through: it finds back."""

from __future__ import annotations

from pathlib import Path

import halls
import numpy as np
import pytest
from hostile.feeding import broken_bounds, fed, markdown
from hostile.targets import targets

from servoscope.diagnosis.monitor import Monitor
from servoscope.service.alarms import AlarmSettings
from servoscope.service.assets.asset import Asset, AssetPolicy
from servoscope.service.assets.checkpoint import pack_state, unpack_state
from servoscope.service.config import DiagnosisSettings
from servoscope.service.sources.block import Block
from servoscope.signals.quality import QualitySettings
from servoscope.signals.readers.archives import ARCHIVES
from servoscope.signals.readers.formats import BUILT_IN

BEGAN, N = 1767225600.0, 50
LATEST = 253402300799.0


def hostile() -> dict[str, np.ndarray]:
    """Return t, r, u, y of one block per case, shape (4, N)."""
    t = BEGAN + 0.01 * np.arange(N)
    zero = np.zeros((3, N))
    return {
        "huge": np.vstack([t, np.full((3, N), 1e300)]),
        "largest": np.vstack([t, np.full((3, N), -np.finfo(float).max)]),
        "tiny": np.vstack([t, np.full((3, N), 5e-324)]),
        "no number": np.vstack([t, np.full((3, N), np.nan)]),
        "infinite": np.vstack([t, np.full((3, N), np.inf)]),
        "one moment": np.vstack([np.full(N, BEGAN), zero]),
        "backwards": np.vstack([t[::-1], zero]),
        "the year 9999": np.vstack([t - BEGAN + LATEST - 1.0, zero]),
        "the year 1970": np.vstack([t - BEGAN, zero]),
        "shuffled": np.vstack([np.random.default_rng(0).permutation(t), zero]),
        "everywhere": np.vstack([np.random.default_rng(1).uniform(0.0, LATEST, N), zero]),
    }


@pytest.fixture(scope="module")
def following() -> tuple[Monitor, AssetPolicy]:
    alarms = AlarmSettings.model_validate({})
    how = AssetPolicy(DiagnosisSettings(window_s=10.0, every_s=20.0), QualitySettings(), alarms, 2.0)
    return Monitor(halls.baseline()), how


@pytest.mark.parametrize("case", hostile())
@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning")  # of 1e300 squared
@pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")
def test_it_goes_on(case: str, following: tuple[Monitor, AssetPolicy]) -> None:
    asset, sound, number = Asset("press", halls.baseline(), *following), halls.recorded(1), 0

    def take(*signals: np.ndarray) -> None:
        nonlocal number
        asset.process(Block("press", number, *signals))
        number += 1
        assert asset.state is not None
        assert unpack_state(pack_state(asset.state), "press").position == asset.state.position
        asset.status(asset.state)

    def normal(begin: float, blocks: int) -> None:
        for k in range(blocks):
            rows = slice(N * k, N * (k + 1))
            take(begin + sound.t[rows], sound.r[rows], sound.u[rows], sound.y[rows])

    normal(BEGAN - 30.0, 40)
    take(*hostile()[case])
    normal(BEGAN + 1.0, 60)
    assert asset.state is not None
    assert asset.state.position.blocks == 101 and asset.state.examination.verdict != "fault"


@pytest.mark.filterwarnings("ignore")  # of libraries, about broken files
def test_what_is_broken_is_read_or_refused_and_nothing_else(tmp_path: Path) -> None:
    """The benchmark itself, short; its target list is that of all readers and decoders."""
    found = [fed(target, 66, seed=7) for target in targets(tmp_path)]
    assert {one["name"]: one["cases"] for one in found if one["other"] or one["badly told"]} == {}
    # time and memory are the benchmark's: this process has run other tests
    assert broken_bounds([one | {"slowest_s": 0.0, "peak_mb": 0} for one in found]) == []
    assert all(one["refused"] for one in found)
    fed_suffixes = {path.suffix for path in tmp_path.iterdir()}
    tried = {BUILT_IN[suffix] for suffix in fed_suffixes & set(BUILT_IN)}
    missing = sorted(
        {*(suffix for suffix, reader in BUILT_IN.items() if reader not in tried), *ARCHIVES} - fed_suffixes
    )
    assert not missing, f"readers without a target in benchmarks/hostile/targets.py: {missing}"
    assert "| CSV file | 66 |" in markdown({"targets": found, "machine": ""})
