"""Simulation: agreement with independent recordings, stability, faults, limits and refusals."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from servoscope.core.errors import SimulationError
from servoscope.models.loop import Loop
from servoscope.simulation import FaultEvent, closed_loop_poles, reference, simulate, simulate_response
from servoscope.simulation.faults import schedule_plants

Array = npt.NDArray[np.float64]
TABLE_2 = [
    *(("p_s", x) for x in (0.6, 0.8, 1.2, 1.4)),
    *(("C_ie", x) for x in (1.1, 1.2, 1.3, 1.4)),
    *(("b_p", x) for x in (10.0, 20.0, 30.0, 40.0)),
    *(("beta", x) for x in (0.005, 0.01, 0.1, 10.0)),
]


def make(rig: dict[str, Any], **changes: Any) -> Loop:
    return Loop.from_dict(rig | changes, source="rig")


@pytest.fixture
def loop(rig: dict[str, Any]) -> Loop:
    return make(rig)


def load(path: Path) -> Array:
    return np.loadtxt(path, delimiter=",", skiprows=1).T


class TestAgainstRecordings:
    def test_every_case_differs_by_noise_only(self, loop: Loop, eha_cases: Path, eha_truth: Any) -> None:
        for name, case in eha_truth.items():
            if "defects" in case:
                continue
            _, r, u, y = load(eha_cases / name)
            plants = [loop.plant] + ([loop.plant.with_ratios(case["ratios"])] if case["ratios"] else [])
            u_free, y_free = simulate_response(loop, r, plants=plants, switch=[0, 3000][: len(plants)])
            for part in (slice(0, 3000), slice(3000, 6000)):
                assert 3.6e-4 < np.std(y[part] - y_free[part]) < 4.4e-4, name
                assert abs(np.mean(y[part] - y_free[part])) < 4e-5, name
                assert 7.2e-3 < np.std(u[part] - u_free[part]) < 8.8e-3, name

    def test_simulated_noise_is_that_of_the_recordings(self, loop: Loop, eha_cases: Path) -> None:
        _, r, u, y = load(eha_cases / "profile_healthy_0.csv")
        u_free, y_free = simulate_response(loop, r)
        recording, truth = simulate(loop, r, seed=3)
        assert np.std(recording.y - y_free) == pytest.approx(np.std(y - y_free), rel=0.05)
        assert np.std(recording.u - u_free) == pytest.approx(np.std(u - u_free), rel=0.05)
        assert np.std(recording.y - truth.y_true) == pytest.approx(np.sqrt(1e-7), rel=0.05)

    def test_the_controller_is_theirs(self, loop: Loop, eha_cases: Path) -> None:
        _, r, u, y = load(eha_cases / "multisine_b_px20_12.csv")
        assert 20.0 * (r - y) + 0.05 * np.cumsum(r - y) == pytest.approx(u, abs=1e-7)
        recording, _ = simulate(loop, r)
        e = recording.r - recording.y
        assert 20.0 * e + 0.05 * np.cumsum(e) == pytest.approx(recording.u, abs=1e-11)


class TestStability:
    @pytest.mark.parametrize(("parameter", "ratio"), TABLE_2)
    def test_faults_of_table_2(self, loop: Loop, parameter: str, ratio: float) -> None:
        poles = closed_loop_poles(loop, loop.plant.with_ratios({parameter: ratio}))
        assert np.abs(poles).max() < 1.0

    @pytest.mark.parametrize("change", [{}, {"hold": "foh"}, {"delay": 0.004}, {"delay": 0.013}, {"delay": 0.03}])
    def test_poles_rule_the_decay(self, rig: dict[str, Any], change: dict[str, Any]) -> None:
        loop = make(rig, controller={"kind": "pi", "k_p": 10.0, "k_i": 0.1}, **change)
        # After an impulse in r only the closed loop's own modes are left; its poles annihilate them.
        y = simulate_response(loop, np.eye(1, 400)[0])[1]
        characteristic = np.real(np.poly(closed_loop_poles(loop)))
        left = np.convolve(y, characteristic, mode="valid")[12:]
        assert np.abs(left).max() < 1e-9 * np.abs(y).max()

    def test_unstable_loop_is_refused_with_its_pole(self, rig: dict[str, Any]) -> None:
        loop = make(rig, controller={"kind": "pi", "k_p": 200.0, "k_i": 5.0})
        largest = np.abs(closed_loop_poles(loop)).max()
        with pytest.raises(SimulationError, match=f"magnitude {largest:.4f}"):
            simulate(loop, np.zeros(100))

    def test_the_fault_that_makes_it_unstable_is_named(self, rig: dict[str, Any]) -> None:
        loop = make(rig, controller={"kind": "pi", "k_p": 40.0, "k_i": 5.0})
        with pytest.raises(SimulationError, match="p_s x 9"):
            simulate(loop, np.zeros(100), faults=[FaultEvent("pump", 9.0, 0.5)])

    def test_no_controller(self, rig: dict[str, Any]) -> None:
        loop = make({key: value for key, value in rig.items() if key != "controller"})
        for ask in (closed_loop_poles, lambda loop: simulate_response(loop, np.zeros(9))):
            with pytest.raises(SimulationError, match="controller"):
                ask(loop)


class TestResponse:
    def test_steady_state(self, loop: Loop) -> None:
        u, y = simulate_response(loop, np.full(6000, 0.02))
        assert y[-1] == pytest.approx(0.02, rel=1e-5)
        assert u[-1] == pytest.approx(0.02 * loop.plant.theta()[0], rel=1e-3)

    def test_is_the_simulation_without_noise(self, loop: Loop) -> None:
        r = reference("multisine", 10.0, 100.0)
        faulty = loop.plant.with_ratios({"C_ie": 1.3})
        u, y = simulate_response(loop, r, plants=[loop.plant, faulty], switch=[0, 400])
        faults = [FaultEvent("C_ie", 1.3, 4.0)]
        recording, truth = simulate(loop, r, faults=faults, noise_u_std=0.0, noise_y_std=0.0)
        assert np.array_equal(recording.u, u)
        assert np.array_equal(truth.y_true, y)

    @pytest.mark.parametrize("switch", [(1,), (0, 5), ()])
    def test_switches_that_do_not_fit(self, loop: Loop, switch: tuple[int, ...]) -> None:
        with pytest.raises(SimulationError, match="switch"):
            simulate_response(loop, np.zeros(9), plants=[loop.plant], switch=switch)

    @pytest.mark.parametrize("r", [[], [[1.0, 2.0]], [1.0, np.nan]])
    def test_references_that_do_not_fit(self, loop: Loop, r: Any) -> None:
        with pytest.raises(SimulationError, match="reference"):
            simulate_response(loop, r)

    def test_delay_of_whole_samples_shifts_the_plant(self, rig: dict[str, Any]) -> None:
        r = np.eye(1, 50)[0]
        slow = {"kind": "pi", "k_p": 5.0, "k_i": 0.0}
        prompt, late = (simulate_response(make(rig, controller=slow, delay=d), r) for d in (0.0, 0.03))
        # Until the first feedback the delayed loop does the same, three samples later.
        assert np.all(late[1][:4] == 0.0)
        assert late[1][4] == pytest.approx(prompt[1][1], rel=1e-9)


class TestSimulate:
    def test_recording(self, loop: Loop) -> None:
        recording, truth = simulate(loop, reference("profile", 3.0, 100.0))
        assert (recording.samples, recording.sample_rate, recording.defects) == (300, 100.0, ())
        assert recording.restart.tolist() == [True] + [False] * 299
        assert np.array_equal(recording.t, truth.t)
        assert truth.theta.shape == (300, 4)

    def test_seeds(self, loop: Loop) -> None:
        r = reference("profile", 3.0, 100.0)
        first, again, other = (simulate(loop, r, seed=seed)[0] for seed in (7, 7, 8))
        assert np.array_equal(first.y, again.y) and np.array_equal(first.u, again.u)
        assert not np.array_equal(first.y, other.y)

    def test_truth_of_several_faults(self, loop: Loop) -> None:
        faults = [FaultEvent.parse("contamination=0.1@2"), FaultEvent.parse("C_ie=1.2@1.005")]
        _, truth = simulate(loop, np.zeros(300), faults=faults)
        assert [event.parameter for event in truth.faults] == ["C_ie", "beta"]
        assert truth.ratios["C_ie"][[0, 100, 101, 299]] == pytest.approx([1.0, 1.0, 1.2, 1.2])
        assert truth.ratios["beta"][[199, 200]] == pytest.approx([1.0, 0.1])
        assert truth.theta[150] == pytest.approx(loop.plant.with_ratios({"C_ie": 1.2}).theta())
        both = loop.plant.with_ratios({"C_ie": 1.2, "beta": 0.1})
        assert truth.theta[-1] == pytest.approx(both.theta())

    def test_ramp_is_straight_in_the_logarithm(self, loop: Loop) -> None:
        _, truth = simulate(loop, np.zeros(2000), faults=[FaultEvent("b_p", 100.0, 2.0, ramp_s=10.0)])
        ratio = np.interp(truth.t, [0.0, 2.0, 12.0, 20.0], np.log([1.0, 1.0, 100.0, 100.0]))
        assert np.abs(np.log(truth.ratios["b_p"]) - ratio).max() <= 0.051 * np.log(100.0) / 10.0
        assert truth.ratios["b_p"][199] == 1.0
        assert truth.ratios["b_p"][1200] == pytest.approx(100.0)

    def test_a_later_event_takes_over(self, loop: Loop) -> None:
        events = [FaultEvent("C_ie", 4.0, 1.0, ramp_s=2.0), FaultEvent("C_ie", 1.0, 2.0)]
        plan = schedule_plants(loop.plant, events, 400, 100.0)
        ratio = plan.ratios["C_ie"][plan.plant_index]
        assert ratio[199] == pytest.approx(2.0, rel=0.05)
        assert ratio[200:] == pytest.approx(1.0)

    @pytest.mark.parametrize(
        ("text", "event"),
        [
            ("C_ie=1.2@30", FaultEvent("C_ie", 1.2, 30.0)),
            ("beta = 0.1 @ 30 ~ 600", FaultEvent("beta", 0.1, 30.0, 600.0)),
            ("b_p=2e1", FaultEvent("b_p", 20.0, 0.0)),
        ],
    )
    def test_events_in_words(self, text: str, event: FaultEvent) -> None:
        assert FaultEvent.parse(text) == event
        assert FaultEvent.parse(str(event)) == event

    @pytest.mark.parametrize("text", ["", "C_ie", "C_ie=", "C_ie=x@3", "C_ie=-1@3", "C_ie=1.2@-3", "C_ie=nan"])
    def test_events_that_are_not(self, text: str) -> None:
        with pytest.raises(SimulationError, match="fault"):
            FaultEvent.parse(text)

    def test_events_that_do_not_fit_the_loop(self, loop: Loop) -> None:
        with pytest.raises(SimulationError, match="only p_s, C_ie, b_p, beta"):
            simulate(loop, np.zeros(100), faults=[FaultEvent("mass", 2.0, 0.0)])
        with pytest.raises(SimulationError, match="after the end"):
            simulate(loop, np.zeros(100), faults=[FaultEvent("C_ie", 2.0, 1.0)])

    def test_limits(self, rig: dict[str, Any]) -> None:
        r = reference("multisine", 5.0, 100.0)
        after = make(rig, input_limits=[-0.2, 0.15])
        before = make(rig, input_limits=[-0.2, 0.15], input_logged="before_limiter")
        (clipped, _), (asked, truth) = simulate(after, r), simulate(before, r)
        assert (clipped.u.min(), clipped.u.max()) == (-0.2, 0.15)
        assert asked.u.max() > 0.15
        assert np.array_equal(np.clip(asked.u, -0.2, 0.15), clipped.u)
        assert np.abs(truth.u_true - clipped.u).max() < 6e-4

    def test_nothing_passes_the_dead_zone(self, rig: dict[str, Any]) -> None:
        loop = make(rig, input_deadzone=[-0.1, 0.1])
        recording, truth = simulate(loop, reference("multisine", 5.0, 100.0), noise_u_std=0.0)
        inside = np.abs(recording.u) <= 0.1
        assert 0.05 < np.mean(inside) < 0.95
        assert np.all(truth.u_true[inside] == 0.0)
        assert np.array_equal(truth.u_true[~inside], recording.u[~inside])


def test_the_room_is_light() -> None:
    heavy = "{'numba', 'scipy.signal', 'scipy.linalg', 'pyarrow'}"
    code = f"import sys, servoscope.simulation; sys.exit(bool({heavy} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_loop_without_integrator_and_with_a_delay_has_the_poles_of_a_slow_integrator(rig: dict[str, Any]) -> None:
    p_only, slow = (
        np.sort_complex(closed_loop_poles(make(rig, delay=0.013, controller={"kind": "pi", "k_p": 2.0, "k_i": k_i})))
        for k_i in (0.0, 1e-9)
    )
    rest = np.delete(slow, int(np.argmin(np.abs(slow - 1.0))))
    np.testing.assert_allclose(p_only, rest, atol=1e-4)
