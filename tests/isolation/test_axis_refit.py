"""Motor axes with friction: the filter against a loop, sums against passes, measured recordings with known changes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from accuracy.axis import AXES, moves, record
from accuracy.axis import loop as axis_loop
from public.output_error import fit_output_error
from scipy.signal import lfilter

import servoscope as ss
from servoscope.baseline.axis_model import AxisModel
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import LoopError
from servoscope.core.jit import sine
from servoscope.estimation.axis_filter import AxisFilter, AxisNoise, AxisSignals
from servoscope.isolation.axis_change import find_axis_change
from servoscope.isolation.ml.axis_vibration import FALSE_ALARMS, MIN_EDGE_SHARE, find_vibration, scan_limit
from servoscope.isolation.ml.axis_window import AxisWindow
from servoscope.isolation.ml.hypothesis import fit_hypothesis
from servoscope.isolation.ml.window import ChangeProfile
from servoscope.learning.axis_fit import fit_axis
from servoscope.models.plants.axis import AxisPlant
from servoscope.simulation import FaultEvent, simulate
from servoscope.simulation.tutorial import AXIS

LOOP: dict[str, Any] = {
    "sample_rate": 1000.0,
    "columns": {"time": "t", "reference": "qg", "input": "vir", "output": "qm"},
    "plant": {"kind": "axis", "terms": ["viscous_by_direction", "coulomb", "offset"], "input_gain": 35.15},
    "monitor": {"cutoff": 10.0},
}
NOISE = AxisNoise(0.3, 0.02, 1e-4)


def random_signals(N: int = 300) -> AxisSignals:
    rng = np.random.default_rng(0)
    y = np.cumsum(np.cumsum(rng.normal(size=N))) * 1e-3
    restart = np.zeros(N, dtype=np.bool_)
    restart[[0, N // 2]] = True
    return AxisSignals(rng.normal(size=N), y, restart, 100.0)


@pytest.fixture
def window() -> AxisWindow:
    return window_of(random_signals())


@pytest.fixture(scope="module")
def long_window() -> AxisWindow:
    """A minute at 100 Hz, of a motion with a period of five seconds."""
    y, restart = np.sin(np.arange(6000) * 0.004 * np.pi), np.zeros(6000, dtype=np.bool_)
    return window_of(AxisSignals(np.zeros(6000), y, restart, 100.0))


def window_of(signals: AxisSignals) -> AxisWindow:
    plant = AxisPlant.model_validate({"terms": ("viscous", "coulomb", "offset"), "coefficients": {
        "inertia": 2.0, "viscous_friction": 1.0, "coulomb_friction": 0.5, "offset": 0.1}})  # fmt: skip
    model = AxisModel(
        coefficients=plant.coefficients or {},
        parameters=("inertia", "viscous_friction", "coulomb_friction"),
        covariance=((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.01)),
        noise=NOISE,
        stride=1,
        rest_speed=0.01,
        offset_std=0.1,
        drift_std=0.1,
    )
    loop = ss.Loop.from_dict({"sample_rate": 100.0, "plant": {"kind": "axis"}})
    N = len(signals.y)
    t, r, run = np.arange(N) / 100.0, np.zeros(N), np.zeros(N, dtype=np.int32)
    recording = ss.Recording(
        t=t, r=r, u=signals.u, y=signals.y, restart=signals.restart, name="random", sample_rate=100.0, run=run
    )
    return AxisWindow.of_healthy(loop, model, recording)


class TestFilter:
    @pytest.mark.parametrize("derivative", [0, 1])
    def test_it_is_the_textbooks_kalman_filter(self, derivative: int) -> None:
        """Prediction and correction in turns, each run from rest, until gain and variance are steady."""
        from scipy.linalg import expm

        signals, T = random_signals(), 0.01
        made = AxisFilter.design(NOISE, 1.0 / T, derivative)
        A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0 / NOISE.correlation_s]])
        Phi, fine = expm(A * T), 2000
        # the force's noise, added up in small steps
        small, Q = expm(A * T / fine), np.zeros((3, 3))
        q = np.diag([0.0, 0.0, 2.0 * NOISE.acceleration_std**2 / NOISE.correlation_s]) * T / fine
        for _ in range(fine):
            Q = small @ (Q + 0.5 * q) @ small.T + 0.5 * q
        known = slice(derivative, None)  # of a speed, the position is no state
        Phi, Q, B = Phi[known, known], Q[known, known], np.array([0.5 * T**2, T, 0.0])[known]
        P = Q
        for _ in range(2000):
            K = Phi @ P[:, 0] / (P[0, 0] + NOISE.y_std**2)
            P = Phi @ P @ Phi.T + Q - np.outer(K, K) * (P[0, 0] + NOISE.y_std**2)
        assert made.variance == pytest.approx(P[0, 0] + NOISE.y_std**2, rel=1e-5)
        expected = np.empty(len(signals.y))
        for k, (u, y) in enumerate(zip(signals.u, signals.y, strict=True)):
            if signals.restart[k]:
                x = np.array([y, 0.0, 0.0])[: 3 - derivative]
            expected[k] = y - x[0]
            x = Phi @ x + B * u + K * expected[k]
        found = made.of_output(signals.y, signals.runs) - made.of_acceleration(signals.u, signals.runs)
        assert found == pytest.approx(expected, abs=1e-6 * np.abs(expected).max())

    def test_the_sine_of_the_monitor_is_one(self) -> None:
        angles = np.linspace(-1999.0, 1999.0, 4001)
        assert np.array([sine(float(x)) for x in angles]) == pytest.approx(np.sin(angles), abs=1e-7)


class TestWindow:
    def test_sums_by_onset_are_those_of_whole_passes(self, window: AxisWindow) -> None:
        m, names, x = window.nuisance_count, ("coulomb_friction",), np.array([0.3])
        d, step = np.zeros(m), 1e-6
        Q = np.random.default_rng(1).normal(size=(window.samples, 2))
        onsets, overs = np.array([0, 60, 200]), np.array([0, 0, 0])
        found, _ = window.change_sums(d, names, x, step, Q)(onsets, overs)
        for sums, onset in zip(found, onsets, strict=True):
            e, moved = (window.residual(np.append(d, size), names, ChangeProfile(int(onset)))[: window.samples]
                        for size in (x, x + step))  # fmt: skip
            both = np.array([e, (moved - e) / step])
            assert sums == pytest.approx(np.hstack([both @ both.T, both @ Q]), rel=1e-5, abs=1e-7 * float(e @ e))

    def test_the_input_gain_moves_every_coefficient(self, window: AxisWindow) -> None:
        gain, mass = (
            window.plant.scaled({name: 2.0}).acceleration_coefficients() for name in ("input_gain", "inertia")
        )
        healthy = window.plant.acceleration_coefficients()
        assert gain / healthy == pytest.approx([0.5, 1.0, 1.0, 1.0])  # more u for the same motion
        assert mass / healthy == pytest.approx([0.5, 0.5, 0.5, 0.5])

    def test_a_search_that_begins_a_hair_beside_zero_moves(self, window: AxisWindow) -> None:
        """The first step of the search is as long as its start is away from zero."""
        fault = next(fault for fault in window.plant.faults if fault.parameter == "inertia")
        m, profile = window.nuisance_count, ChangeProfile(100)
        found = [
            fit_hypothesis(window, [fault], profile, np.full(m, begin), [np.array([begin])], free=True)
            for begin in (0.0, 1e-10, 0.1)
        ]
        assert abs(found[0].x[0]) > 0.01
        for other in found[1:]:
            assert other.x == pytest.approx(found[0].x, rel=1e-2)
            assert other.cost == pytest.approx(found[0].cost, rel=1e-4)

    def test_the_limit_of_the_scan_is_that_of_a_brownian_bridge(self) -> None:
        """Counted at a probability at which simulation can count: the largest of all standardised partial sums."""
        rng, N, tries = np.random.default_rng(2), 1000, 4000
        e = rng.normal(size=(tries, N))
        S, t = np.cumsum(e, axis=1), np.arange(1, N + 1) / N
        bridge = (S - t * S[:, -1:]) / np.sqrt(N)
        inside = (t >= MIN_EDGE_SHARE) & (t <= 1.0 - MIN_EDGE_SHARE)
        largest = (bridge[:, inside] ** 2 / (t * (1.0 - t))[inside]).max(axis=1)
        share = float((largest > scan_limit(1, 0.01)).mean())
        assert 0.005 < share < 0.013  # discrete steps miss a little of the continuous path
        assert scan_limit(4) > scan_limit(1) > scan_limit(1, 10.0 * FALSE_ALARMS)


def test_a_change_at_the_beginning_is_dated_by_what_came_before_and_one_at_the_end_is_found() -> None:
    """The fit to the whole recording has the change in its healthy parameters, and dated it half a minute late."""
    plant = {"kind": "axis", "coefficients": {"inertia": 1.0, "viscous_friction": 10.0, "coulomb_friction": 2.0,
                                              "offset": 0.3}}  # fmt: skip
    loop = ss.Loop.from_dict({**AXIS, "plant": plant})
    r = 0.1 * np.sin(3.0 * np.arange(6000) / 200.0) + 0.05 * np.sin(7.0 * np.arange(6000) / 200.0)

    def rubbed(seed: int, *faults: str) -> ss.Recording:
        events = [FaultEvent.parse(fault) for fault in faults]
        return simulate(loop, r, seed=seed, faults=events, noise_u_std=5e-3, noise_y_std=1e-5)[0]

    baseline = ss.learn(loop, [rubbed(seed) for seed in range(2)])
    assert find_axis_change(baseline, rubbed(2)) is None
    for at in (3.0, 28.0):
        change = find_axis_change(baseline, rubbed(3, f"coulomb_friction=1.5@{at}"))
        assert change is not None and at < change.detected / 200.0 <= at + 1.0


def test_friction_that_grows_moves_no_inertia_at_any_rate() -> None:
    """Held from the sample on, its column was half a sample late: 0.6 % of inertia at 200 Hz."""
    plant = {"kind": "axis", "coefficients": AXIS["plant"]["coefficients"]}
    for rate in (100.0, 400.0):
        loop = ss.Loop.from_dict({**AXIS, "sample_rate": rate, "plant": plant})
        t = np.arange(round(20.0 * rate)) / rate
        r = 0.1 * np.sin(3.0 * t) + 0.05 * np.sin(7.0 * t)
        recordings = [
            simulate(loop, r, seed=1, faults=faults, noise_u_std=1e-3, noise_y_std=1e-6)[0]
            for faults in ((), [FaultEvent("viscous_friction", 1.5, 0.0)])
        ]
        axes = [fit_axis(loop, [one])[0] for one in recordings]
        inertia = [axis.coefficients["inertia"] for axis in axes if axis is not None]
        assert inertia[1] / inertia[0] == pytest.approx(1.0, abs=2e-3)


@pytest.fixture(scope="module")
def axis(shared_data: Path) -> tuple[ss.Baseline, ss.Recording, ss.Recording]:
    loop = ss.Loop.from_dict(LOOP)
    folder = shared_data / "real" / "emps"
    train, test = (ss.read(folder / f"{name}.mat", loop) for name in ("DATA_EMPS", "DATA_EMPS_PULSES"))
    return ss.learn(loop, [train]), train, test


def added(
    recording: ss.Recording, since_s: float, force: Callable[[FloatArray, FloatArray], FloatArray]
) -> ss.Recording:
    """Add a force [N] of speed and acceleration to u; the acceleration hardly smoothed, or inertia comes out small."""
    from scipy.signal import savgol_filter

    T = 1.0 / recording.sample_rate
    v, a = (savgol_filter(recording.y, 5, 3, deriv=order, delta=T) for order in (1, 2))
    return replace(recording, u=recording.u + np.where(recording.t >= since_s, force(v, a), 0.0) / 35.15)


def test_output_error_finds_the_coefficients_and_the_force_of_each_recording() -> None:
    coefficients = {"inertia": 2.0, "viscous_friction": 3.0, "coulomb_friction": 1.0}
    plant: dict[str, Any] = {"kind": "axis", "terms": ["viscous", "coulomb"], "coefficients": coefficients}
    loop = ss.Loop.from_dict(
        {"sample_rate": 100.0, "plant": plant, "controller": {"kind": "pi", "k_p": 80.0, "k_i": 0.0}}
    )
    assert isinstance(loop.plant, AxisPlant)
    r = 0.5 * np.sin(np.arange(600) * 0.03) + 0.2 * np.sin(np.arange(600) * 0.11)
    both = [simulate(loop, r[begin:], noise_y_std=1e-6)[0] for begin in (0, 100)]
    pushed = [replace(one, u=one.u + force) for one, force in zip(both, (0.3, -0.2), strict=True)]
    wrong = loop.plant.scaled({"inertia": 1.05, "coulomb_friction": 0.93})
    found = fit_output_error(loop, pushed, wrong, drifts=False, start=20)
    assert found.offset == pytest.approx([0.3, -0.2], abs=0.01)
    assert found.plant.coefficients == pytest.approx(coefficients, rel=0.01)
    assert max(found.rmse) < 1e-3 * float(np.abs(r).max())


class TestVibration:
    """What no coefficient explains: white noise as of a healthy axis, and more of it from 30 s on."""

    @staticmethod
    def residual(window: AxisWindow, seed: int, added: FloatArray) -> FloatArray:
        e = np.random.default_rng(seed).normal(size=window.samples) * window.counted
        e[3000:] += added[3000:] * window.counted[3000:]
        return np.append(e, np.zeros(window.nuisance_count))

    def test_a_ringing_is_found_with_its_time(self, long_window: AxisWindow) -> None:
        # 12 Hz, struck every 0.7 s, damped to a third in a third of a second
        kicks = np.where(np.arange(long_window.samples) % 70 == 0, 6.0, 0.0)
        ringing = lfilter([1.0], [1.0, -1.94 * np.cos(2.0 * np.pi * 0.12), 0.97**2], kicks)
        found = find_vibration(long_window, self.residual(long_window, 1, ringing), 26.6)
        assert found is not None
        assert found.onset[0] <= 3000 <= found.onset[2]
        assert found.onset[2] - found.onset[0] <= 400
        assert found.onset[1] <= found.detected < 4500
        assert 2.0 < found.interval[0] < found.ratio < found.interval[1]

    def test_louder_noise_of_the_sensor_is_none(self, long_window: AxisWindow) -> None:
        f, noise = long_window.filter, np.random.default_rng(2).normal(size=long_window.samples)
        assert (
            find_vibration(long_window, self.residual(long_window, 1, lfilter(f.to_y, f.poles, 6.0 * noise)), 26.6)
            is None
        )

    def test_what_never_changed_is_found_as_often_as_the_limit_says(self, long_window: AxisWindow) -> None:
        """Counted at a limit that simulation can count: of Student's t where the bound is of a normal variable."""
        limit, nothing = scan_limit(5, 0.1), np.zeros(long_window.samples)
        each = (find_vibration(long_window, self.residual(long_window, seed, nothing), limit) for seed in range(100))
        found = sum(one is not None for one in each)
        assert found <= 10  # upwards only, and bands of whitened innovations are nearly independent


@pytest.mark.slow
def test_a_worn_belt_is_a_vibration_and_a_payload_on_it_has_its_own_name() -> None:
    """Two masses, the encoder at the motor: a belt a quarter as stiff, or loose by half a millimetre, has no term."""
    belt = AXES["belt"]
    loop = ss.Loop.from_dict(axis_loop().to_dict() | {"plant": {"kind": "axis"}})
    baseline = ss.learn(loop, [record(belt, moves(seed), seed) for seed in range(2)])
    softer, loose = (
        ss.diagnose(baseline, record(belt, moves(10), 10, worn))
        for worn in (replace(belt, belt_hz=0.5 * belt.belt_hz), replace(belt, slack=5e-4))
    )
    assert {fault.name for fault in softer.faults} <= {"vibration"}
    assert [fault.name for fault in loose.faults] == ["vibration"]
    assert loose.onset_s is not None
    assert loose.onset_s[0] <= 30.0 <= loose.onset_s[2]
    assert any("no coefficient explains" in str(reason) for reason in loose.reasons)
    assert "backlash" in str(loose.checks[0])
    # 2 kg more behind the same belt
    heavier = replace(belt, mass=22.0, load_share=12.0 / 22.0, belt_hz=belt.belt_hz * (22.0 / 24.0) ** 0.5)
    (fault,) = ss.diagnose(baseline, record(belt, moves(10), 10, heavier)).faults
    assert (fault.name, fault.ratio) == ("payload", pytest.approx(1.1, rel=0.01))


@pytest.mark.slow
def test_a_friction_that_the_motion_does_not_show_costs_its_own_faults_only() -> None:
    values = {"inertia": 2.0, "viscous_friction": 3.0, "coulomb_friction": 0.0}
    plant: dict[str, Any] = {"kind": "axis", "terms": ["viscous", "coulomb"], "coefficients": values}
    loop = ss.Loop.from_dict({
        "sample_rate": 100.0, "plant": plant, "controller": {"kind": "pi", "k_p": 80.0, "k_i": 0.0},
        "monitor": {"cutoff": 5.0, "memory": 2.0},
    })  # fmt: skip
    t = np.arange(3000) * 0.01
    r = 0.5 * np.sin(3.0 * t) + 0.2 * np.sin(11.0 * t)

    def recorded(seed: int, *faults: FaultEvent) -> ss.Recording:
        return simulate(loop, r, faults=faults, noise_u_std=0.05, noise_y_std=1e-5, seed=seed)[0]

    model, notes = fit_axis(loop, [recorded(seed) for seed in range(2)])
    assert model is not None
    assert [*model.unseen] == ["coulomb_friction"]
    assert "do not show coulomb_friction" in str(notes[0])
    assert model.coefficients["inertia"] == pytest.approx(2.0, rel=0.01)
    assert model.plant(loop.plant).coefficients == model.coefficients  # type: ignore[arg-type]
    assert [fault.name for fault in model.visible_faults(loop.plant.faults)] == [
        "payload", "lubrication", "motor_constant"]  # fmt: skip
    learned = ss.Loop.from_dict({k: v for k, v in loop.to_dict().items() if k != "controller"} | {
        "plant": {name: plant[name] for name in ("kind", "terms")}})  # fmt: skip
    baseline = ss.learn(learned, [recorded(seed) for seed in range(2)])
    diagnosis = ss.diagnose(baseline, recorded(7, FaultEvent("inertia", 1.3, 15.0)))
    assert [one.name for one in diagnosis.faults] == ["payload"]
    assert diagnosis.faults[0].ratio == pytest.approx(1.3, rel=0.02)


@pytest.mark.slow
class TestMeasuredAxis:
    def test_its_coefficients_are_those_of_the_authors(
        self, axis: tuple[ss.Baseline, ss.Recording, ss.Recording]
    ) -> None:
        learned = axis[0].axis
        assert learned is not None
        assert learned.coefficients["inertia"] == pytest.approx(95.11, rel=0.01)  # Janot, Gautier and Brunot, 2019
        assert learned.coefficients["coulomb_friction"] == pytest.approx(20.39, rel=0.03)
        both = [learned.coefficients[f"viscous_friction_{way}"] for way in ("forward", "backward")]
        assert both[0] < 203.5 < both[1]  # theirs is one for both ways

    def test_healthy_recordings_are_healthy(self, axis: tuple[ss.Baseline, ss.Recording, ss.Recording]) -> None:
        assert [ss.diagnose(axis[0], one).verdict for one in axis[1:]] == ["healthy", "healthy"]

    @pytest.mark.parametrize(
        ("which", "since_s", "fault", "ratio", "force"),
        [
            (1, 11.0, "dry_friction", 1.15, lambda v, a: 0.15 * 20.72 * np.sign(v)),
            (1, 11.0, "payload", 0.9, lambda v, a: -0.1 * 95.67 * a),
            # this recording seems 6 % lighter and 6 % stiffer to move than the one that was learned: that is no change
            (2, 10.11, "lubrication", 0.904, lambda v, a: -0.096 * np.where(v > 0.0, 162.4, 239.6) * v),
            # told for what it does to the part before it, at the very end
            (2, 9.41, "payload", 0.941, lambda v, a: -0.059 * 95.67 * a),
        ],
    )
    def test_a_change_is_named_with_size_and_time(
        self,
        axis: tuple[ss.Baseline, ss.Recording, ss.Recording],
        which: int,
        since_s: float,
        fault: str,
        ratio: float,
        force: Callable[[FloatArray, FloatArray], FloatArray],
    ) -> None:
        diagnosis = ss.diagnose(axis[0], added(axis[which], since_s, force))
        (found,) = diagnosis.candidates[0].faults  # of 0.95 or, the lubrication, a little less
        assert found.name == fault and diagnosis.candidates[0].probability > 0.94
        low, high = found.interval
        assert low - 0.02 < ratio < high + 0.02
        assert diagnosis.onset_s is not None
        assert diagnosis.onset_s[0] <= since_s <= diagnosis.onset_s[2]
        assert high - low < 0.1


@pytest.mark.slow
def test_a_baseline_of_an_axis_comes_back_from_its_file(
    axis: tuple[ss.Baseline, ss.Recording, ss.Recording], tmp_path: Path
) -> None:
    axis[0].save(tmp_path / "axis.json")
    assert ss.Baseline.load(tmp_path / "axis.json") == axis[0]


@pytest.mark.parametrize(
    ("plant", "told"),
    [
        ({"terms": ["stribeck"]}, "stribeck_speed: belongs to the term stribeck"),
        ({"terms": ["viscous", "viscous_by_direction"]}, "remove one of them"),
        ({"terms": ["coulomb", "coulomb"]}, "stands twice"),
        ({"coefficients": {"inertia": 1.0}}, "check coulomb_friction, offset, viscous_friction"),
    ],
)
def test_a_wrong_table_is_refused(plant: dict[str, Any], told: str) -> None:
    with pytest.raises(LoopError, match=told):
        ss.Loop.from_dict({"sample_rate": 100.0, "plant": {"kind": "axis", **plant}})
