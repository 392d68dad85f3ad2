"""A size over weeks: when it reaches its limit, and when nothing can be said."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal
from typer.testing import CliRunner

from servoscope.cli import app
from servoscope.core.errors import PrognosisError
from servoscope.prognosis.forecast import DAY_S, Prognosis, draw_passages, prognose, shortest_interval
from servoscope.prognosis.series import SizeSeries, read_sizes
from servoscope.prognosis.wear import Courses, WearPosterior, filter_series, fit_wear, scale_series

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
from studies import prognosis as study

LIMIT = 1.5


def wear(days: float = 100.0, count: int = 60, rate: float = 0.002, std: float = 0.003, seed: int = 0) -> SizeSeries:
    """Return a ratio that grows from 1 by `rate` per day."""
    t = np.linspace(0.0, days, count)
    noise = std * np.random.default_rng(seed).standard_normal(count)
    return SizeSeries.from_arrays("leakage", t * DAY_S, 1.0 + rate * t + noise, np.full(count, std))


class TestForecast:
    def test_steady_wear_reaches_the_limit_when_the_line_does(self) -> None:
        found = prognose(wear(), LIMIT)
        assert found.outlook == "forecast" and found.remaining_s is not None and found.rate_per_day is not None
        low, middle, high = (each / DAY_S for each in found.remaining_s if each is not None)
        assert low <= 150.0 <= high and middle == pytest.approx(150.0, rel=0.1)
        assert found.rate_per_day[0] <= 0.002 <= found.rate_per_day[2]
        assert found.summary.startswith("leakage reaches 1.5 in ") and "weeks" in found.summary

    def test_a_falling_size_reaches_a_limit_below(self) -> None:
        rising = wear()
        falling = SizeSeries("p_s", rising.t, 2.0 - rising.value, rising.std)
        up, down = prognose(rising, 1.5), prognose(falling, 0.5)
        assert up.remaining_s is not None and down.remaining_s is not None
        assert down.remaining_s[1] == pytest.approx(up.remaining_s[1], rel=0.05)

    def test_nothing_is_said_without_wear(self) -> None:
        found = prognose(wear(rate=0.0), LIMIT)
        assert found.outlook == "none" and found.remaining_s is None
        assert "no lasting change" in found.summary

    def test_nothing_is_said_of_a_size_that_moves_away(self) -> None:
        assert "moves away" in prognose(wear(rate=-0.002), LIMIT).summary

    def test_nothing_is_said_of_seven_values(self) -> None:
        assert "7 values, 8 are needed" in prognose(wear(count=7), LIMIT).summary

    def test_a_limit_behind_is_reached(self) -> None:
        found = prognose(wear(), 1.1)
        assert found.outlook == "reached" and "has reached 1.1" in found.summary

    def test_a_repair_begins_a_new_history(self) -> None:
        before, after = wear(), wear(seed=1)
        t = np.concatenate([before.t, before.t[-1] + DAY_S + after.t])
        both = SizeSeries.from_arrays("leakage", t, np.concatenate([before.value, after.value]))
        found = prognose(both.after(before.t[-1] + 1.0), LIMIT)
        assert found.remaining_s is not None and found.remaining_s[1] is not None
        assert found.remaining_s[1] / DAY_S == pytest.approx(150.0, rel=0.15)

    def test_temperature_is_taken_out(self) -> None:
        """A spring alone would look like wear."""
        series = wear(rate=0.0)
        warm = 10.0 * (1.0 - np.cos(series.t / DAY_S / 100.0 * np.pi / 2.0))
        shown = SizeSeries("leakage", series.t, series.value + 0.01 * warm, series.std)
        assert prognose(shown, LIMIT).outlook == "forecast"
        with_cause = SizeSeries("leakage", shown.t, shown.value, shown.std, {"temperature": warm})
        found = prognose(with_cause, LIMIT)
        assert found.outlook == "none"
        low, _, high = found.effects["temperature"]
        assert low <= 0.01 <= high

    def test_the_interval_is_the_shortest_that_holds_its_share(self) -> None:
        draws = np.random.default_rng(0).gamma(2.0, size=400)
        spans = [(b - a, a, b) for a in draws for b in draws if b > a and np.mean((draws >= a) & (draws <= b)) >= 0.9]
        low, middle, high = shortest_interval(draws, 0.9)
        assert (low, high) == min(spans)[1:] and np.mean(draws <= middle) == 0.5
        seldom = np.where(np.arange(400) % 5 == 0, math.inf, draws)  # a fifth never gets there
        low, _, high = shortest_interval(seldom, 0.9)
        assert math.isinf(high) and np.mean(seldom < low) == pytest.approx(0.1, abs=0.003)

    def test_same_values_same_sentence(self) -> None:
        assert prognose(wear(), LIMIT) == prognose(wear(), LIMIT)

    @settings(max_examples=5, deadline=None)
    @given(st.floats(1e-3, 1e3), st.floats(-1e3, 1e3), st.floats(0.1, 100.0))
    def test_units_and_offset_change_nothing(self, scale: float, offset: float, slower: float) -> None:
        one = wear(count=20)
        other = SizeSeries("x", slower * one.t + 1e9, offset + scale * one.value, scale * one.std)
        a, b = prognose(one, LIMIT), prognose(other, offset + scale * LIMIT)
        assert a.remaining_s is not None and b.remaining_s is not None
        assert np.array(b.remaining_s) / slower == pytest.approx(np.array(a.remaining_s), rel=0.02)

    def test_is_read_back_from_its_json(self) -> None:
        found = prognose(wear(), LIMIT)
        written = json.loads(found.model_dump_json())
        fields = {name: value for name, value in written.items() if name in Prognosis.model_fields}
        assert Prognosis.model_validate(fields).remaining_s == found.remaining_s


class TestWear:
    def test_likelihood_is_that_of_the_joint_normal_law(self) -> None:
        """The filter against the covariance of all values at once."""
        rng = np.random.default_rng(3)
        t = np.sort(rng.uniform(0.0, 10.0, 6))
        series = SizeSeries("x", t, rng.standard_normal(6), np.full(6, 0.4), {"warm": rng.standard_normal(6)})
        scaled, *_ = scale_series(series)
        courses = Courses(*(np.array([value]) for value in (0.3, 1.7, 1.2, 0.05, 0.0, 1.1)))
        found, *_ = filter_series(courses, scaled)
        clock = np.array([courses.clock(each)[0] for each in scaled.t])
        diffusion = 0.05**2 * np.minimum.outer(clock, clock)
        warm = scaled.inputs[0]
        joint = 10.0**2 + 2.0**2 * np.outer(clock, clock) + diffusion + np.outer(warm, warm)
        joint += np.diag(1.1**2 * scaled.R)
        truth = multivariate_normal(np.zeros(6), joint).logpdf(scaled.y)
        assert found[0] - 3.0 * math.log(2.0 * math.pi) == pytest.approx(truth, rel=1e-9)

    def test_first_passage_has_the_inverse_gaussian_law(self) -> None:
        """Of a Wiener process with drift: mean a / v, variance a sigma^2 / v^3 (Chhikara and Folks 1989, 2.1)."""
        one = np.array([1.0])
        courses = Courses(0.0 * one, one, 0.0 * one, 0.2 * one, 0.0 * one, one)
        posterior = WearPosterior(courses, one, np.array([[0.0, 1.0]]), np.zeros((1, 2, 2)), 9.0, 0.0, 1.0, 1.0)
        passage = draw_passages(posterior, 1.0, np.random.default_rng(0)).passage
        assert passage.mean() == pytest.approx(1.0, rel=0.02)
        assert passage.var() == pytest.approx(0.04, rel=0.15)

    def test_odds_of_a_history_without_wear_are_low(self) -> None:
        odds = [fit_wear(wear(rate=0.0, seed=seed), np.random.default_rng(0)).log_odds for seed in range(5)]
        assert max(odds) < math.log(20.0)


class TestSeries:
    def test_rows_are_sorted_and_gaps_left_out(self) -> None:
        found = SizeSeries.from_arrays("x", [3.0, 1.0, 2.0], [30.0, 10.0, math.nan])
        assert found.t.tolist() == [1.0, 3.0] and found.value.tolist() == [10.0, 30.0]

    def test_means_of_spans_keep_what_is_certain(self) -> None:
        series = wear(count=1000)
        thinned = series.thinned(100)
        assert thinned.t.size == 100
        assert thinned.std == pytest.approx(0.003 / math.sqrt(10.0), rel=0.1)
        assert thinned.value.mean() == pytest.approx(series.value.mean(), rel=1e-3)

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ("", "is empty"),
            ("time,size\n1,2\n", "has no column 'leakage'"),
            ("time,leakage\n2026-01-01,1\nyesterday,2\n", "row 3, column time: 'yesterday'"),
            ("time,leakage\n2026-01-01,1\n2026-01-02,1.2x\n", "row 3, column leakage: '1.2x'"),
            ("time,leakage\n2026-01-01,1\n\nyesterday,2\n", "row 4, column time: 'yesterday'"),
            ("leakage,time\n1,2026-01-01\n2\n", "row 3, column time: ''"),
            ("time,leakage\n2026-01-01,\n", "has no row in which all values are numbers"),
        ],
    )
    def test_errors_name_file_row_and_column(self, tmp_path: Path, text: str, words: str) -> None:
        path = tmp_path / "sizes.csv"
        path.write_text(text)
        with pytest.raises(PrognosisError, match=words):
            read_sizes(path, "leakage")

    def test_dates_and_intervals_are_read(self, tmp_path: Path) -> None:
        path = tmp_path / "sizes.csv"
        path.write_text("time,leakage,low,high\n2026-01-01,1.0,0.9,1.1\n2026-01-01T01:00+01:00,1.2,1.1,1.3\n")
        found = read_sizes(path, "leakage", interval=("low", "high"))
        assert found.t.tolist() == [1767225600.0, 1767225600.0]
        assert found.std == pytest.approx(0.1 / 1.96, rel=1e-3)


class TestCommand:
    def test_forecast_from_a_file(self, tmp_path: Path) -> None:
        series, path = wear(), tmp_path / "sizes.csv"
        rows = [f"{t},{value},0.003" for t, value in zip(series.t, series.value, strict=True)]
        path.write_text("\n".join(["time,leakage,std", *rows]))
        arguments = ["trend", str(path), "--value", "leakage", "--std", "std", "--limit", "1.5"]
        plot = tmp_path / "trend.svg"
        shown = CliRunner().invoke(app, [*arguments, "--plot", str(plot)])
        assert shown.exit_code == 0 and "leakage reaches 1.5 in" in shown.output
        assert plot.stat().st_size > 1000
        as_json = json.loads(CliRunner().invoke(app, [*arguments, "--json"]).stdout)
        assert as_json["remaining_s"] == list(prognose(read_sizes(path, "leakage", std="std"), 1.5).remaining_s or ())

    def test_column_is_asked_for(self, tmp_path: Path) -> None:
        (tmp_path / "sizes.csv").write_text("time,leakage\n0,1\n")
        shown = CliRunner().invoke(app, ["trend", str(tmp_path / "sizes.csv"), "--limit", "2"])
        assert shown.exit_code == 2 and "--value NAME" in shown.output


@pytest.mark.slow
def test_intervals_hold_on_the_courses_of_the_study() -> None:
    """A part of benchmarks/studies/prognosis.py: 90 % intervals, and silence where nothing wears."""
    courses = [study.course(seed, study.KINDS[seed % 4], temperature=bool(seed // 4 % 2)) for seed in range(8)]
    given_share, held, _, _ = study.score([each for each in courses if math.isfinite(each.life)], study.ours)
    assert float(given_share) > 95.0 and float(held) > 75.0
    assert all(study.is_silent(seed, study.ours) for seed in range(2))
