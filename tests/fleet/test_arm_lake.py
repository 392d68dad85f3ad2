"""A lake of arms: which joint of which arm, and what cannot be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from arm_halls import FRICTION, ONSET_S, SIZE, write_arm
from commands import run

from servoscope.arm.simulation import simulate_arm
from servoscope.fleet import Lake, Plan
from servoscope.fleet import run as run_fleet
from servoscope.fleet.rows import MICRO, Rows
from servoscope.fleet.tasks import local
from servoscope.fleet.window_day import cut_windows

pytestmark = pytest.mark.slow

BEGAN = 1_798_000_000.0  # 2026-12-23T04:26:40Z


@pytest.fixture(scope="module")
def lake(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A healthy arm, one whose friction grows, and one that lacks a column."""
    folder = write_arm(tmp_path_factory.mktemp("lake"))
    worn = np.genfromtxt(folder / "run.csv", delimiter=",", names=True)
    logs = {
        "sound": simulate_arm(41, 30.0),
        "worn": {name: worn[name] for name in worn.dtype.names or ()},
        "torn": {name: column for name, column in simulate_arm(42, 10.0).items() if name != "i3"},
    }
    for asset, log in logs.items():
        path = folder / "lake" / f"asset={asset}" / "day=2026-12-23" / "part-0.parquet"
        path.parent.mkdir(parents=True)
        pq.write_table(pa.table({**log, "t": BEGAN + log["t"]}), path)
    return folder


def test_the_joint_of_the_arm_is_named(lake: Path) -> None:
    plan = Plan(lake=Lake.open(str(lake / "lake")), output=lake / "out", baselines=lake / "arm.json", window_s=30.0)
    found = run_fleet(plan, local(1))
    by_name = {asset.asset: asset for asset in found.assets}
    assert {name: asset.state for name, asset in by_name.items()} == {
        "worn": "fault",
        "sound": "healthy",
        "torn": "failed",
    }
    worn = by_name["worn"]
    assert worn.fault == FRICTION and worn.interval is not None and worn.interval[0] < SIZE < worn.interval[1]
    assert worn.since_us == pytest.approx((BEGAN + ONSET_S) * MICRO, abs=2 * MICRO)
    assert "since 2026-12-23 04:27:2" in worn.said and worn.probability > 0.9
    ((_, _, why),) = found.failed
    assert "elbow.torque" in why


def test_what_a_lake_of_arms_cannot_be_is_refused_in_one_line(lake: Path) -> None:
    common = "fleet", str(lake / "lake"), "-o", str(lake / "refused")
    (lake / "arm.toml").write_text('kind = "arm"\nurdf = "x"\nsample_rate = 100.0\n')
    learned = run(*common, "--loop", lake / "arm.toml")
    assert learned.code == 1 and "describes a machine of kind 'arm'" in learned.err and learned.err.count("\n") == 1
    named = run(*common, "--baselines", lake / "arm.json", "--columns", "r=q1, u=i1, y=q1", "--jobs", 1)
    assert "--columns: leave out, the loop file of kind 'arm' names its columns" in " ".join(
        (named.out + named.err).split()
    )


def test_windows_follow_each_other_whatever_the_blocks_are() -> None:
    def rows(first: int, count: int) -> Rows:
        t_us = np.arange(first, first + count) * 1_000_000
        return Rows(t_us, *np.zeros((3, count)))

    for blocks in ([rows(0, 25)], [rows(0, 3), rows(3, 20), rows(23, 2)]):
        assert [(len(one), int(one.t_us[0])) for one in cut_windows(blocks, 10_000_000)] == [(10, 0), (10, 10_000_000)]
    assert [len(one) for one in cut_windows([rows(0, 4)], 10_000_000)] == [4]
    assert [len(one) for one in cut_windows([rows(0, 17)], 10_000_000)] == [10, 7]
