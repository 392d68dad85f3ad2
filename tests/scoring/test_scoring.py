"""Scores against scipy, statsmodels and the textbooks' numbers; run lengths against an integral equation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from public.fault_indices import FaultIndices, fault_indices
from scipy import stats
from statsmodels.stats.multitest import multipletests
from statsmodels.stats.proportion import proportion_confint
from statsmodels.stats.rates import confint_poisson

from servoscope import scoring
from servoscope.core.arrays import BoolArray, FloatArray


def bools(text: str) -> BoolArray:
    return np.array([c == "#" for c in text])


def page(shift: float, k: float, h: float, points: int = 60) -> float:
    """Solve Page's (1954) integral equation for the one-sided CUSUM by Gauss-Legendre (Goel and Wu, 1971)."""
    x, weight = np.polynomial.legendre.leggauss(points)
    s, weight = (x + 1.0) * h / 2.0, weight * h / 2.0
    to_zero = stats.norm.cdf(k - shift - s)  # probability that the sum falls to 0 from s
    kernel = stats.norm.pdf(s[None, :] - s[:, None] + k - shift) * weight
    system = np.eye(points + 1)  # unknowns: run length from each s, and from 0
    system[:points, :points] -= kernel
    system[:points, points] -= to_zero
    system[points, :points] -= stats.norm.pdf(s + k - shift) * weight
    system[points, points] -= stats.norm.cdf(k - shift)
    return float(np.linalg.solve(system, np.ones(points + 1))[points])


def slow_cusum(x: FloatArray, k: float, h: float) -> BoolArray:
    alarm, sums = [], (0.0, 0.0)
    for value in x:
        sums = max(0.0, sums[0] + value - k), max(0.0, sums[1] - value - k)
        alarm.append(max(sums) > h)
        sums = (0.0, 0.0) if alarm[-1] else sums
    return np.array(alarm)


class TestAlarms:
    def test_an_excursion_counts_once_and_a_short_one_not_at_all(self) -> None:
        alarm = bools("#..##.####.")
        assert scoring.events(alarm).tolist() == [0, 3, 6]
        assert scoring.events(alarm, on_delay=1).tolist() == [4, 7]
        assert scoring.events(alarm, on_delay=4).tolist() == []
        assert scoring.events(bools("")).size == 0

    @given(st.text("#.", max_size=40), st.integers(0, 4))
    def test_events_are_what_a_counter_finds(self, text: str, on_delay: int) -> None:
        found, above = [], 0
        for k, is_above in enumerate(bools(text)):
            above = above + 1 if is_above else 0
            if above == on_delay + 1:
                found.append(k)
        assert scoring.events(bools(text), on_delay).tolist() == found

    @pytest.mark.parametrize("count", [0, 1, 7, 250])
    def test_rate_is_garwoods(self, count: int) -> None:
        rate = scoring.alarm_rate(count, 40.0)
        assert rate.value == count / 40.0
        assert rate[1:] == pytest.approx(confint_poisson(count, 40.0, method="exact-c"), rel=1e-9)

    def test_rate_of_nothing_is_the_rule_of_three(self) -> None:
        assert scoring.alarm_rate(0, 100.0, confidence=0.9).high == pytest.approx(-np.log(0.05) / 100.0)

    def test_delays_misses_and_what_came_too_early(self) -> None:
        found = scoring.detections([[10.0, 31.0, 40.0], [], [30.0], [95.0]], 30.0, within=60.0)
        assert found.delays.tolist() == [1.0, np.inf, 0.0, np.inf]
        assert found.false_alarms.tolist() == [1, 0, 0, 0]
        assert found.missed.value == 0.5
        assert found.median == 1.0  # of all four: a miss is longer than any delay
        assert found.quantile(0.75) == np.inf

    def test_each_run_may_have_its_own_onset(self) -> None:
        assert scoring.detections([[3.0, 8.0], [3.0, 8.0]], [2.0, 5.0]).delays.tolist() == [1.0, 3.0]


class TestIntervals:
    @pytest.mark.parametrize(("count", "total"), [(0, 10), (3, 10), (950, 1000), (20, 20)])
    def test_share_is_wilsons(self, count: int, total: int) -> None:
        low, high = proportion_confint(count, total, method="wilson")
        assert scoring.share(count, total)[1:] == pytest.approx((low, high), abs=1e-9)

    def test_share_of_nothing_is_refused(self) -> None:
        with pytest.raises(ValueError, match="total"):
            scoring.share(0, 0)

    def test_coverage_of_gaussian_intervals(self) -> None:
        x = np.random.default_rng(2).standard_normal(4000)
        inside = scoring.coverage(x - 1.959964, x + 1.959964, 0.0)
        assert inside.low < 0.95 < inside.high
        assert scoring.coverage([1.0, 0.0], [2.0, 0.9], 1.0).value == 0.5

    def test_discoveries_are_those_of_benjamini_and_hochberg(self) -> None:
        rng = np.random.default_rng(3)
        p = np.concatenate([rng.uniform(size=80), 1e-3 * rng.uniform(size=20)])
        for rate in (0.01, 0.05, 0.2):
            assert np.array_equal(scoring.discoveries(p, rate), multipletests(p, rate, "fdr_bh")[0])

    def test_discoveries_of_the_1995_paper(self) -> None:
        """Section 3.1 there, 15 tests: Bonferroni rejects three, the new procedure four."""
        p = [0.0001, 0.0004, 0.0019, 0.0095, 0.0201, 0.0278, 0.0298, 0.0344]
        p += [0.0459, 0.3240, 0.4262, 0.5719, 0.6528, 0.7590, 1.0]
        assert scoring.discoveries(np.array(p)).sum() == 4


class TestIsolation:
    LABELS = ("pump", "leakage", "unknown")

    def test_confusion_and_accuracy(self) -> None:
        counts = scoring.confusion(["pump", "pump", "leakage"], ["pump", "unknown", "leakage"], self.LABELS)
        assert counts.tolist() == [[1, 0, 1], [0, 1, 0], [0, 0, 0]]
        assert scoring.accuracy(counts) == scoring.share(2, 3)
        with pytest.raises(ValueError, match="rust"):
            scoring.confusion(["rust"], ["pump"], self.LABELS)

    def test_scores_of_three_forecasts(self) -> None:
        p = np.array([[1.0, 0.0], [0.5, 0.5], [0.2, 0.8]])
        truth = np.array([0, 1, 0])
        assert scoring.log_score(p, truth) == pytest.approx(-np.log(0.5 * 0.2) / 3.0)
        assert scoring.brier_score(p, truth) == pytest.approx((0.0 + 0.5 + 1.28) / 3.0)
        assert scoring.log_score(p, np.array([1, 1, 1])) == np.inf

    def test_honest_probabilities_score_best(self) -> None:
        rng = np.random.default_rng(4)
        honest = rng.uniform(size=20_000)
        truth = (rng.uniform(size=honest.size) < honest).astype(np.int64)
        bold = np.clip(1.6 * (honest - 0.5) + 0.5, 0.01, 0.99)
        said = [np.stack([1.0 - q, q], axis=1) for q in (honest, bold)]
        for score in (scoring.log_score, scoring.brier_score):
            assert score(said[0], truth) < score(said[1], truth)
        errors = [scoring.reliability(q, truth).calibration_error for q in (honest, bold)]
        assert errors[0] < 0.02 < 0.08 < errors[1]

    def test_reliability_by_hand(self) -> None:
        found = scoring.reliability(np.array([0.1, 0.3, 0.6, 1.0]), [False, True, True, True], bins=2)
        assert found.count.tolist() == [2, 2]
        assert found.claimed == pytest.approx([0.2, 0.8])
        assert found.observed == pytest.approx([0.5, 1.0])
        assert found.calibration_error == pytest.approx(0.25)
        assert scoring.reliability(np.array([0.9]), [True], bins=3).calibration_error == pytest.approx(0.1)


class TestRunLengths:
    def test_brook_and_evans_are_the_textbooks_numbers(self) -> None:
        """Montgomery, Introduction to Statistical Quality Control, table 9.3: k = 0.5, h = 5."""
        table = {0.0: 465.0, 0.25: 139.0, 0.5: 38.0, 0.75: 17.0, 1.0: 10.4, 1.5: 5.75, 2.0: 4.01, 3.0: 2.57}
        for shift, length in table.items():
            assert scoring.two_sided(scoring.brook_evans, shift) == pytest.approx(length, rel=5e-3)

    @pytest.mark.parametrize("shift", [-0.5, 0.0, 0.5, 1.0, 3.0])
    def test_brook_and_evans_solve_pages_integral_equation(self, shift: float) -> None:
        assert scoring.brook_evans(shift) == pytest.approx(page(shift, 0.5, 5.0), rel=1e-4)

    @pytest.mark.parametrize("shift", [0.0, 0.25, 0.5, 1.0, 1.5])
    def test_siegmund_is_close(self, shift: float) -> None:
        assert scoring.siegmund(shift) == pytest.approx(scoring.brook_evans(shift), rel=0.02)

    def test_siegmund_has_no_step_where_the_drift_vanishes(self) -> None:
        assert scoring.siegmund(0.5) == (5.0 + scoring.runlength.OVERSHOOT) ** 2
        near = [scoring.siegmund(0.5 + d) for d in (1.6e-5, 1.7e-5)]
        assert near[0] == pytest.approx(near[1], rel=1e-5)

    @pytest.mark.parametrize("shift", [0.0, 1.0])
    def test_the_cusum_runs_as_long_as_theory_says(self, shift: float) -> None:
        def draw(seed: int) -> FloatArray:
            return shift + np.random.default_rng(seed).standard_normal(6000)

        average = scoring.run_lengths(scoring.cusum, draw, range(2000, 4000)).average
        assert average.low < scoring.two_sided(scoring.brook_evans, shift) < average.high
        assert average.high - average.low < 0.15 * average.value

    def test_runs_cut_short_count_with_what_was_seen(self) -> None:
        def draw(seed: int) -> FloatArray:
            return np.random.default_rng(seed).standard_normal(400)

        found = scoring.run_lengths(scoring.cusum, draw, range(2000))
        assert 0.3 < found.ended.mean() < 0.8
        assert found.average.low < 465.4 < found.average.high

    def test_dummies_speak_at_once_and_never(self) -> None:
        draw = {0: np.zeros(50), 1: np.zeros(30)}.__getitem__
        assert scoring.run_lengths(scoring.always, draw, (0, 1)).average.value == 1.0
        assert scoring.run_lengths(scoring.never, draw, (0, 1)).average.value == np.inf

    def test_every_dummy_has_the_same_interface(self) -> None:
        x = np.random.default_rng(5).standard_normal(1000)
        for detector in scoring.DUMMIES.values():
            alarm = detector(x)
            assert alarm.shape == x.shape
            assert alarm.dtype == np.bool_

    def test_cusum_is_the_recursion_of_the_book(self) -> None:
        x = 0.3 + np.random.default_rng(6).standard_normal(2000)
        assert np.array_equal(scoring.cusum(x, 0.5, 4.0), slow_cusum(x, 0.5, 4.0))


class TestBounds:
    @pytest.mark.parametrize("h", [3.0, 5.0, 10.0])
    @pytest.mark.parametrize("shift", [0.1, 0.5, 1.0])
    def test_no_cusum_beats_the_optimum_and_the_best_one_nearly_reaches_it(self, shift: float, h: float) -> None:
        information = shift**2 / 2.0
        arl0 = scoring.brook_evans(0.0, shift / 2.0, h)
        best = scoring.needed_information(arl0, information) / information
        assert best < scoring.brook_evans(shift, shift / 2.0, h) < 1.02 * best + 0.5

    def test_lordens_bound_is_the_optimum_to_first_order(self) -> None:
        ratio = [scoring.needed_information(arl0, 0.5) / 0.5 / scoring.lorden_bound(arl0, 0.5) for arl0 in (1e3, 1e300)]
        assert ratio[0] < 0.8 < 0.995 < ratio[1] < 1.0

    def test_even_information_gives_the_same_bound_in_whole_samples(self) -> None:
        assert scoring.shortest_delay(np.log(1e6), np.full(100, 0.5)) == np.ceil(scoring.lorden_bound(1e6, 0.5))

    def test_nothing_is_learned_at_rest(self) -> None:
        information = np.concatenate([np.zeros(70), np.full(100, 0.5)])
        assert scoring.shortest_delay(10.2, information) == 70 + 21
        assert scoring.shortest_delay(10.2, information[:80]) == np.inf


class TestFaultIndices:
    """The six indices of DAMADICS against sums by hand."""

    def test_of_a_course_by_hand(self) -> None:
        t = np.arange(10.0)
        shown = bools("#...#.####")  # one false second of 4; the fault is there from 4 to 10 s, shown for 5 of 6 s
        named = ["x", "", "", "", "y", "", "y", "x", "x", "x"]
        found = fault_indices(t, shown, named, "x", 4.0)
        assert found == FaultIndices(t_dt=2.0, r_fd=0.25, r_td=5 / 6, r_fi=2 / 6, r_ti=3 / 6, t_it=3.0)

    def test_what_does_not_last_is_no_detection(self) -> None:
        found = fault_indices(np.arange(4.0), bools(".##."), ["", "x", "x", ""], "x", 1.0)
        assert np.isinf([found.t_dt, found.t_it]).all()
        assert found.r_td == pytest.approx(2 / 3)

    def test_decisions_after_its_end_do_not_count(self) -> None:
        found = fault_indices(np.arange(6.0), bools("..##.."), ["", "", "x", "x", "", ""], "x", 2.0, 4.0)
        assert found == FaultIndices(0.0, 0.0, 1.0, 0.0, 1.0, 0.0)

    def test_without_a_time_before_there_is_no_false_rate(self) -> None:
        assert np.isnan(fault_indices([0.0, 1.0], bools("##"), ["x", "x"], "x", 0.0).r_fd)

    def test_a_fault_that_nobody_looked_at_is_refused(self) -> None:
        with pytest.raises(ValueError, match="no decision from 9 to 10 s"):
            fault_indices([0.0, 1.0], bools(".."), ["", ""], "x", 9.0, 10.0)

    @given(st.text("#.", min_size=2, max_size=40), st.integers(0, 30))
    def test_shares_are_shares_and_a_lasting_detection_is_one_at_the_end(self, text: str, onset: int) -> None:
        shown, t = bools(text), np.arange(float(len(text)))
        if onset < len(text):
            found = fault_indices(t, shown, ["x" if on else "" for on in shown], "x", float(onset))
            assert 0.0 <= found.r_td <= 1.0
            assert found.r_ti == found.r_td
            assert np.isfinite(found.t_dt) == shown[-1]
