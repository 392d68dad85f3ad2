"""T^2, its threshold and power against simulated draws; the onset against a loop and against the truth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import naive
import numpy as np
import pytest
from scipy import signal, stats

import servoscope as ss
from servoscope.baseline.threshold import SECONDS_PER_YEAR, threshold
from servoscope.detection.onset import estimate_onset
from servoscope.detection.statistic import noncentrality, required_noncentrality, t2_statistic, whiten
from servoscope.estimation.pipeline import Pipeline, Tuning
from servoscope.fit.tuning import fit_tuning
from servoscope.models.loop import Loop
from servoscope.simulation import FaultEvent, reference, simulate

SCALE = np.array([1.0, 1e-2, 1e-5, 1e-7])


def covariance(seed: int = 0) -> naive.Array:
    L = np.random.default_rng(seed).standard_normal((4, 4)) * SCALE[:, None]
    return np.asarray(L @ L.T)


def draws(C: naive.Array, count: int, seed: int = 1) -> naive.Array:
    L = np.linalg.cholesky(C / np.outer(SCALE, SCALE)) * SCALE[:, None]
    return np.asarray(np.random.default_rng(seed).standard_normal((count, 4)) @ L.T)


class TestStatistic:
    def test_is_the_plain_inverse(self) -> None:
        C = np.array([covariance(seed) for seed in range(20)])
        theta, expected = np.random.default_rng(2).standard_normal((2, 20, 4)) * SCALE
        assert t2_statistic(theta, expected, C) == pytest.approx(naive.t_squared(theta, expected, C), rel=1e-6)

    def test_whitens_vectors_and_matrices_alike(self) -> None:
        C = np.array([covariance(seed) for seed in range(3)])
        d = np.random.default_rng(3).standard_normal((3, 4, 5)) * SCALE[:, None]
        together = whiten(C, d)
        for i in range(5):
            assert whiten(C, d[:, :, i]) == pytest.approx(together[:, :, i], rel=1e-12)

    def test_gaussian_deviations_are_chi_square(self) -> None:
        C = covariance()
        d = draws(C, 20_000)
        T2 = t2_statistic(d, 0.0 * d, np.broadcast_to(C, (len(d), 4, 4)))
        assert stats.kstest(T2, stats.chi2(4).cdf).pvalue > 0.01


class TestThreshold:
    def test_is_chi_square_where_the_noise_is_known(self) -> None:
        """And a level is looked at as often as the estimator forgets what it saw, 1/(2 memory) per unit of level."""
        limit = threshold(4, 10.0, 5.0, 1.0, 1e12)
        looks = SECONDS_PER_YEAR * limit / (2.0 * 5.0)
        assert looks * stats.chi2.sf(limit, 4) == pytest.approx(1.0, rel=1e-3)

    def test_is_hotelling_where_it_is_not(self) -> None:
        """With a covariance estimated from m draws, as many deviations pass as the budget says."""
        m, budget = 60, 0.01 * SECONDS_PER_YEAR  # one look in a hundred, and every evaluation is a look
        rng = np.random.default_rng(4)
        samples = rng.standard_normal((20_000, m, 4))
        S = np.einsum("kmi,kmj->kij", samples, samples) / m
        T2 = t2_statistic(rng.standard_normal((20_000, 4)), np.zeros((20_000, 4)), S)
        assert (threshold(4, 1.0, 1.0, budget, m) < T2).mean() == pytest.approx(0.01, abs=0.002)

    @pytest.mark.parametrize("memory", [5.0, 0.5])
    def test_keeps_the_budget_where_the_estimate_wanders(self, memory: float) -> None:
        """On simulated deviations that forget like the estimator, two hundred alarms are about two hundred."""
        rate, samples, alarms = 10.0, 1_000_000, 200.0
        a = np.exp(-1.0 / (memory * rate))
        white = np.random.default_rng(6).standard_normal((4, samples))
        T2 = (signal.lfilter([np.sqrt(1.0 - a**2)], [1.0, -a], white, axis=1) ** 2).sum(axis=0)
        limit = threshold(4, rate, memory, alarms * SECONDS_PER_YEAR * rate / samples, 1e9)
        above = np.flatnonzero(limit < T2)
        seen = 1 + int((np.diff(above) > memory * rate).sum())  # crossings within a memory are one alarm
        assert 0.6 < seen / alarms < 1.2

    def test_is_monotone(self) -> None:
        by_budget = [threshold(4, 10.0, 5.0, budget, 200.0) for budget in (0.1, 1.0, 10.0, 1e4)]
        by_dof = [threshold(4, 10.0, 5.0, 1.0, dof) for dof in (20.0, 50.0, 200.0, 1e4, 1e9)]
        by_memory = [threshold(4, 10.0, memory, 1.0, 200.0) for memory in (2.0, 5.0, 20.0)]
        for values in (by_budget, by_dof, by_memory):
            assert np.all(np.diff(values) < 0.0) and np.all(np.isfinite(values))
        assert threshold(4, 1.0, 5.0, 1.0, 200.0) <= threshold(4, 10.0, 5.0, 1.0, 200.0)

    def test_promised_power(self) -> None:
        limit = 40.0
        needed = required_noncentrality(4, limit)
        C = covariance()
        shift = np.linalg.cholesky(C)[:, 2] * np.sqrt(needed)
        d = draws(C, 20_000) + shift
        T2 = t2_statistic(d, 0.0 * d, np.broadcast_to(C, (len(d), 4, 4)))
        assert (limit < T2).mean() == pytest.approx(0.9, abs=0.01)


def tuned(loop: Loop, kind: str, seconds: float = 60.0) -> tuple[Pipeline, Tuning]:
    pipeline = Pipeline.of(loop)
    healthy, _ = simulate(loop, reference(kind, seconds, 100.0), seed=99)
    g = pipeline.regression(healthy.r, healthy.u, healthy.y, healthy.restart)
    return pipeline, fit_tuning(pipeline, [g]).tuning


def test_noncentrality_foretells_the_mean_of_the_statistic(rig: dict[str, Any]) -> None:
    """A change that is there from the start moves theta_hat by (I - Psi) Delta, so T^2 by the noncentrality."""
    loop = Loop.from_dict(rig)
    pipeline, tuning = tuned(loop, "multisine", 200.0)
    r = reference("multisine", 12.0, 100.0)
    ratio = 1.05
    Delta = loop.plant.with_ratios({"C_ie": ratio}).theta() - loop.plant.theta()
    at = [19, 49, 119]
    rises = []
    for seed in range(60):
        healthy, _ = simulate(loop, r, seed=seed)
        leaking, _ = simulate(loop, r, faults=[FaultEvent("C_ie", ratio, 0.0)], seed=seed)
        e, f = pipeline.estimate(tuning, healthy), pipeline.estimate(tuning, leaking)
        expected = noncentrality(e.S[at], e.Psi[at], Delta[None, :])[:, 0]
        nominal = np.broadcast_to(tuning.theta, e.theta.shape)
        T2 = [t2_statistic(x.theta[at], nominal[at], x.S[at]) for x in (e, f)]
        rises.append((T2[1] - T2[0]) / expected)
    assert expected[0] > 5.0 and np.all(np.diff(expected) > 0.0)
    assert np.mean(rises, axis=0) == pytest.approx(np.ones(3), abs=0.15)


class TestOnset:
    def broken(self, rig: dict[str, Any], kind: str, fault: str, seed: int) -> tuple[Any, ...]:
        loop = Loop.from_dict(rig)
        pipeline, tuning = tuned(loop, kind)
        recording, _ = simulate(loop, reference(kind, 26.0, 100.0), faults=[FaultEvent.parse(fault)], seed=seed)
        e = pipeline.estimate(tuning, recording)
        T2 = t2_statistic(e.theta, np.broadcast_to(tuning.theta, e.theta.shape), e.S)
        alarm = int(np.flatnonzero(threshold(4, 10.0, 5.0, 1.0, 500.0) < T2)[0])
        return pipeline, recording, tuning.theta, e.theta[-1], int(e.index[alarm]), int(e.index[-1])

    @pytest.mark.parametrize("seed", [1, 2])
    @pytest.mark.parametrize(
        ("kind", "fault"),
        [("multisine", f"{x}@17.03") for x in ("C_ie=1.2", "p_s=0.8", "b_p=20", "beta=0.01")]
        + [("profile", "C_ie=1.1@12.51"), ("profile", "beta=0.005@12.51"), ("profile", "b_p=10@12.51")],
    )
    def test_finds_the_step(self, rig: dict[str, Any], kind: str, fault: str, seed: int) -> None:
        found = estimate_onset(*self.broken(rig, kind, fault, seed))
        truth = FaultEvent.parse(fault).at_s
        assert found.likely_s == pytest.approx(truth, abs=0.15)
        assert found.low_s <= truth <= found.high_s
        assert found.low_s <= found.likely_s <= found.high_s
        assert found.high_s - found.low_s < 1.0
        assert found.sample == round(100.0 * found.likely_s)

    def test_interval_holds_the_truth_of_a_change_of_high_frequencies(self, rig: dict[str, Any]) -> None:
        found = [estimate_onset(*self.broken(rig, "multisine", "beta=0.1@17.03", seed)) for seed in range(6)]
        assert np.mean([each.likely_s for each in found]) == pytest.approx(17.03, abs=0.1)
        assert sum(each.low_s <= 17.03 <= each.high_s for each in found) >= 5

    def test_a_change_at_rest_may_have_begun_any_time_since(self, rig: dict[str, Any]) -> None:
        """It rests from 15 s to 20 s; noise alone tells little of when friction grew in between."""
        found = [estimate_onset(*self.broken(rig, "profile", "b_p=20@18", seed)) for seed in range(1, 7)]
        assert all(each.low_s <= 18.0 and 19.5 < each.high_s < 20.5 for each in found)
        assert np.median([each.low_s for each in found]) < 17.0

    def test_is_the_likelihood_of_every_sample(self, rig: dict[str, Any]) -> None:
        pipeline, recording, healthy, faulty, until, last = self.broken(rig, "multisine", "C_ie=1.1@3", 1)
        until, last = 450, 600
        cut = recording.restart.copy()
        cut[200] = True  # a gap: its samples do not count
        recording = replace(recording, restart=cut)
        g = pipeline.regression(recording.r, recording.u, recording.y, cut)
        ok = g.ok[: last + 1]
        v, changed = (ok * x[: last + 1] for x in (g.eta - g.phi @ healthy, g.phi @ (faulty - healthy)))
        step = np.zeros((pipeline.bank.wait + 1, 3))
        step[1:, 1] = 1.0
        ramp = pipeline.bank.system.simulate(step)[1:, 0]
        log_likelihood = naive.change_point(v, changed, ramp / ramp[-1], len(ramp), ok)[: until + 1]
        weight = np.exp(log_likelihood - log_likelihood.max())
        share = np.cumsum(weight) / weight.sum()
        found = estimate_onset(pipeline, recording, healthy, faulty, until, last)
        blur = pipeline.bank.wait // 2
        assert found.sample == int(np.argmax(log_likelihood))
        assert found.low_s == pytest.approx(min(np.argmax(share >= 0.025), found.sample - blur) / 100.0)
        assert found.high_s == pytest.approx(max(np.argmax(share >= 0.975), found.sample + blur) / 100.0)

    def test_never_leaves_the_recording(self, rig: dict[str, Any]) -> None:
        arguments = self.broken(rig, "multisine", "C_ie=1.4@0", 1)
        found = estimate_onset(*arguments)
        assert 0.0 <= found.low_s <= found.likely_s <= found.high_s <= arguments[4] / 100.0
        assert found.low_s == 0.0


def test_a_polynomial_dates_a_change_at_rest_by_all_of_the_rest(rig: dict[str, Any]) -> None:
    """Rows at rest do not count; a leak that comes with the next motion may have come with any of them."""
    base = Loop.from_dict(rig)
    plant = {"kind": "polynomial", "order": 3, "stiffness": True, "offset": True}
    loop = Loop.from_dict({"sample_rate": 100.0, "plant": plant, "monitor": {"cutoff": 10.0, "memory": 5.0}})
    r = reference("profile", 60.0, 100.0)
    baseline = ss.learn(loop, [simulate(base, r, seed=1)[0]])
    found = ss.diagnose(baseline, simulate(base, r, faults=[FaultEvent.parse("C_ie=1.2@30")], seed=2)[0])
    assert found.intervals[0].onset_s is not None
    low, likely, high = found.intervals[0].onset_s
    assert 25.0 < low < 26.0 and low <= likely <= high and 29.9 < high < 30.5
