"""The sequential test: the compiled CUSUMs against a slow double, what raises an alarm and what must not, delays."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import naive
import numpy as np
import pytest
from scipy import signal

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.expectation import Expectation, reference_path, residual_noise_model
from servoscope.baseline.hypothesis import CusumHypothesis
from servoscope.baseline.threshold import SECONDS_PER_YEAR
from servoscope.detection.baseline_run import cusum_constants
from servoscope.detection.cusum_design import build_cusum_constants, choose_cusum_hypotheses
from servoscope.detection.statistic import apply_alarm_delays
from servoscope.detection.threshold_calibration import calibrate_thresholds
from servoscope.diagnosis.diagnose import diagnose_with_trace
from servoscope.diagnosis.monitor import Monitor
from servoscope.estimation.filter_bank import nominal_theta
from servoscope.estimation.kernel.cusum import LAGS, whitening_filter
from servoscope.estimation.noise_model import WhiteNoise
from servoscope.estimation.pipeline import Estimates, Pipeline
from servoscope.fit.tuning import fit_tuning
from servoscope.learning.learn import learn_baseline
from servoscope.models.loop import Loop
from servoscope.signals import Recording
from servoscope.simulation import FaultEvent, reference, simulate, simulate_response

NOISE = WhiteNoise(u_std=1e-4, y_std=float(np.sqrt(1e-7)))
LOOP = Path(__file__).parents[2] / "src/servoscope/simulation/reference-rig.toml"


def loop_of(**monitor: Any) -> Loop:
    settings = Loop.load(LOOP).to_dict()
    settings["monitor"] |= monitor
    return Loop.from_dict(settings)


def recorded(loop: Loop, seed: int, seconds: float = 60.0, kind: str = "multisine", *faults: FaultEvent) -> Recording:
    return simulate(loop, reference(kind, seconds, loop.sample_rate), faults=faults, seed=seed)[0]


@functools.cache
def learned(kind: str = "multisine", seed: int = 1, step: str = "evaluation") -> Baseline:
    """Return a baseline of one healthy minute with a budget of one false alarm a year."""
    loop = loop_of(false_alarms_per_year=1.0, sequential_step=step)
    return learn_baseline(loop, [recorded(loop, seed, kind=kind)])


def estimates(baseline: Baseline, recording: Recording) -> Estimates:
    pipeline = baseline.pipeline()
    return pipeline.estimate(baseline.tuning, recording, cusum_constants(baseline, pipeline))


class TestKernel:
    def shadow(self, pipeline: Pipeline, recording: Recording) -> tuple[naive.Array, naive.Array]:
        """Simulate the healthy loop without noise, in each stretch from its steady state at the first r."""
        loop, (r, u, y) = pipeline.loop, (recording.r, recording.u.copy(), recording.y.copy())
        hold = nominal_theta(loop, loop.plant)[0]
        for begin, end in naive.stretches(r, u, y, recording.restart):
            part, first = slice(begin, end), recording.r[begin]
            moved = simulate_response(loop, r[part] - first)
            u[part], y[part] = hold * first + moved[0], first + moved[1]
        g = pipeline.regression(r, u, y, recording.restart)
        return g.eta, g.phi

    @pytest.mark.parametrize("decides", ["update", "evaluation"])
    @pytest.mark.parametrize("rate", [100.0, 400.0], ids=["every sample", "every fourth sample"])
    def test_equals_its_slow_double(self, rig: dict[str, Any], rate: float, decides: str) -> None:
        loop = Loop.from_dict(rig | {"sample_rate": rate, "monitor": {"cutoff": 10.0, "sequential_step": decides}})
        pipeline, n = Pipeline.of(loop), 4
        g = pipeline.regression(*(getattr(recorded(loop, 1, 20.0), x) for x in ("r", "u", "y", "restart")))
        tuning = fit_tuning(pipeline, [g]).tuning
        # leaks, is repaired, leaks again; values are missing and a gap cuts in
        faults = [FaultEvent("C_ie", ratio, at) for ratio, at in ((1.5, 4.0), (1.0, 8.0), (0.7, 14.0))]
        recording = recorded(loop, 2, 20.0, "multisine", *faults)
        k = round(rate)
        recording.y[2 * k], recording.u[5 * k : 5 * k + 3], recording.restart[10 * k] = np.nan, np.nan, True
        rng = np.random.default_rng(0)
        step = np.array([nominal_theta(loop, loop.plant.with_ratios({"C_ie": x})) for x in (1.05, 1.5, 0.8)])
        step -= nominal_theta(loop, loop.plant)
        late = 1e-3 * step[:, -1:] * rng.standard_normal((3, LAGS))
        changes, limits = np.hstack([step, late]), np.array([20.0, 35.0, 15.0])
        chosen = [CusumHypothesis("C_ie", 1.0, tuple(change), 1.0, 0.0) for change in changes.tolist()]
        test = build_cusum_constants(pipeline, loop.plant, NOISE, tuning.scale, chosen, 1e-6)
        assert test is not None
        ours = pipeline.estimate(tuning, recording, test._replace(limits=limits))

        r, u, y, restart = recording.r, recording.u, recording.y, recording.restart
        g = pipeline.regression(r, u, y, restart)
        eta, phi = self.shadow(pipeline, recording)
        v = g.eta - eta - (g.phi - phi) @ nominal_theta(loop, loop.plant)
        model = residual_noise_model(pipeline, loop.plant, NOISE)
        numerator, denominator = np.concatenate([[1.0], -model.a]), np.concatenate([[1.0], model.b])
        slowest = np.abs(np.roots(denominator)).max()
        warm = int(np.log(0.05) / np.log(slowest)) + max(len(numerator), len(denominator))
        e, psi, counts = np.zeros(len(r)), np.zeros((len(r), n + LAGS)), np.zeros(len(r), dtype=bool)
        ok = naive.usable(r, u, y, restart, pipeline.bank.wait)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], ok.astype(int), [0]])))
        for begin, end in edges.reshape(-1, 2):
            at = np.array([k for k in range(begin, end) if (k + 1) % pipeline.stride == 0])
            e[at] = signal.lfilter(numerator, denominator, v[at]) / np.sqrt(model.variance)
            psi[at, :n] = signal.lfilter(numerator, denominator, phi[at], axis=0) / np.sqrt(model.variance)
            for lag in range(1, LAGS + 1):
                psi[at[lag:], n - 1 + lag] = psi[at[:-lag], n - 1]
            counts[at[warm:]] = True
        if decides == "evaluation":  # white columns of a shadow that has always stood at the first r of a stretch
            late = [np.insert(polynomial, np.repeat(np.arange(1, len(polynomial)), pipeline.stride - 1), 0.0)
                    for polynomial in (numerator, denominator)]  # fmt: skip
            for begin, end in naive.stretches(r, u, y, restart):
                columns = phi[np.concatenate([np.full(2 * len(late[0]), begin), np.arange(begin, end)])]
                for lag in range(1, LAGS + 1):
                    columns = np.column_stack([columns, np.roll(columns[:, n - 1], lag * pipeline.stride)])
                zi = signal.lfilter_zi(*late)[:, None] * columns[:1]
                white = signal.lfilter(*late, columns, axis=0, zi=zi)[0] / np.sqrt(model.variance)
                psi[begin:end] = white[-(end - begin) :]
        level, crossed = naive.cusums(
            e, psi, counts, changes, limits, pipeline.every, len(r), by_evaluation=decides == "evaluation"
        )
        turn = (np.arange(len(r)) + 1) % pipeline.stride == 0
        assert np.array_equal(g.ok, ok & turn)
        assert whitening_filter(model)[3] == warm
        assert level.max() == 2.0 and len(np.unique(crossed)) >= 3  # it alarms, falls silent, and alarms again
        if decides == "evaluation":  # columns and healthy residual come from a shadow of fewer states
            assert len(test.shadow.A) < 16 and ours.level == pytest.approx(level, rel=0.1, abs=0.04)
            moved = ours.crossed != crossed
            assert moved.mean() < 0.02 and np.all(np.abs(ours.crossed - crossed)[moved] <= pipeline.every)
        else:
            assert ours.level == pytest.approx(level, rel=1e-6, abs=1e-6)
            assert np.array_equal(ours.crossed, crossed)

    @pytest.mark.parametrize(
        "cuts, step",
        [([1], "update"), ([99, 100, 3333], "update"), ([3101, 3105, 3107], "update"), ([99, 100, 3105], "evaluation")],
    )
    def test_blocks_leave_the_same_bits(self, cuts: list[int], step: str) -> None:
        baseline = learned(step=step)
        monitor, fault = Monitor(baseline), FaultEvent("C_ie", 1.2, 31.0)
        recording = recorded(baseline.loop, 5, 40.0, "multisine", fault)
        recording.y[1500], recording.restart[2000] = np.nan, True
        signals = recording.r, recording.u, recording.y, recording.restart
        state, whole = monitor.run(monitor.init(), *signals)
        parts, split = [], monitor.init()
        for block in np.split(np.arange(recording.samples), cuts):
            split, trace = monitor.run(split, *(each[block] for each in signals))
            parts.append(trace)
        assert np.array_equal(split, state)
        for name in ("level", "crossed", "exceeded"):
            joined = np.concatenate([getattr(part, name) for part in parts])
            assert np.array_equal(joined, getattr(whole, name), equal_nan=True), name
        assert whole.exceeded[-1] and whole.crossed[-1] == pytest.approx(31.5, abs=0.5)

    @pytest.mark.slow
    def test_all_ways_to_run_leave_the_same_bits_by_evaluation(self) -> None:
        """Sample by sample, alone, and in a fleet beside an asset whose changes lie in more directions."""
        baseline = learned(step="evaluation")
        fields = learned(step="update").model_dump(by_alias=True) | {"loop": baseline.loop_settings}
        other = Baseline.model_validate(fields)  # its changes were not made of few
        counts = [
            len(test.directions)
            for each in (baseline, other)
            if (test := cusum_constants(each, each.pipeline())) is not None
        ]
        assert counts[0] < counts[1] == 4 + LAGS
        recording = recorded(baseline.loop, 5, 40.0, "multisine", FaultEvent("C_ie", 1.2, 31.0))
        recording.y[[1500, 1507]] = np.nan
        signals = recording.r, recording.u, recording.y
        monitor = Monitor(baseline)
        state, trace = monitor.run(monitor.init(), *signals)
        stepped = monitor.init()
        for sample in zip(*(each.tolist() for each in signals), strict=True):
            monitor.step(stepped, *sample)
        assert np.array_equal(stepped, state)
        alike = Monitor([baseline] * 11)
        together, many = alike.run(alike.init(), *(np.tile(each, (11, 1)) for each in signals))
        assert np.array_equal(together[10], state) and np.array_equal(many.level[10], trace.level)
        mixed = Monitor([other, baseline])
        _, both = mixed.run(mixed.init(), *(np.tile(each, (2, 1)) for each in signals))
        assert np.array_equal(both.crossed[1], trace.crossed, equal_nan=True)
        assert np.allclose(both.level[1], trace.level, rtol=1e-9, atol=1e-12) and trace.level.max() == 2.0

    def test_a_gap_is_silent_until_the_whitening_has_forgotten_it(self) -> None:
        baseline = learned()
        recording = recorded(baseline.loop, 3, 30.0, "multisine", FaultEvent("C_ie", 1.4, 20.0))
        recording.restart[2000] = True
        e = estimates(baseline, recording)
        pipeline = baseline.pipeline()
        test = cusum_constants(baseline, pipeline)
        assert test is not None and baseline.thresholds.hypotheses
        silent = (e.index >= 2000) & (e.index < 2000 + pipeline.bank.wait + test.warm)
        before = e.level[np.flatnonzero(silent)[0] - 1]
        assert silent.sum() >= 2 and np.all(e.level[silent][1:] <= before)
        assert e.crossed[-1] > 2000 + pipeline.bank.wait + test.warm


class TestAlarms:
    @pytest.mark.parametrize("kind", ["multisine", "profile"])
    def test_healthy_recordings_of_any_seed_and_reference_raise_none(self, kind: str) -> None:
        baseline = learned(kind)
        assert baseline.thresholds.hypotheses
        for other in ("multisine", "profile", "trapezoid"):
            for seed in (11, 12):
                e = estimates(baseline, recorded(baseline.loop, seed, 120.0, other))
                assert e.level.max() < 1.0 and not e.crossed.any(), (other, seed)

    @pytest.mark.parametrize("size", [10.0, -100.0])
    @pytest.mark.parametrize("name", ["u", "y"])
    def test_a_spike_alone_raises_none(self, name: str, size: float) -> None:
        baseline = learned()
        recording = recorded(baseline.loop, 21)
        std = NOISE.u_std if name == "u" else NOISE.y_std
        getattr(recording, name)[[2000, 3500]] += size * std
        assert estimates(baseline, recording).level.max() < 1.0

    @pytest.mark.parametrize("step", ["update", "evaluation"])
    def test_a_leak_is_told_within_two_thirds_of_a_second(self, step: str) -> None:
        """At a budget of one false alarm a year; the median over ten recordings and baselines of their own."""
        delays = []
        for seed in range(10):
            baseline = learned(seed=1 + seed % 2, step=step)
            recording = recorded(baseline.loop, 100 + seed, 40.0, "multisine", FaultEvent("C_ie", 1.2, 30.0))
            crossed = estimates(baseline, recording).crossed
            assert not crossed[:300].any() and crossed[-1] > 0
            delays.append((crossed[crossed > 0][0] - 1) / 100.0 - 30.0)
        assert min(delays) > 0.0 and np.median(delays) <= 0.7, delays

    def test_the_alarm_of_a_diagnosis_is_the_first_of_both_tests(self) -> None:
        baseline = learned()
        recording = recorded(baseline.loop, 6, 45.0, "multisine", FaultEvent("C_ie", 1.2, 30.0))
        diagnosis, trace = diagnose_with_trace(baseline, recording)
        first = int(np.argmax(trace.exceeded))
        assert diagnosis.detected_at_s == pytest.approx(float(trace.crossed[first]))
        assert np.array_equal(
            trace.exceeded, trace.ready & ((trace.statistic > trace.threshold) | (trace.level >= 1.0))
        )
        assert trace.t[np.argmax(trace.statistic > trace.threshold)] >= trace.t[first]

    @pytest.mark.parametrize(
        "kind, step", [("multisine", "evaluation"), ("profile", "evaluation"), ("profile", "update")]
    )
    def test_keeps_its_budget(self, kind: str, step: str) -> None:
        """Sixty alarms an hour are asked for; noise and plant are known, so that nothing but the limits is tested."""
        loop, per_hour, hours = loop_of(sequential_step=step), 60.0, 4
        pipeline, plant = Pipeline.of(loop), loop.plant
        healthy = recorded(loop, 1, kind=kind)
        tuning = fit_tuning(pipeline, [pipeline.regression(healthy.r, healthy.u, healthy.y, healthy.restart)]).tuning
        expectation = Expectation(pipeline, tuning, NOISE, reference_path(healthy))
        chosen = choose_cusum_hypotheses(expectation, plant, NOISE, np.zeros((len(plant.parameters),) * 2))
        budget = per_hour / 3600.0 * SECONDS_PER_YEAR / calibrate_thresholds(expectation, plant, NOISE, chosen).cusum
        test = build_cusum_constants(pipeline, plant, NOISE, tuning.scale, chosen, budget)
        count = 0
        for hour in range(hours):
            level = pipeline.estimate(tuning, recorded(loop, 50 + hour, 3600.0, kind), test).level
            alarm = apply_alarm_delays(level >= 1.0, *pipeline.delays)
            count += int(np.sum(alarm[1:] & ~alarm[:-1]))
        assert 0.5 < count / (per_hour * hours) < 2.0, count

    def test_both_steps_listen_for_the_same_changes_but_the_largest(self) -> None:
        both = [
            {(m.parameter, m.ratio) for m in learned(step=step).thresholds.hypotheses}
            for step in ("update", "evaluation")
        ]
        assert both[1] < both[0]
        for parameter, ratio in both[0] - both[1]:  # each has a smaller neighbour, which finds it as soon
            smaller = [np.log(x) / np.log(ratio) for name, x in both[1] if name == parameter]
            assert any(0.2 < share < 1.0 for share in smaller), (parameter, ratio)

    def test_limits_share_the_budget_and_grow_with_doubt(self) -> None:
        """A limit h lets rate exp(-h + 2 h^2 drift) false alarms pass; where none does, the change is not heard."""
        budget = 0.2
        heights = []
        for drift in (0.0, 0.001, 0.003):
            h = CusumHypothesis("C_ie", 1.1, (1.0,), 1e8, drift).limit(budget)
            assert 1e8 * np.exp(-h + 2.0 * h**2 * drift) == pytest.approx(budget, rel=1e-9)
            heights.append(h)
        assert np.all(np.diff(heights) > 0.0)
        assert CusumHypothesis("C_ie", 1.1, (1.0,), 1e8, 0.1).limit(budget) == np.inf
