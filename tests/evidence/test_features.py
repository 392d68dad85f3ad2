"""Features beside the coefficients: windows, scatter between recordings, limits, guarantees, verdicts, the monitor."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import halls
import numpy as np
import pytest
from axis_logs import LOOP, RATE, axis
from halls import BEGAN, POLICY
from scipy import signal

import servoscope as ss
from servoscope.baseline.feature_model import (
    FeatureGroup,
    FeatureModel,
    FeatureName,
    GroupStatistic,
    spans_in_a_row,
)
from servoscope.baseline.feature_spans import SpanFeatures
from servoscope.baseline.threshold import robust_limit, score_limit
from servoscope.detection.feature_monitor import hold, smallest_in_a_row
from servoscope.detection.homogeneity import leave_one_out, scatter, scatter_of_others
from servoscope.detection.statistic import t2_statistic
from servoscope.estimation.window_features import FeatureLayout, Window, WindowFeatures
from servoscope.evidence.features import choose_layout, learn_features
from servoscope.service.assets.asset import Asset
from servoscope.service.assets.checkpoint import pack_state
from servoscope.service.assets.examination import examine_blocks
from servoscope.service.assets.groups import AssetGroups
from servoscope.service.sources.block import Block

PROJECT = Path(__file__).parents[2]
LAYOUT = FeatureLayout(
    sample_rate=RATE,
    window=100,
    levels=2,
    span=3,
    settling=50,
    rest_speed=0.05,
    edges_s=(0.2, 0.5),
    bands_hz=(1.0, 4.0, 10.0, 20.0),
    floors=(1e-12, 1e-12),
)


@pytest.fixture(scope="module")
def baseline() -> ss.Baseline:
    return ss.learn(LOOP, [axis(seed) for seed in range(6)])


def naive_window(r: Any, u: Any, y: Any, layout: FeatureLayout, begin: int, size: int) -> Any:
    """Return the features of samples begin to begin + size: whole signals, masks and scipy's filters."""
    speed = np.zeros(len(r))
    smoothing = 1.0 - np.exp(-1.0 / (0.02 * layout.sample_rate))
    for k in range(1, len(r)):
        speed[k] = speed[k - 1] + smoothing * ((r[k] - r[k - 1]) * layout.sample_rate - speed[k - 1])
    motion = np.select([speed > layout.rest_speed, speed < -layout.rest_speed], [0, 1], 2)
    since = np.zeros(len(r))
    for k in range(1, len(r)):
        since[k] = since[k - 1] + 1.0 if motion[k] == motion[k - 1] else 0.0
    late = np.digitize(since / layout.sample_rate, layout.edges_s)
    inside = np.zeros(len(r), dtype=bool)
    inside[begin : begin + size] = True
    levels, powers = [], []
    for x in (u, r - y):
        bands = []
        for low, high in pairwise(layout.bands_hz):
            sos = signal.butter(1, [low, high], "bandpass", fs=layout.sample_rate, output="sos")
            once = signal.sosfilt(sos, x - x[0])  # a band-pass has forgotten a constant
            bands.append(signal.sosfilt(sos, once))
        for which in range(3):
            for bin_ in range(len(layout.edges_s) + 1):
                at = inside & (motion == which) & (late == bin_)
                levels.append(x[at].mean() if at.sum() >= 3 else np.nan)
            at = inside & (motion == which)
            heard = at.sum() >= layout.sample_rate / layout.bands_hz[0] / 4.0  # a quarter of the slowest period
            powers += [0.5 * np.log(np.mean(band[at] ** 2)) if heard else np.nan for band in bands]
    return np.array(levels + powers)


class TestWindows:
    def test_features_are_means_and_band_powers_of_masked_signals(self) -> None:
        rec = axis(1)
        runner = WindowFeatures(LAYOUT)
        windows = list(runner.run(runner.start(), rec.r, rec.u, rec.y, rec.restart))
        assert [(w.level, w.span) for w in windows[:5]] == [(0, 0), (0, 0), (1, 0), (0, 0), (0, 1)]
        for window in windows[:5]:
            size = LAYOUT.window * 2**window.level
            expected = naive_window(rec.r, rec.u, rec.y, LAYOUT, window.end - size, size)
            np.testing.assert_allclose(window.features, expected, rtol=1e-9, atol=1e-12)
            assert window.motion[:3].sum() == pytest.approx(1.0)

    def test_blocks_of_any_length_give_the_same_bits(self) -> None:
        rec, runner = axis(2), WindowFeatures(LAYOUT)
        r, u, y, restart = rec.r.copy(), rec.u, rec.y, rec.restart.copy()
        r[400], restart[700] = np.nan, True  # a gap, and a jump in time
        whole = runner.start()
        expected = list(runner.run(whole, r, u, y, restart))
        state, found = runner.start(), []
        for a, b in pairwise([0, 1, 2, 99, 100, 101, 350, 401, 699, 1200, len(r)]):
            found += list(runner.run(state, r[a:b], u[a:b], y[a:b], restart[a:b]))
        assert np.array_equal(whole, state)
        assert [w.end for w in found] == [w.end for w in expected]
        for one, other in zip(found, expected, strict=True):
            assert np.array_equal(one.features, other.features, equal_nan=True)
        # no window reaches over the gap or the jump
        assert all(not (w.end - 100 * 2**w.level < cut < w.end) for w in expected for cut in (400, 700))

    def test_a_silent_band_is_silent_and_an_unseen_motion_is_not_seen(self) -> None:
        n = 400
        runner = WindowFeatures(LAYOUT)
        nothing = np.zeros(n)
        (window, *_) = runner.run(runner.start(), nothing, nothing, nothing, np.zeros(n, dtype=bool))
        levels, _, powers, _ = (window.features[part] for part in LAYOUT.groups)
        assert np.isnan(levels[:6]).all() and np.isfinite(powers[6:]).all()
        assert powers[6:] == pytest.approx(0.5 * np.log(1e-12))

    def test_every_feature_has_a_name(self) -> None:
        names = [FeatureName.of(LAYOUT, k) for k in range(LAYOUT.size)]
        assert len(set(names)) == LAYOUT.size == 2 * (9 + 9)
        assert names[1] == FeatureName("u", "forward", None, (0.2, 0.5))
        assert names[-1] == FeatureName("e", "rest", (10.0, 20.0), None)

    def test_windows_are_periods_where_the_reference_repeats(self) -> None:
        recordings = [axis(seed) for seed in range(2)]
        layout = choose_layout(LOOP, recordings)
        assert (layout.window, layout.levels, layout.settling) == (200, 1, 200)
        assert layout.edges_s == pytest.approx((0.125, 0.25, 0.5))
        rng = np.random.default_rng(0)
        walk = [replace(rec, r=np.cumsum(rng.standard_normal(rec.samples))) for rec in recordings]
        assert (choose_layout(LOOP, walk).window, choose_layout(LOOP, walk).levels) == (100, 3)


class TestLimits:
    def test_the_limit_is_a_log_normal_prediction(self) -> None:
        # logs 0, 1, 2: mean 1, deviations clipped to 1.345 x 0.5; with 8 degrees of 0.5^2; t_10(0.995) = 3.169273
        variance = (1.41 * 2.0 * (1.345 * 0.5) ** 2 + 8.0 * 0.5**2) / 10.0
        expected = np.exp(1.0 + 3.169273 * np.sqrt(variance * (1.0 + 1.0 / 3.0)))
        assert score_limit(np.exp([0.0, 1.0, 2.0]), 0.005) == pytest.approx(expected, rel=1e-6)

    def test_one_outlier_raises_the_limit_to_its_own_score_and_no_further(self) -> None:
        scores = np.exp(0.4 * np.random.default_rng(2).standard_normal(9))
        alone, beside = score_limit(scores, 0.005), score_limit([*scores, 20.0], 0.005)
        assert robust_limit([*scores, 20.0], 0.005) < 1.5 * alone and beside == 20.0
        # more recordings like these lower the limit, or leave it about where it was
        assert score_limit([*scores, *scores], 0.005) < alone

    def test_spans_in_a_row_keep_the_budget(self) -> None:
        for budget in (0.01, 1.0, 100.0):
            k = spans_in_a_row(LAYOUT, 0.005, budget)
            spans_per_year = 365.25 * 86400.0 / LAYOUT.span_s
            assert spans_per_year * 0.005**k <= 0.1 * budget < spans_per_year * 0.005 ** (k - 1)

    def test_scores_in_a_row(self) -> None:
        ratios = np.array([2.0, 3.0, 0.5, 4.0, 5.0, 6.0])
        slow = [min([0.0, 0.0, *ratios][k : k + 3]) for k in range(6)]
        assert smallest_in_a_row(ratios, 3).tolist() == slow == [0.0, 0.0, 0.5, 0.5, 0.5, 4.0]
        held = hold(np.array([1.0, 2.0]), np.array([10, 20]), np.array([9, 10, 19, 25]), before=0.5)
        assert held.tolist() == [0.5, 1.0, 1.0, 2.0]

    def test_the_statistic_predicts_recordings_after_those_learned(self) -> None:
        """T^2/d of later recordings of a drifting machine averages one: scatter, mean and slope are accounted for."""
        rng, n, d, scores = np.random.default_rng(3), 12, 3, []
        for _ in range(400):
            slope = 0.05 * rng.standard_normal(d)
            x = rng.standard_normal((n, d)) + np.outer(np.arange(n), slope)
            new = rng.standard_normal(d) + slope * (n + (n - 1) / 2.0)
            group = FeatureGroup(
                level=0,
                kept=(0, 1, 2),
                means=tuple(map(tuple, x)),
                within=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
                degrees=1000,
                windows=4.0,
            )
            scores.append(GroupStatistic.of(group).score(new, 4.0))
        assert 0.5 < np.mean(scores) < 1.5

    @pytest.mark.parametrize("draw", ["normal", "t3", "lognormal"])
    def test_the_guarantee_needs_no_distribution(self, draw: str) -> None:
        """P(p <= 1/(n + 1)) of exchangeable recordings is at most 1/(n + 1), whatever their scatter is like."""
        rng, n, d, draws = np.random.default_rng(5), 7, 3, 300
        law = {"normal": rng.standard_normal, "t3": lambda size: rng.standard_t(3, size),
               "lognormal": lambda size: rng.lognormal(size=size)}[draw]  # fmt: skip
        within = tuple(map(tuple, np.eye(d)))
        count = 0
        for _ in range(draws):
            x = law(size=(n + 1, d))
            group = FeatureGroup(
                level=0, kept=(0, 1, 2), means=tuple(map(tuple, x[:n])), within=within, degrees=100, windows=1.0
            )
            model = FeatureModel.model_construct(groups=(group,), left_out=(1.0,) * n)
            p = model.conformal_p_value(SpanFeatures(x[n:], np.ones(1), np.zeros(5)))
            assert p >= 1.0 / (n + 1) - 1e-12
            count += p < 1.5 / (n + 1)
        assert count / draws < 1.0 / (n + 1) + 3.0 * np.sqrt(1.0 / (n + 1) / draws)

    def test_coefficients_are_checked_by_leaving_one_out(self) -> None:
        """A recording far off the others raises the scatter until what the others teach would have let it pass."""
        rng, m, n = np.random.default_rng(8), 6, 2
        apart = 0.1 * rng.standard_normal((m, n))
        apart[4] += 3.0
        C = np.tile(1e-4 * np.eye(n), (m, 1, 1))
        mean = apart.mean(axis=0)
        paths = [(np.tile(x - mean, (5, 1)), np.tile(1e-4 * np.eye(n), (5, 1, 1))) for x in apart]
        settled = [np.zeros((1, n, n))] * m
        told = scatter_of_others(apart, C, settled)
        factor, ratios = leave_one_out(paths, apart, told, 1e-6 * np.eye(n), limit=20.0)
        others = np.delete(np.arange(m), 4)
        assert np.array_equal(told[4], scatter(apart[others], C[others]))
        d = apart[4] - apart[others].mean(axis=0)

        def slow(f: float) -> float:
            spread = (1e-4 + 1e-6) * np.eye(n) + f * scatter(apart[others], C[others])
            return float(t2_statistic(d[None], np.zeros((1, n)), spread[None])[0]) / 20.0

        assert ratios[4] == pytest.approx(slow(1.0)) and ratios[4] > 1.0 and ratios[others].max() < 1.0
        assert slow(factor) <= 1.0 < slow(factor / 1.3)
        assert leave_one_out(paths[:3], apart[:3], told[:3], np.eye(n), 20.0)[0] == 1.0  # three have no scatter


class TestLearning:
    def test_few_recordings_have_no_features_and_a_setting_switches_them_off(self) -> None:
        assert learn_features(LOOP, [axis(seed) for seed in range(3)]) == (None, [])
        off = LOOP.model_copy(update={"monitor": LOOP.monitor.model_copy(update={"feature_false_alarms": 0.0})})
        assert learn_features(off, [axis(seed) for seed in range(5)]) == (None, [])
        model, notes = learn_features(LOOP, [axis(seed, seconds=3.0) for seed in range(5)])
        assert model is None or model.layout.span_s <= 3.0, notes

    def test_an_outlier_is_named_and_a_second_population_is_not(self) -> None:
        alike = [axis(seed) for seed in range(9)]
        for changed, named in (([axis(20, level=0.2)], 1), ([axis(20 + k, level=0.2) for k in range(5)], 0)):
            _, notes = learn_features(LOOP, [*alike[len(changed) :], *changed])
            assert sum(note.key == "learning.features_outlier" for note in notes) == named

    def test_a_file_keeps_them_and_a_shared_budget_waits_longer(self, baseline: ss.Baseline, tmp_path: Path) -> None:
        baseline.save(tmp_path / "baseline.json")
        assert ss.Baseline.load(tmp_path / "baseline.json") == baseline
        model, shared = baseline.features, baseline.shared(10_000).features
        assert model is not None and shared is not None
        assert shared.in_a_row > model.in_a_row and shared.limit == model.limit
        assert len(baseline.scatter.left_out) == len(model.left_out) == 6
        assert max(model.left_out) <= model.limit and max(baseline.scatter.left_out) < 1.0


class TestVerdicts:
    def test_healthy_recordings_stay_healthy(self, baseline: ss.Baseline) -> None:
        said = [ss.diagnose(baseline, axis(seed)) for seed in range(100, 112)]
        assert [one.verdict for one in said] == ["healthy"] * 12

    def test_what_no_coefficient_shows_is_found_and_told_where(self, baseline: ss.Baseline) -> None:
        alone = ss.diagnose(baseline.model_copy(update={"features": None}), axis(200, ripple=0.15))
        found = ss.diagnose(baseline, axis(200, ripple=0.15))
        assert (alone.verdict, found.verdict) == ("healthy", "suspect")
        assert ss.diagnose(baseline, axis(200, ripple=0.15), before="suspect").verdict == "fault"
        assert not found.faults and found.candidates[0].name == "unknown"
        assert "while r rises, between" in found.summary and "times as large as in the healthy" in found.summary
        low, high = (float(found.summary.split(" Hz")[0].split("between ")[1].split(" and ")[i]) for i in (0, 1))
        assert low < 15.0 < high
        assert found.explanation[-2].startswith("u and the tracking error have both grown: air in the oil")
        assert found.explanation[-1].startswith("At most 1 in 7 healthy")  # all that six recordings can guarantee

    def test_a_coefficient_comes_first_and_features_stand_beside_it(self, baseline: ss.Baseline) -> None:
        found = ss.diagnose(baseline, axis(201, level=-0.3))
        assert found.verdict in ("suspect", "fault") and found.onset_s is not None
        assert found.explanation[0].startswith("Alarm at") and "while r falls" in found.explanation[-2]

    def test_motion_that_was_never_seen_is_no_evidence(self, baseline: ss.Baseline) -> None:
        found = ss.diagnose(baseline, axis(202, speed=0.6, ripple=0.15))
        warned = [one for one in found.warnings if one.kind == "features"]
        assert len(warned) == 1 and "moves as in no healthy recording" in warned[0].message
        assert "Besides" not in " ".join(found.explanation)


class TestStreams:
    def test_the_monitor_resumes_with_the_same_bits(self, baseline: ss.Baseline) -> None:
        rec, monitor = axis(300, seconds=150.0, ripple=0.15), ss.Monitor(baseline)
        end, trace = monitor.run(monitor.init(), rec.r, rec.u, rec.y)
        assert trace.features is not None and baseline.features is not None
        state, parts = monitor.init(), []
        for a, b in pairwise([0, 1, 777, 1400, 5000, rec.samples]):
            state, part = monitor.run(state.copy(), rec.r[a:b], rec.u[a:b], rec.y[a:b])
            parts.append(part.features)
        assert np.array_equal(state, end) and np.array_equal(np.concatenate(parts), trace.features)
        one = monitor.init()
        for k in range(2000):
            monitor.step(one, rec.r[k], rec.u[k], rec.y[k])
        assert np.array_equal(one, monitor.run(monitor.init(), rec.r[:2000], rec.u[:2000], rec.y[:2000])[0])
        # the alarm comes when as many spans as the budget asks for are above the limit
        layout = baseline.features.layout
        due = layout.settling / RATE + baseline.features.in_a_row * layout.span_s
        first = float(trace.t[np.argmax(trace.features > 1.0)])
        assert (trace.features > 1.0).any() and due <= first + 1.0 / RATE and first <= due + 0.2
        assert trace.statistics[-1].name == "features" and trace.exceeded[-1]

    def test_each_asset_of_a_fleet_cuts_its_own_windows(self, baseline: ss.Baseline) -> None:
        """To the bits that each has alone, wherever its gaps are; one without features has none."""
        plain = baseline.model_copy(update={"features": None})
        kinds, recs = (
            (baseline, plain, baseline),
            [axis(301 + i, seconds=150.0, ripple=0.15 * (i == 0)) for i in range(3)],
        )
        r, u, y = (np.stack([getattr(one, name) for one in recs]) for name in "ruy")
        restart = np.zeros(r.shape, dtype=np.bool_)
        restart[2, 500], y[0, 900:903] = True, np.nan
        fleet, states, features = ss.Monitor(kinds), [], []
        state = fleet.init()
        for a, b in pairwise([0, 777, 778, 4001, r.shape[1]]):
            state, trace = fleet.run(state.copy(), r[:, a:b], u[:, a:b], y[:, a:b], restart[:, a:b])
            features.append(trace.features)
        together = np.concatenate(features, axis=1)
        for i, one in enumerate(kinds):
            monitor = ss.Monitor(one)
            end, alone = monitor.run(monitor.init(), r[i], u[i], y[i], restart[i])
            states.append(end)
            assert np.array_equal(
                together[i], np.zeros(together.shape[1]) if alone.features is None else alone.features
            )
            assert np.array_equal(state[i][: end.size], end)
        assert (together[0] > 1.0).any() and not (together[2] > 1.0).any()
        latest = fleet.latest(state)
        assert latest.features is not None and np.array_equal(latest.features[:, 0], together[:, -1])
        assert latest.lane(0).exceeded.all() and not latest.lane(1).exceeded.any()

    def test_a_service_follows_such_assets_together_to_the_same_bits(self, baseline: ss.Baseline) -> None:
        monitor = ss.Monitor(baseline)
        assert monitor.lane_key is not None
        recs = {f"axis{i}": axis(310 + i, seconds=150.0, ripple=0.15 * i) for i in range(2)}
        alone, together = ({name: Asset(name, baseline, monitor, POLICY) for name in recs} for _ in range(2))
        groups = AssetGroups(together)
        for k in range(0, 7500, 50):
            rows = slice(k, k + 50)
            blocks = [
                Block(name, k // 50, BEGAN + x.t[rows], x.r[rows], x.u[rows], x.y[rows]) for name, x in recs.items()
            ]
            expected = [alone[one.asset].process(one).rows for one in blocks]
            found = dict(halls.block_rows(groups.process(blocks)))
            assert [found[one.asset] for one in blocks] == expected
        for name, asset in alone.items():
            assert asset.state is not None and together[name].state is not None
            assert pack_state(asset.state) == pack_state(together[name].state)
            assert (asset.state.evaluation.features or 0.0) > 0.0

    def test_the_service_believes_the_monitor(self, baseline: ss.Baseline) -> None:
        rec, monitor = axis(302, seconds=150.0, ripple=0.15), ss.Monitor(baseline)
        _, trace = monitor.run(monitor.init(), rec.r, rec.u, rec.y, rec.restart)
        assert trace.features is not None and trace.exceeded.any()
        score = float(trace.features[-1])
        block = Block("axis", 0, rec.t, rec.r, rec.u, rec.y)
        assert examine_blocks(baseline, "axis", [block], 0.5).verdict == "healthy"
        found = examine_blocks(baseline, "axis", [block], score)
        assert found.verdict == "fault" and f"{score:.3g} times their alarm limit" in found.summary


def test_a_ball_screw_without_grease_at_minus_40_kgf(shared_data: Path) -> None:
    """Cranfield, learned from healthy runs 1 to 5: no coefficient shows the fault, the features do in every run."""
    loop = ss.Loop.load(PROJECT / "examples" / "cranfield.toml")
    runs = {
        name: ss.read_parts(shared_data / "real" / "cranfield" / f"{name}.csv", loop, where={"load": "-40"}, by="run")
        for name in ("normal", "backlash2", "lackLubrication1")
    }
    baseline = ss.learn(loop, runs["normal"][:5])
    assert [ss.diagnose(baseline, run).verdict for run in runs["normal"][5:]] == ["healthy"] * 5
    for name in ("backlash2", "lackLubrication1"):
        told = ss.diagnose(baseline, runs[name])  # one is unlike the healthy ones, two in a row are a fault
        assert all(one.verdict in ("suspect", "fault") for one in told)
        assert [one.verdict for one in told[1:]] == ["fault"] * 9


def test_a_window_counts_once() -> None:
    """The mean of a span is that of its windows, feature by feature, where they were seen."""
    rng = np.random.default_rng(0)
    windows = [Window(k, 0, 0, rng.standard_normal(LAYOUT.size), rng.random(5)) for k in range(3)]
    windows[1].features[:4] = np.nan
    span = SpanFeatures.of(windows, LAYOUT)
    expected = np.nanmean([w.features for w in windows], axis=0)
    np.testing.assert_allclose(span.values[0], expected)
    assert span.counts.tolist() == [3.0, 0.0] and np.isnan(span.values[1]).all()
