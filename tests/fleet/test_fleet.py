"""A fleet: assets side by side, of own baselines and structures, in either precision, and what one of them costs."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servoscope.baseline.baseline import Baseline
from servoscope.core.errors import BaselineError
from servoscope.detection.trace import Trace
from servoscope.diagnosis.monitor import Monitor
from servoscope.estimation.kernel.buffers import BufferPool
from servoscope.estimation.recursion import LANE_COUNT
from servoscope.learning.learn import learn_baseline
from servoscope.models.loop import Loop
from servoscope.simulation import FaultEvent, reference, simulate

LOOP = Path(__file__).parents[2] / "src/servoscope/simulation/reference-rig.toml"
COLUMNS = ("theta", "covariance", "expected", "statistic", "level", "crossed", "ready")


def loop_of(name: str = "rig", **settings: Any) -> Loop:
    content = Loop.load(LOOP).to_dict() | {"name": name}
    monitor = content["monitor"] | settings.pop("monitor", {})
    return Loop.from_dict(content | settings | {"monitor": monitor})


@functools.cache
def learned(kind: str = "multisine", seed: int = 1, estimator: str = "akf") -> Baseline:
    loop = loop_of(monitor={"estimator": estimator})
    return learn_baseline(loop, [simulate(loop, reference(kind, 30.0, 100.0), seed=seed)[0]])


@functools.cache
def signals(assets: int, seconds: float = 20.0) -> tuple[np.ndarray[Any, Any], ...]:
    """Return r, u, y and restart of assets on their own ways: gaps, missing values, a leak in every third."""
    rows = []
    for seed in range(assets):
        faults = (FaultEvent("C_ie", 1.2, 10.0),) if seed % 3 == 0 else ()
        r = reference("multisine" if seed % 2 else "profile", seconds, 100.0)
        x = simulate(loop_of(), r, faults=faults, seed=seed + 50)[0]
        rows.append([x.r.copy(), x.u.copy(), x.y.copy(), x.restart.copy()])
        if seed % 4 == 1:
            rows[-1][1][700 + seed] = np.nan
            rows[-1][3][900 + seed] = True
    return tuple(np.array([row[i] for row in rows]) for i in range(4))


def same(whole: Trace, asset: int, alone: Trace) -> None:
    for name in COLUMNS:
        assert np.array_equal(getattr(whole, name)[asset], getattr(alone, name), equal_nan=True), name
    for mine, other in ((whole.ifrf, alone.ifrf), (whole.ifrf_expected, alone.ifrf_expected)):
        assert np.array_equal(mine.H[asset], other.H) and np.array_equal(mine.covariance[asset], other.covariance)


@pytest.mark.parametrize("own", [False, True], ids=["one baseline", "own baselines"])
def test_each_asset_of_a_fleet_is_itself_alone_to_the_last_bit(own: bool) -> None:
    count = LANE_COUNT["float64"] + 5  # a whole block of lanes, and one that is not full
    kinds = [learned(), learned("profile", 2)] if own else [learned()]
    assert all(baseline.thresholds.hypotheses for baseline in kinds)  # the sequential test is compared, too
    baselines = [kinds[i % len(kinds)] for i in range(count)]
    r, u, y, restart = signals(count)
    fleet = Monitor(baselines)
    first, one = fleet.run(fleet.init(), r[:, :1237], u[:, :1237], y[:, :1237], restart[:, :1237])
    state, two = fleet.run(first, r[:, 1237:], u[:, 1237:], y[:, 1237:], restart[:, 1237:])
    assert np.isfinite(two.crossed[::3, -1]).all()  # the leaks are found
    for i in (0, 1, 2, 5, count - 1):
        alone = Monitor(baselines[i])
        own_first, own_one = alone.run(alone.init(), r[i, :1237], u[i, :1237], y[i, :1237], restart[i, :1237])
        own_state, own_two = alone.run(own_first, r[i, 1237:], u[i, 1237:], y[i, 1237:], restart[i, 1237:])
        if not own:
            assert np.array_equal(state[i], own_state)
        same(one, i, own_one)
        same(two, i, own_two)


def test_many_samples_on_all_cores_are_the_same_as_a_few(monkeypatch: pytest.MonkeyPatch) -> None:
    from servoscope.estimation import recursion
    from servoscope.estimation.kernel import threads

    monkeypatch.setattr(recursion, "MIN_PARALLEL_SAMPLES", 1)
    r, u, y, restart = signals(LANE_COUNT["float64"] + 5)
    monitor = Monitor([learned()] * len(r))
    together = monitor.run(monitor.init(), r, u, y, restart)
    monkeypatch.setattr(threads, "core_count", lambda: 1)
    alone = monitor.run(monitor.init(), r, u, y, restart)
    assert np.array_equal(together[0], alone[0])
    assert np.array_equal(together[1].statistic, alone[1].statistic)


def test_loops_of_different_structure_are_followed_in_one_monitor() -> None:
    both = [learned(), learned(estimator="iv-akf"), learned(), learned(estimator="kf")]
    r, u, y, restart = signals(4)
    fleet = Monitor(both)
    state, trace = fleet.run(fleet.init(), r, u, y, restart)
    for i, baseline in enumerate(both):
        alone = Monitor(baseline)
        same(trace, i, alone.run(alone.init(), r[i], u[i], y[i], restart[i])[1])
    last = fleet.latest(state)
    assert np.array_equal(last.statistic[:, 0], trace.statistic[:, -1])


def test_what_cannot_be_followed_together_is_refused() -> None:
    slow = Baseline.model_validate(
        learned().model_dump(by_alias=True) | {"loop": loop_of(monitor={"evaluation_rate": 5.0}).to_dict()}
    )
    with pytest.raises(BaselineError, match="one monitor for each kind of loop"):
        Monitor([learned(), slow])


class TestSingle:
    """Single precision: what the documentation promises of it."""

    def test_its_error_is_far_below_the_noise(self) -> None:
        r, u, y, restart = signals(9)
        double, single = (Monitor([learned()] * 9, precision=p) for p in ("double", "single"))
        exact, near = (m.run(m.init(), r, u, y, restart)[1] for m in (double, single))
        spread = np.sqrt(np.diagonal(exact.covariance, axis1=-2, axis2=-1))
        assert (np.abs(near.theta - exact.theta) / spread).max() < 0.01  # standard deviations
        assert np.abs(np.sqrt(near.statistic) - np.sqrt(exact.statistic)).max() < 0.01
        assert np.abs(near.level - exact.level).max() < 0.005  # limits
        assert np.array_equal(near.exceeded, exact.exceeded)

    def test_it_stays_there_for_hours(self) -> None:
        """Ten minutes in one piece, driven on from its own state: the error does not grow."""
        x = [np.tile(signal[1:2], (1, 30)) for signal in signals(2)[:3]]
        double, single = (Monitor([learned()], precision=p) for p in ("double", "single"))
        exact, near = (m.run(m.init(), *x)[1] for m in (double, single))
        error = np.abs(np.sqrt(near.statistic) - np.sqrt(exact.statistic))[0]
        assert error[-1000:].max() < 2.0 * error[1000:2000].max() + 0.01

    def test_blocks_leave_the_same_bits(self) -> None:
        r, u, y, restart = signals(9)
        monitor = Monitor([learned()] * 9, precision="single")
        state, whole = monitor.run(monitor.init(), r, u, y, restart)
        split, parts = monitor.init(), []
        for cut in np.split(np.arange(r.shape[1]), [1, 99, 700, 705]):
            split, trace = monitor.run(split, r[:, cut], u[:, cut], y[:, cut], restart[:, cut])
            parts.append(trace.statistic)
        assert np.array_equal(state, split) and np.array_equal(whole.statistic, np.concatenate(parts, axis=1))


def test_memory_is_used_again_only_when_nobody_holds_it() -> None:
    memory, shape, kind = BufferPool(), (512, 512), np.dtype(np.float64)
    first = memory.empty(shape, kind)
    first[:] = 1.0
    view = first[3:, ::2].T
    del first
    second = memory.empty(shape, kind)
    second[:] = 2.0
    assert (view == 1.0).all()
    where = view.__array_interface__["data"][0] - 3 * 512 * 8
    del view
    assert memory.empty(shape, kind).__array_interface__["data"][0] == where


def test_the_state_of_an_asset_takes_no_more_than_a_kibibyte() -> None:
    monitor = Monitor([learned()])
    assert monitor.init().nbytes <= 1024


def test_a_step_allocates_nothing_that_stays() -> None:
    import tracemalloc

    monitor = Monitor(learned())
    state, (r, u, y, _) = monitor.init(), signals(2)
    row = list(zip(r[0].tolist(), u[0].tolist(), y[0].tolist(), strict=True))
    for sample in row[:100]:
        monitor.step(state, *sample)
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    for sample in row[100:1100]:
        monitor.step(state, *sample)
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert grown < 2000
