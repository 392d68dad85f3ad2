"""A warm-up that nobody measures: its course is found, wear within it too, and what cannot be told apart is said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from warm_ups import HEALTHY, LOOP, PLAIN, warm_up

import servoscope as ss
from servoscope.baseline.covariates import CovariateModel, WarmUp
from servoscope.core.errors import BaselineError, LoopError, NotEnoughError
from servoscope.detection.warm_up import BlockSums, find_course, fit_course
from servoscope.export.constants import ExportConstants
from servoscope.simulation import FaultEvent, reference, simulate

WEAR = FaultEvent.parse("C_ie=1.1@30")


@pytest.fixture(scope="module")
def baseline() -> ss.Baseline:
    return ss.learn(LOOP, [warm_up(i, start, rise)[0] for i, (start, rise) in enumerate(HEALTHY)])


def toy(power: np.ndarray, seconds: float) -> BlockSums:
    """Sums of two coefficients that nobody has fitted yet, over blocks of given losses."""
    m = len(power)
    return BlockSums(np.tile(100.0 * np.eye(2), (m, 1, 1)), np.zeros((m, 2)), np.arange(m) * 100, power, seconds)


def test_the_course_solves_the_differential_equation() -> None:
    """An integrator of ordinary differential equations says the same of losses that change."""
    power, T, x = np.array([1.0, 1.0, 0.0, 0.0, 3.0, 3.0, 3.0, 1.0]), 2.5, np.array([0.2, 0.5, 0.7])
    solved = solve_ivp(
        lambda t, w: (x[1] + x[2] * power[min(int(t), 7)] / 2.0 - w) / T,
        (0.0, 8.0),
        [x[0]],
        t_eval=np.arange(8) + 0.5,
        max_step=0.01,
    )
    # in the middle of a block its straight chord is off by an eighth of what the decay within it bends
    assert toy(power, 1.0).basis(T, 2.0) @ x == pytest.approx(solved.y[0], abs=0.03)


def two_coefficients(slopes: tuple[float, float]) -> CovariateModel:
    """Return a model of two coefficients that move so with the warm-up, from cold (0) to warm (1)."""
    return CovariateModel(
        names=("warm_up",),
        low=(0.0,),
        high=(1.0,),
        degrees=(1,),
        proportional=(True, True),
        slopes=(slopes,),
        covariance=((0.0, 0.0), (0.0, 0.0)),
    )


@pytest.mark.parametrize("seen", [0.0, 1.0])
@pytest.mark.parametrize("blocks", [1, 3, 20, 3000])
def test_what_a_recording_does_not_show_stays_in_the_middle(seen: float, blocks: int) -> None:
    """A machine at rest, one that shows a single coefficient, and a day of a machine that is warm in seconds."""
    model = two_coefficients((-0.3, 0.1))
    theta, sums = np.array([1.0, 2.0]), toy(np.zeros(blocks), 1.0)
    normal = np.tile(np.diag([100.0 * seen, 0.0]), (blocks, 1, 1))
    sums = replace(sums, normal=normal, moment=normal @ model.theta(theta, np.array([[0.5]]))[0])
    fit, smallest = find_course(sums, WarmUp(time_constant_s=3.0, power=0.0, variance=1.0), theta, model)
    assert fit.course == pytest.approx(0.5) and not fit.jumps
    assert np.isfinite(fit.std).all() and (smallest < np.inf) == (seen > 0.0 and blocks > 5)


def test_a_machine_at_rest_says_nothing_of_its_warmth(baseline: ss.Baseline) -> None:
    moved, _ = warm_up(9, 30.0, 8.0)
    still = np.zeros(moved.samples)
    found = ss.diagnose(baseline, replace(moved, r=still, u=still, y=still))
    assert found.verdict == "undetermined"


def test_a_jump_is_found_where_it_is_and_leaves_the_course_alone() -> None:
    model = two_coefficients((0.5, -0.1))
    theta, known = np.array([2.0, 1.0]), WarmUp(time_constant_s=20.0, power=0.0, variance=1e-3)
    blank, rng = toy(np.zeros(60), 1.0), np.random.default_rng(0)
    true = blank.basis(20.0, 0.0) @ np.array([0.1, 0.8, 0.0])
    for size, jumps in ((0.0, ()), (0.2, (40,))):
        w = true + size * (np.arange(60) >= 40)
        noise = rng.normal(0.0, np.sqrt(1e-3 / 100.0), (60, 2))  # of least squares over a block
        sums = replace(blank, moment=100.0 * (model.theta(theta, w[:, None]) + noise))
        fit, smallest = find_course(sums, known, theta, model)
        assert fit.jumps == jumps
        assert np.abs(fit.course - true).max() < 5.0 * fit.std.max() < 0.1
        assert 0.0 < smallest < 0.05
        smooth = fit_course(sums, known, theta, model)
        assert (np.abs(smooth.course - true).max() > 0.05) == bool(jumps)


def test_learning_finds_time_constant_and_temperature(baseline: ss.Baseline) -> None:
    model = baseline.covariates
    assert model is not None
    assert model.warm_up is not None
    assert model.warm_up.time_constant_s == pytest.approx(60.0, rel=0.05)
    # theta_0 = C_ie k_p/(A_p K_q) thins by 4 % per kelvin; the range is that of means over two memories
    each = [warm_up(0, *one)[1][[500, -500]] for one in HEALTHY]
    cold, hot = (baseline.at({"warm_up": w}).theta[0] for w in (0.0, 1.0))
    assert np.log(hot / cold) == pytest.approx(0.04 * np.ptp(each), rel=0.03)


@pytest.mark.parametrize(("start", "rise"), [(36.0, 0.0), (33.0, 18.0)])
def test_warm_ups_are_healthy_and_wear_within_them_is_found(baseline: ss.Baseline, start: float, rise: float) -> None:
    healthy = ss.diagnose(baseline, warm_up(50, start, rise)[0])
    assert healthy.verdict == "healthy"
    (doubt,) = [str(one.description) for one in healthy.warnings if one.kind == "warm_up"]
    assert "a change of C_ie that began before the recording" in doubt
    worn = ss.diagnose(baseline, warm_up(51, start, rise, WEAR)[0])
    (fault,) = worn.faults
    assert fault.name == "leakage"
    assert fault.ratio == pytest.approx(1.1, rel=0.02)
    assert any("a jump of the temperature from" in str(one.description) for one in worn.warnings)


def test_a_change_of_another_kind_keeps_its_name(baseline: ss.Baseline) -> None:
    found = ss.diagnose(baseline, warm_up(52, 38.0, 12.0, FaultEvent.parse("p_s=0.9@30"))[0])
    assert [fault.name for fault in found.faults] == ["pump"]
    assert found.faults[0].ratio == pytest.approx(0.9, rel=0.01)


def test_what_cannot_be_told_apart_is_said(baseline: ss.Baseline) -> None:
    """A hotter machine and one that leaked before the recording give the same words, and no size is promised below."""
    hotter, worn = (
        ss.diagnose(baseline, warm_up(53, start, 5.0, *faults)[0])
        for start, faults in ((66.0, ()), (50.0, (FaultEvent.parse("C_ie=2@0"),)))
    )
    assert hotter.verdict == worn.verdict == "undetermined"
    for one in (hotter, worn):
        assert "wear from before the recording look alike" in str(one.headline)
    within = ss.diagnose(baseline, warm_up(54, 38.0, 12.0, FaultEvent.parse("C_ie=1.3@0"))[0])
    assert within.verdict == "healthy"


def test_who_cannot_carry_it_says_so(baseline: ss.Baseline, tmp_path: Path) -> None:
    with pytest.raises(BaselineError, match="hidden_warm_up = false"):
        ExportConstants.from_baseline(baseline)
    with pytest.raises(LoopError, match="not beside"):
        ss.Loop.from_dict({**LOOP.to_dict(), "columns": {"covariates": {"oil": "T_oil"}}})
    still = [simulate(PLAIN, reference("profile", 60.0, 100.0), seed=i)[0] for i in range(2)]
    with pytest.raises(NotEnoughError, match="start from cold"):
        ss.learn(LOOP, still)
    baseline.save(tmp_path / "baseline.json")
    assert ss.Baseline.load(tmp_path / "baseline.json") == baseline
    assert PLAIN.to_dict()["monitor"].get("hidden_warm_up") is None
