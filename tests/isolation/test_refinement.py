"""The refit: its predictor against the textbook, its bound against golden numbers, its answers against the truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import servoscope as ss
from servoscope.baseline.records import ExactPredictorFit
from servoscope.core.arrays import FloatArray
from servoscope.estimation.noise_model import WhiteNoise
from servoscope.isolation.ml import RefitResult, find_other_causes, fit_hypotheses
from servoscope.isolation.ml.hypothesis import SizePrior, fit_hypothesis
from servoscope.isolation.ml.onset import STEP, ChangeCosts
from servoscope.isolation.ml.validity import fit_exact_predictor
from servoscope.isolation.ml.window import SENSOR_GAIN, ChangeProfile, RefitWindow, plant_input
from servoscope.models.discretise import discretise, discretise_uncached
from servoscope.simulation import FaultEvent, reference, simulate
from servoscope.simulation.measurement import make_recording

AT = 20.0
NAMES = ("p_s", "C_ie", "b_p", "beta")


@pytest.fixture(scope="module")
def rig_loop(project: Path) -> ss.Loop:
    return ss.Loop.load(project / "src/servoscope/simulation/reference-rig.toml")


@pytest.fixture(scope="module")
def learned(rig_loop: ss.Loop) -> ss.Baseline:
    return ss.learn(rig_loop, [simulate(rig_loop, reference("multisine", 60.0, 100.0), seed=1)[0]])


@pytest.fixture(scope="module")
def record(rig_loop: ss.Loop) -> Callable[..., ss.Recording]:
    def made(*faults: str, kind: str = "multisine", seed: int = 2, seconds: float = 40.0) -> ss.Recording:
        events = [FaultEvent.parse(f"{fault}@{AT}" if "@" not in fault else fault) for fault in faults]
        return simulate(rig_loop, reference(kind, seconds, 100.0), faults=events, seed=seed)[0]

    return made


@pytest.fixture(scope="module")
def window(learned: ss.Baseline, record: Callable[..., ss.Recording]) -> RefitWindow:
    rec = record("C_ie=1.1", seconds=30.0)
    gap = rec.restart.copy()
    gap[1200] = True
    return RefitWindow.from_recording(learned, replace(rec, restart=gap), 0, rec.samples)


def refined(learned: ss.Baseline, rec: ss.Recording, announced: float = AT + 1.0) -> RefitResult:
    return fit_hypotheses(learned, rec, round(AT * 100) - 10, round(announced * 100), rec.samples - 1)


class TestPredictor:
    def test_it_is_the_textbooks_kalman_filter(self, window: RefitWindow) -> None:
        """Against matrices written out: time-varying gains, a plant that changes, a gap."""
        names, x, growth = ("C_ie", "b_p"), np.array([0.2, 1.5]), ChangeProfile(800)
        predictor = window.predictor(np.zeros(4), names, x, growth)
        got = window.innovations(predictor, growth)
        bench = window.factory
        plants = [window.plant, window.plant.with_ratios({"C_ie": np.exp(0.2), "b_p": np.exp(1.5)})]
        discrete = [discretise(plant.state_space(), 100.0) for plant in plants]
        first, T = bench.initial_covariance, bench.scale
        state, P = np.zeros(3), np.zeros((3, 3))
        e = np.empty(window.samples)
        for k in range(window.samples):
            d = discrete[int(k >= growth.onset)]
            if window.restart[k]:
                state, P = d.c * window.y[k], first * np.outer(T, T)
            S = d.c @ P @ d.c + bench.noise.y_std**2
            error = window.y[k] - d.c @ state
            gain = d.A @ P @ d.c / S
            e[k] = error / np.sqrt(S)
            state = d.A @ state + d.b_now * window.u[k] + gain * error
            P = d.A @ P @ d.A.T + bench.noise.u_std**2 * np.outer(d.b_now, d.b_now) - np.outer(gain, gain) * S
        factor = got[10] / e[10]  # the changed plant is a little louder, which the common factor makes up for
        assert factor == pytest.approx(1.0, abs=2e-3)
        assert got[:800] == pytest.approx(factor * e[:800], abs=1e-5)
        # the gains of the changed plant are its own from the first sample on: exact again once they have settled
        settled = np.r_[1100:1200, 1600 : window.samples]
        assert got[settled] == pytest.approx(factor * e[settled], abs=5e-3)

    @pytest.mark.parametrize("late", [0.0, 0.3, 1.4])
    def test_plants_are_sampled_as_the_exact_transition_says(self, window: RefitWindow, late: float) -> None:
        """Against the balanced exponential; imaginary parts are derivatives and as exact."""
        bench = window.factory
        step = {"C_ie": 3.0 + 1e-30j}
        for ratios in ({}, {"beta": 0.005}, {"b_p": 40.0}, step):
            plant = window.plant.scaled(ratios)
            got = bench.predictor(plant, later_s=late / 100.0)
            d = discretise_uncached(plant.state_space(), 100.0, "zoh", late / 100.0)
            expected = d.A * bench.scale / bench.scale[:, None], d.b_now / bench.scale, d.b_late / bench.scale
            parts = (got.A, got.b, got.b_late) if late < 1.0 else (got.A, got.b_late, got.b)
            for mine, exact in zip(parts, expected, strict=True):
                assert mine[0] == pytest.approx(exact, rel=0, abs=1e-13 * max(np.abs(exact).max(), 1e-300))
                if ratios is step:
                    assert mine[0].imag == pytest.approx(exact.imag, rel=0, abs=1e-13 * np.abs(exact.imag).max())

    @pytest.mark.parametrize("growth", [ChangeProfile(0), ChangeProfile(900), ChangeProfile(1100, 300)])
    def test_many_changes_at_once_are_each_of_them_alone(self, window: RefitWindow, growth: ChangeProfile) -> None:
        """Neighbours share the healthy plant and what it predicts up to the change: no bit of theirs may differ."""
        names, d = ("C_ie", SENSOR_GAIN), np.array([0.01, 0.0, -0.02, 0.005])
        z = np.array([[*(i // 2 * d), 0.1 * i, 0.02 - 0.01 * i] for i in range(5)])
        for each in (z, np.column_stack([np.tile(d, (5, 1)), z[:, 4:]])):  # some share a healthy plant, or all do
            alone = [window.innovations(window.predictor(row[:4], names, row[4:], growth), growth) for row in each]
            assert np.array_equal(window.residuals(each, names, growth)[:, : window.samples], alone)

    @pytest.mark.parametrize("drifts", [False, True])
    def test_sums_of_many_onsets_at_once_are_those_of_each_alone(self, window: RefitWindow, drifts: bool) -> None:
        """More changes than lanes, in any order, before, at and after a gap, up to the last sample."""
        rng, N = np.random.default_rng(3), window.samples
        onsets = np.concatenate([[1199, 1200, N - 1, 0], rng.integers(0, N, 46)])
        overs = rng.choice([20, 300, 900], len(onsets), p=[0.8, 0.1, 0.1]) if drifts else np.zeros_like(onsets)
        Q = np.linalg.qr(rng.normal(size=(N, 2)))[0]
        sums = window.change_sums(np.zeros(4), ("C_ie", "beta"), np.array([0.1, -0.3]), STEP, Q)
        together, volumes = sums(onsets, overs)
        for i in range(len(onsets)):
            (alone,), (volume,) = sums(onsets[i : i + 1], overs[i : i + 1])
            assert np.array_equal(together[i], alone) and volumes[i] == volume

    def test_derivatives_by_complex_steps_are_those_of_differences(self, window: RefitWindow) -> None:
        z, growth = np.array([0.01, -0.01, 0.02, 0.0, 0.1, -0.3]), ChangeProfile(900, 300)
        names, h = ("C_ie", "beta"), 1e-5
        J = window.jacobian(z, names, growth)
        for i, e in enumerate(np.eye(6)):
            both = [window.residual(z + s * h * e, names, growth) for s in (1.0, -1.0)]
            difference = (both[0] - both[1]) / (2.0 * h)
            assert J[:, i] == pytest.approx(difference, abs=1e-5 * np.abs(difference).max())

    def test_healthy_innovations_are_white_with_unit_variance(
        self, learned: ss.Baseline, record: Callable[..., ss.Recording]
    ) -> None:
        rec = record(kind="profile", seconds=120.0, seed=5)
        window = RefitWindow.from_recording(learned, rec, 0, rec.samples)
        e = window.innovations(window.healthy, ChangeProfile(rec.samples))[50:]
        correlations = np.array([e[lag:] @ e[:-lag] / (e @ e) for lag in range(1, 21)])
        assert e.var() == pytest.approx(1.0, abs=0.05)  # the baseline's own noise is known to 2 %
        assert np.abs(correlations).max() < 4.0 / np.sqrt(len(e))

    def test_the_bound_is_that_of_the_theory(self, rig_loop: ss.Loop) -> None:
        """How-it-works, "Refit": 10 s of the profile, one parameter alone and all four free, in per cent."""
        learned = ss.learn(rig_loop, [simulate(rig_loop, reference("profile", 60.0, 100.0), seed=1)[0]])
        paper = ExactPredictorFit(noise=WhiteNoise(1e-4, float(np.sqrt(1e-7))), misfit=0.0)
        known = learned.model_copy(
            update={"healthy": learned.healthy.model_copy(update={"ratios": {}, "covariance": ()}), "exact": paper}
        )
        quiet, _ = simulate(rig_loop, reference("profile", 60.0, 100.0), noise_u_std=0.0, noise_y_std=0.0)
        window = RefitWindow.from_recording(known, quiet, 0, quiet.samples)
        J = window.jacobian(np.zeros(4), NAMES, ChangeProfile(0))[1000:] / np.sqrt(5.0)  # 50 s of it stand for 10 s
        alone, free = 1.0 / np.linalg.norm(J, axis=0), np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
        assert 100.0 * alone == pytest.approx([0.07, 0.06, 5.9, 2.2], rel=0.12)
        assert 100.0 * free == pytest.approx([0.65, 0.33, 41.0, 2.7], rel=0.1)

    def test_what_acts_is_what_passes_limits_and_dead_zone(self, rig_loop: ss.Loop) -> None:
        u = np.array([-3.0, -0.05, 0.0, 0.05, 3.0])
        limits = {"input_logged": "before_limiter", "input_limits": (-1.0, 2.0), "input_deadzone": (-0.1, 0.1)}
        assert plant_input(rig_loop.model_copy(update=limits), u).tolist() == [-1.0, 0.0, 0.0, 0.0, 2.0]
        assert plant_input(rig_loop, u).tolist() == u.tolist()

    @pytest.mark.parametrize("delay", [0.01, 0.004, 0.0125])
    @pytest.mark.slow
    def test_a_delay_of_any_fraction_is_part_of_it(self, rig_loop: ss.Loop, delay: float) -> None:
        late = rig_loop.model_copy(update={"delay": delay})
        healthy = ss.learn(late, [simulate(late, reference("multisine", 60.0, 100.0), seed=1)[0]])
        assert healthy.exact is not None and healthy.exact.misfit < 1.0


@pytest.mark.parametrize(("fault", "ratio"), [("C_ie", 5.5), ("C_ie", 10.0), ("p_s", 0.29)])
def test_a_fault_beyond_its_range_is_no_pair(
    learned: ss.Baseline, record: Callable[..., ss.Recording], fault: str, ratio: float
) -> None:
    """Leakage x 5.5 was 'pump x 0.917 and leakage x 5.000' at probability 1, and x 10 was unknown."""
    best = refined(learned, record(f"{fault}={ratio}")).best
    assert best.fitted.names == (fault,) and best.probability > 0.9
    assert np.exp(best.fitted.x[0]) == pytest.approx(ratio, rel=0.005)


def brute(
    window: RefitWindow, names: tuple[str, ...], x: FloatArray, d: FloatArray, growth: ChangeProfile, Q: FloatArray
) -> float:
    """The smallest sum of squares with sizes and healthy parameters by one linear step, from whole passes."""

    def e(x: FloatArray) -> FloatArray:
        predictor = window.predictor(d, names, x, growth)
        return np.concatenate([np.asarray(window.innovations(predictor, growth)), window.prior @ d])

    here = e(x)
    own = np.column_stack([(e(x + STEP * one) - here) / STEP for one in np.eye(len(x))])
    J = np.column_stack([Q, own])
    step = np.linalg.lstsq(J, here, rcond=None)[0]
    return float(((here - J @ step) ** 2).sum())


@pytest.mark.parametrize("names", [("C_ie",), ("C_ie", "b_p")])
def test_the_sweep_is_what_whole_passes_give(window: RefitWindow, names: tuple[str, ...]) -> None:
    faults = [fault for fault in window.plant.faults if fault.parameter in names]
    x = np.full(len(names), 0.1)
    found = fit_hypothesis(window, faults, ChangeProfile(2000), np.zeros(4), [x], free=True)
    table = ChangeCosts(window, found, 1.0)
    Q, _ = np.linalg.qr(window.jacobian(np.concatenate([found.d, found.x]), names, found.profile, slice(4)))
    for onsets, overs in (([1500, 1990, 2000, 2500], [0] * 4), ([1500, 1900], [300, 40])):
        got, _ = table.costs(np.array(onsets), np.array(overs))
        for cost, onset, over in zip(got, onsets, overs, strict=True):
            assert cost == pytest.approx(
                brute(window, names, found.x, found.d, ChangeProfile(onset, over), Q), rel=1e-3
            )


class TestAnswers:
    @pytest.mark.parametrize(
        ("fault", "kind", "size"),
        [("C_ie=1.02", "multisine", 0.005), ("p_s=0.98", "profile", 0.005), ("b_p=20", "profile", 0.2),
         ("beta=0.1", "multisine", 0.06), ("b_p=10", "trapezoid", 0.2)],
    )  # fmt: skip
    def test_single_faults_by_name_size_and_onset(
        self, learned: ss.Baseline, record: Callable[..., ss.Recording], fault: str, kind: str, size: float
    ) -> None:
        parameter, ratio = fault.split("=")
        found = refined(learned, record(fault, kind=kind), AT + 6.0)
        assert (
            found.best.fitted.names == (parameter,)
            and found.best.probability > 0.95
            and found.unknown_probability < 0.05
        )
        ((low, high),) = np.exp(found.best.evidence.intervals)
        assert np.exp(found.best.fitted.x[0]) == pytest.approx(float(ratio), rel=size)
        assert low < float(ratio) < high
        assert found.onset.low <= AT * 100 <= found.onset.high and found.goodness.statistic < found.goodness.limit

    @pytest.mark.parametrize(
        ("first", "second", "kind"), [("p_s=0.8", "C_ie=1.2", "multisine"), ("b_p=20", "beta=0.1", "profile")]
    )
    def test_two_at_once_are_both_named_and_their_covariance_holds(
        self, learned: ss.Baseline, record: Callable[..., ss.Recording], first: str, second: str, kind: str
    ) -> None:
        found = refined(learned, record(first, second, kind=kind))
        assert " + ".join(found.best.fitted.names) == f"{first.split('=')[0]} + {second.split('=')[0]}"
        assert found.best.probability > 0.99
        off = found.best.fitted.x - np.log([float(one.split("=")[1]) for one in (first, second)])
        assert (
            off @ np.linalg.solve(found.noise_variance * found.best.fitted.covariance, off) < 13.8
        )  # 99.9 % of chi-square

    def test_a_drift_is_one_and_its_beginning_is_found(
        self, learned: ss.Baseline, record: Callable[..., ss.Recording]
    ) -> None:
        found = refined(learned, record("C_ie=1.3@15~10"), 20.0)
        growth = found.onset.profile
        assert found.best.fitted.names == ("C_ie",) and found.onset.low <= 1500 <= found.onset.high
        assert growth.duration == pytest.approx(1000, abs=150) and found.onset.high - found.onset.low < 300
        assert np.exp(found.best.fitted.x[0]) == pytest.approx(1.3, rel=0.01)

    def test_sizes_scatter_as_little_as_the_bound_allows(
        self, learned: ss.Baseline, record: Callable[..., ss.Recording]
    ) -> None:
        """Twenty seeds, onset known: chi-square of the errors in standard deviations of the covariance claimed."""
        (leakage,) = (fault for fault in learned.plant.faults if fault.parameter == "C_ie")
        z = []
        for seed in range(20):
            rec = record("C_ie=1.1", seed=seed + 10, seconds=30.0)
            window = replace(RefitWindow.from_recording(learned, rec, 0, rec.samples), plant=learned.loop.plant)
            found = fit_hypothesis(
                window, [leakage], ChangeProfile(round(AT * 100)), np.zeros(4), [np.zeros(1)], free=True
            )
            z.append((found.x[0] - np.log(1.1)) / np.sqrt(found.covariance[0, 0]))
        assert 7.4 < float(np.square(z).sum()) < 40.0  # 0.5 and 99.5 % of chi-square with 20 degrees of freedom

    def test_the_prior_is_one_and_alike_for_all_faults(self, window: RefitWindow) -> None:
        for fault in window.plant.faults:
            scale = SizePrior.from_window(window, fault, ChangeProfile(2000))
            low, high = np.log(fault.ratio_range)
            x = np.concatenate([-np.geomspace(1e-9, -low, 4000)[::-1], np.geomspace(1e-9, high, 4000)])
            density = np.exp(scale.log_density(x))
            assert np.trapezoid(density, x) == pytest.approx(1.0, abs=1e-3)


def odd_loop(
    loop: ss.Loop,
    *,
    late: bool = False,
    gain: float = 1.0,
    play: float = 0.0,
    load: float = 0.0,
    offset: float = 0.0,
    **ratios: float,
) -> ss.Recording:
    """The reference rig sample by sample, with changes at `AT` that no fault of the plant stands for."""
    samples, rng = 4000, np.random.default_rng(7)
    r = reference("multisine", samples / 100.0, 100.0)
    n_u, n_y = 1e-4 * rng.standard_normal(samples), np.sqrt(1e-7) * rng.standard_normal(samples)
    healthy, ill = (discretise(p.state_space(), 100.0) for p in (loop.plant, loop.plant.scaled(ratios)))
    x, total, before, sensor = np.zeros(3), 0.0, 0.0, 0.0
    u, y = np.empty(samples), np.empty(samples)
    for k in range(samples):
        changed = k >= AT * 100
        d = ill if changed else healthy
        half, moved = play / 2.0 if changed else 0.0, float(d.c @ x)
        sensor = min(max(sensor, moved - half), moved + half)
        y[k] = (gain if changed else 1.0) * sensor + offset * changed + n_y[k]
        e = r[k] - y[k]
        total += 5.0 * 0.01 * e
        u[k] = 20.0 * e + total
        x = d.A @ x + d.b_now * ((before if late and changed else u[k]) + load * changed + n_u[k])
        before = u[k]
    return make_recording(loop, r, u, y)


class TestOutsideTheList:
    @pytest.mark.parametrize(
        ("change", "cause", "value"),
        [
            *(({"late": True}, "delay", 0.01), ({"A_p": 1.1}, "A_p", 1.1), ({"A_p": 0.9}, "A_p", 0.9)),
            ({"play": 0.002}, "backlash", 0.002),
        ],
    )
    def test_what_nothing_imitates_is_unknown_and_its_cause_offered(
        self, learned: ss.Baseline, rig_loop: ss.Loop, change: dict[str, float], cause: str, value: float
    ) -> None:
        found = refined(learned, odd_loop(rig_loop, **change))  # type: ignore[arg-type]
        assert found.unknown_probability > 0.99
        likeliest = find_other_causes(found)[0]
        assert likeliest.name == cause and likeliest.value == pytest.approx(value, rel=0.02)

    @pytest.mark.parametrize(
        ("change", "imitated", "cause", "value"),
        [({"gain": 1.03}, "pump", SENSOR_GAIN, 1.03), ({"k_p": 0.8}, "leakage", "k_p", 0.8)],
    )
    def test_what_a_fault_imitates_is_told_beside_it(
        self, learned: ss.Baseline, rig_loop: ss.Loop, change: dict[str, float], imitated: str, cause: str, value: float
    ) -> None:
        said = ss.diagnose(learned, odd_loop(rig_loop, **change))  # type: ignore[arg-type]
        assert said.candidates[0].name == imitated and said.refit is not None
        (told,) = (mimic for mimic in said.refit.mimics if mimic.name == cause)
        assert told.value == pytest.approx(value, rel=0.01)
        assert told.words.casefold() in said.summary.casefold() and told.words in said.explanation[-1]

    @pytest.mark.parametrize(
        ("change", "cause"),
        [({"load": 3e-4}, "input_offset"), ({"offset": 5e-4}, "sensor_offset"), ({"late": True}, "delay")],
    )
    def test_the_cause_that_explains_it_dates_it(
        self, learned: ss.Baseline, rig_loop: ss.Loop, change: dict[str, float], cause: str
    ) -> None:
        """Not the faults that do not: their onset was up to seconds off, or a course of several faults was told."""
        said = ss.diagnose(learned, odd_loop(rig_loop, **change))  # type: ignore[arg-type]
        (one,) = said.intervals
        assert not one.faults and one.refit is not None and one.onset_s is not None
        assert one.refit.mimics[0].name == cause
        low, likely, high = one.onset_s
        assert low <= AT <= high + 0.01 and high - low < 1.0 and likely == pytest.approx(AT, abs=0.2)


class TestGate:
    def test_a_delay_that_the_loop_file_does_not_know_closes_it(self, rig_loop: ss.Loop) -> None:
        late = rig_loop.model_copy(update={"delay": 0.002})
        rec = simulate(late, reference("multisine", 60.0, 100.0), seed=1)[0]
        learned = ss.learn(rig_loop, [rec])
        assert learned.exact is not None and learned.exact.misfit > 1.0
        assert any("without a refit" in str(note) for note in learned.notes)
        ill = simulate(late, reference("multisine", 40.0, 100.0), faults=[FaultEvent("C_ie", 1.3, AT)], seed=2)[0]
        said = ss.diagnose(learned, ill)
        assert said.verdict == "fault" and said.refit is None and said.explanation

    def test_it_needs_a_linear_plant_a_held_input_and_noise(
        self, learned: ss.Baseline, record: Callable[..., ss.Recording]
    ) -> None:
        rec, loop = record(), learned.loop.to_dict()
        assert fit_exact_predictor(learned, [rec]) is not None
        for changes in ({"hold": "foh"}, {"plant": {**loop["plant"], "coulomb": 10.0}}):
            other = learned.model_copy(update={"loop_settings": {**loop, **changes}})
            vars(other).pop("loop", None)
            assert fit_exact_predictor(other, [rec]) is None
        unknown = learned.healthy.model_copy(update={"noise": None})
        assert fit_exact_predictor(learned.model_copy(update={"healthy": unknown}), [rec]) is None
