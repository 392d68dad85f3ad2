"""The compiled chain against its slow double, and what lets a monitor be split, saved, resumed and multiplied."""

from __future__ import annotations

import functools
import itertools
from typing import Any

import naive
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from servoscope.baseline.baseline import Baseline
from servoscope.core.errors import BaselineError, RecordingError
from servoscope.detection.trace import Trace
from servoscope.diagnosis.monitor import Monitor
from servoscope.estimation.pipeline import Estimates, Pipeline, Tuning
from servoscope.estimation.recursion import EvaluationConstants
from servoscope.fit.tuning import fit_tuning
from servoscope.learning.learn import learn_baseline
from servoscope.models.loop import Loop
from servoscope.signals import Recording
from servoscope.simulation import reference, simulate, simulate_response

Signals = tuple[naive.Array, naive.Array, naive.Array, npt.NDArray[np.bool_]]
AXIS = {"kind": "polynomial", "order": 2, "coefficients": {"viscous_friction": 200.0, "inertia": 90.0}}


def recorded(loop: Loop, kind: str, seconds: float, seed: int) -> Recording:
    return simulate(loop, reference(kind, seconds, loop.sample_rate), seed=seed)[0]


def tuned(loop: Loop, kind: str) -> Tuning:
    pipeline, healthy = Pipeline.of(loop), recorded(loop, kind, 20.0, 1)
    g = pipeline.regression(healthy.r, healthy.u, healthy.y, healthy.restart)
    return fit_tuning(pipeline, [g]).tuning


def estimate(pipeline: Pipeline, tuning: Tuning, signals: Signals) -> Estimates:
    r, u, y, restart = signals
    N = len(r)
    t = np.arange(N) / pipeline.loop.sample_rate
    recording = Recording(
        t, r, u, y, restart, name="x", sample_rate=pipeline.loop.sample_rate, run=np.zeros(N, dtype=np.int32)
    )
    return pipeline.estimate(tuning, recording)


def broken(loop: Loop, kind: str, samples: int) -> Signals:
    """Return a recording with missing values, gaps, and an actuator that moves 10 % easier than the healthy one."""
    recording = recorded(loop, kind, samples / loop.sample_rate, 2)
    r, u, y, restart = recording.r.copy(), 0.9 * recording.u, recording.y.copy(), recording.restart.copy()
    u[100], y[101], r[300:310], y[399:402] = np.nan, np.nan, np.nan, np.inf
    restart[[200, 205, 310, 500]] = True
    return r, u, y, restart


def slow(pipeline: Pipeline, tuning: Tuning, signals: Signals) -> naive.Chain:
    """Do all that `Pipeline.estimate` does, from definitions."""
    loop, c = pipeline.loop, pipeline.constants(tuning, steady=False)
    r, u, y, restart = signals
    rate, cutoff = loop.sample_rate, loop.monitor.cutoff or loop.sample_rate / 10.0
    order, n = max(loop.plant.powers) + 1, len(loop.plant.powers)
    eta, phi, z = np.zeros(len(r)), np.zeros((len(r), n)), np.zeros((len(r), n))
    resting = np.zeros(len(r), dtype=bool)
    for begin, end in naive.stretches(r, u, y, restart):
        part = slice(begin, end)
        if end - begin < 2:
            continue
        speed = naive.svf(y[part], 1, min(50.0, rate / 4.0), 2, rate, "foh")
        resting[part] = (np.abs(speed) <= loop.monitor.rest_speed) & (loop.monitor.update_when == "moving")
        eta[part] = naive.svf(u[part], 0, cutoff, order, rate, loop.hold)
        y_a = y[part]
        if loop.monitor.estimator == "iv-akf":
            y_a = r[begin] + simulate_response(loop, r[part] - r[begin])[1]
        for i, power in enumerate(loop.plant.powers):
            phi[part, i] = naive.svf(y[part], power, cutoff, order, rate, "foh") / tuning.scale[i]
            z[part, i] = naive.svf(y_a, power, cutoff, order, rate, "foh") / tuning.scale[i]
    usable = naive.usable(r, u, y, restart, c.wait, resting)
    turn = (np.arange(len(r)) + 1) % c.stride == 0
    update = naive.UPDATES[loop.monitor.estimator]
    return naive.chain(
        update, eta, phi, z, usable & turn, usable & ~turn,
        c.theta, c.P_d, c.P_d, tuning.R, tuning.noise.a, tuning.noise.b, tuning.noise.variance, c.memory,
    )  # fmt: skip


CHAINS: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "akf": ({}, {}, "multisine"),
    "iv-akf": ({}, {"estimator": "iv-akf"}, "multisine"),
    "updates at every fourth sample": ({"sample_rate": 400.0}, {"cutoff": 10.0}, "multisine"),
    "held at rest": (
        {"plant": AXIS, "controller": {"kind": "pi", "k_p": 4000.0, "k_i": 10.0}},
        {"update_when": "moving", "rest_speed": 0.005},
        "trapezoid",
    ),
}


@pytest.mark.parametrize("case", CHAINS)
def test_whole_chain_equals_its_slow_double(rig: dict[str, Any], case: str) -> None:
    changes, monitor, kind = CHAINS[case]
    rate = changes.get("sample_rate", 100.0)
    loop = Loop.from_dict(rig | changes | {"monitor": {"evaluation_rate": rate, "memory": 2.0} | monitor})
    pipeline, tuning = Pipeline.of(loop), tuned(loop, kind)
    signals = broken(loop, kind, 900)
    ours, theirs = estimate(pipeline, tuning, signals), slow(pipeline, tuning, signals)
    s = tuning.scale
    assert ours.updates[-1] > (100 if pipeline.stride == 1 else 40)
    assert np.array_equal(ours.updates, theirs.updates)
    assert ours.theta * s == pytest.approx(theirs.theta, rel=1e-6, abs=1e-8 * np.abs(theirs.theta).max())
    for mine, other in (
        (ours.S * np.outer(s, s), theirs.S),
        (ours.Psi * s[:, None] / s, theirs.Psi),
        (ours.power * tuning.noise.gamma[0], theirs.power),
    ):
        # the noise's autocovariances are good to about 5e-6 where it is nearly a polynomial in time
        assert np.abs(mine - other).max() < 5e-6 * np.abs(other).max()


class TestGaps:
    @pytest.fixture
    def pipeline(self, rig: dict[str, Any]) -> Pipeline:
        return Pipeline.of(Loop.from_dict(rig | {"monitor": {"evaluation_rate": 100.0}}))

    def estimates(self, pipeline: Pipeline, change: Any) -> Estimates:
        recording = recorded(pipeline.loop, "multisine", 5.0, 2)
        signals = recording.r.copy(), recording.u.copy(), recording.y.copy(), recording.restart.copy()
        change(*signals)
        return estimate(pipeline, tuned(pipeline.loop, "multisine"), signals)

    def test_waits_after_the_start(self, pipeline: Pipeline) -> None:
        e = self.estimates(pipeline, lambda *_: None)
        assert np.array_equal(e.updates, np.maximum(np.arange(500) + 1 - pipeline.bank.wait, 0))

    def test_a_gap_waits(self, pipeline: Pipeline) -> None:
        def gap(r: naive.Array, u: naive.Array, y: naive.Array, restart: npt.NDArray[np.bool_]) -> None:
            restart[200] = True

        e, wait = self.estimates(pipeline, gap), pipeline.bank.wait
        assert np.ptp(e.updates[199 : 200 + wait]) == 0.0
        assert np.array_equal(e.theta[199 : 200 + wait], np.tile(e.theta[199], (wait + 1, 1)))
        assert e.updates[200 + wait] == e.updates[199] + 1

    @pytest.mark.parametrize("channel", [0, 1, 2])
    def test_a_missing_value_holds_and_rearms(self, pipeline: Pipeline, channel: int) -> None:
        def miss(*signals: Any) -> None:
            signals[channel][200:203] = np.nan

        e, wait = self.estimates(pipeline, miss), pipeline.bank.wait
        held = slice(199, 203 + wait)
        for values in (e.theta, e.S, e.Psi, e.power, e.updates):
            assert np.array_equal(values[held], np.broadcast_to(values[199], values[held].shape))
        assert e.updates[203 + wait] == e.updates[199] + 1
        assert np.all(np.isfinite(e.theta))

    def test_what_came_before_a_gap_leaves_no_trace_in_the_filters(self, pipeline: Pipeline) -> None:
        def other_past(r: naive.Array, u: naive.Array, y: naive.Array, restart: npt.NDArray[np.bool_]) -> None:
            for signal in (r, u, y):
                signal[:200] = 1e3
            restart[200] = True

        recording = recorded(pipeline.loop, "multisine", 5.0, 2)
        signals = [recording.r.copy(), recording.u.copy(), recording.y.copy(), recording.restart.copy()]
        other_past(*signals)
        g = pipeline.regression(*signals)
        fresh = pipeline.regression(recording.r[200:], recording.u[200:], recording.y[200:], recording.restart[:300])
        assert np.array_equal(g.eta[200:], fresh.eta) and np.array_equal(g.phi[200:], fresh.phi)


NOWHERE = EvaluationConstants(np.eye(4), np.zeros(4), np.zeros((2, 4)), 100.0)  # of no baseline, at one frequency

_LEARNED: dict[int, Baseline] = {}


def learned(rig: dict[str, Any], seed: int) -> Baseline:
    if seed not in _LEARNED:
        loop = Loop.from_dict(rig)
        _LEARNED[seed] = learn_baseline(loop, [recorded(loop, "multisine", 20.0, seed)])
    return _LEARNED[seed]


@functools.cache
def _signals(seed: int) -> Signals:
    return broken(next(iter(_LEARNED.values())).loop, "multisine", 607)


def columns(trace: Trace) -> dict[str, npt.NDArray[Any]]:
    return {
        "t": trace.t, "theta": trace.theta, "covariance": trace.covariance, "expected": trace.expected,
        "statistic": trace.statistic, "H": trace.ifrf.H, "covariance of H": trace.ifrf.covariance,
        "level": trace.level, "crossed": trace.crossed,
        "ready": trace.ready,
    }  # fmt: skip


def same(parts: list[Trace], whole: Trace, axis: int = 0) -> None:
    """Check that traces laid end to end are the other one to the last bit."""
    joined = [columns(part) for part in parts]
    for name, values in columns(whole).items():
        together = np.concatenate([part[name] for part in joined], axis=axis if name != "t" else 0)
        assert np.array_equal(together, values, equal_nan=True), name


class TestMonitor:
    @pytest.fixture
    def baseline(self, rig: dict[str, Any]) -> Baseline:
        return learned(rig, 1)

    @settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(cuts=st.lists(st.integers(0, 607), max_size=6), data=st.data())
    def test_split_and_resumed_anywhere(self, baseline: Baseline, cuts: list[int], data: st.DataObject) -> None:
        signals, monitor = _signals(2), Monitor(baseline)
        whole_state, whole = monitor.run(monitor.init(), *signals)
        state, parts = monitor.init(), []
        edges = [0, *sorted(cuts), 607]
        for begin, end in itertools.pairwise(edges):
            state, trace = monitor.run(state, *(signal[begin:end] for signal in signals))
            parts.append(trace)
            if data.draw(st.booleans()):
                monitor, state = Monitor(baseline), np.frombuffer(state.tobytes(), dtype=np.float64)
        assert np.array_equal(state, whole_state)
        same(parts, whole)

    def test_sample_by_sample_equals_a_block(self, baseline: Baseline) -> None:
        r, u, y, restart = _signals(2)
        restart[1:] &= ~np.isfinite(r + u + y)[1:]  # `step` knows of gaps through missing values alone
        monitor = Monitor(baseline)
        state, one_by_one = monitor.init(), []
        for k in range(len(r)):
            if monitor.step(state, r[k], u[k], y[k]):
                one_by_one.append(monitor.latest(state))
        block_state, whole = monitor.run(monitor.init(), r, u, y, restart)
        assert np.array_equal(state, block_state)
        assert len(one_by_one) == 60
        same(one_by_one, whole)

    def test_a_fleet_is_its_assets(self, rig: dict[str, Any]) -> None:
        baselines = [learned(rig, seed) for seed in (1, 4)]
        fleet = Monitor(baselines)
        loop = baselines[0].loop
        both = [broken(loop, "multisine", 607), broken(loop, "profile", 607)]
        stacked = [np.array([signals[i] for signals in both]) for i in range(4)]
        state, trace = fleet.run(fleet.init(), *stacked)
        for i, (baseline, signals) in enumerate(zip(baselines, both, strict=True)):
            alone = Monitor(baseline)
            alone_state, alone_trace = alone.run(alone.init(), *signals)
            assert np.array_equal(state[i], alone_state)
            for name, values in columns(alone_trace).items():
                mine = columns(trace)[name] if name == "t" else columns(trace)[name][i]
                assert np.array_equal(mine, values, equal_nan=True), name

    def test_the_old_state_and_the_inputs_stay_valid(self, baseline: Baseline) -> None:
        monitor, signals = Monitor(baseline), _signals(2)
        start = monitor.init()
        kept, inputs = start.copy(), [signal.copy() for signal in signals]
        first, again = (monitor.run(start, *signals) for _ in range(2))
        assert np.array_equal(start, kept) and not np.array_equal(first[0], start)
        assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(signals, inputs, strict=True))
        assert np.array_equal(first[0], again[0])
        same([first[1]], again[1])

    def test_missing_samples_hold_theta_and_P(self, baseline: Baseline) -> None:
        monitor, signals = Monitor(baseline), _signals(2)
        ((_, recursion),) = monitor._groups
        state, _ = monitor.run(monitor.init(), *(signal[:90] for signal in signals))
        later, trace = monitor.run(state, *np.full((3, 200), np.nan))
        for name in ("theta", "S"):
            assert np.array_equal(*(recursion.named(row[None])[name] for row in (later, state))), name
        assert len(trace.t) == 20 and np.ptp(trace.theta, axis=0).max() == 0.0

    def test_refusals(self, baseline: Baseline, rig: dict[str, Any]) -> None:
        monitor = Monitor(baseline)
        with pytest.raises(RecordingError, match="same shape"):
            monitor.run(monitor.init(), np.zeros(5), np.zeros(5), np.zeros(4))
        with pytest.raises(RecordingError, match="restart"):
            monitor.run(monitor.init(), np.zeros(5), np.zeros(5), np.zeros(5), np.zeros(4, dtype=bool))
        with pytest.raises(RecordingError, match="state"):
            monitor.run(monitor.init()[:-1], np.zeros(5), np.zeros(5), np.zeros(5))
        with pytest.raises(BaselineError, match="at least one"):
            Monitor([])
        fields = baseline.model_dump(by_alias=True)
        monitor_settings = fields["loop"].get("monitor", {}) | {"evaluation_rate": 5.0}
        other = Baseline.model_validate(fields | {"loop": fields["loop"] | {"monitor": monitor_settings}})
        with pytest.raises(BaselineError, match="one monitor for each kind of loop"):
            Monitor([baseline, other])
