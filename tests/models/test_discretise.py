"""Discretisation: exact against Runge-Kutta and scipy, in open and in closed loop, for holds and delays."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from servoscope.models.discretise import discretise
from servoscope.models.loop import Loop
from servoscope.models.plants.eha import EHA
from servoscope.simulation import reference, simulate_response

Array = npt.NDArray[np.float64]


def make(rig: dict[str, Any], **changes: Any) -> Loop:
    return Loop.from_dict(rig | changes, source="rig")


@pytest.fixture
def loop(rig: dict[str, Any]) -> Loop:
    return make(rig)


def hold(u: Array, hold_kind: str, t: float) -> float:
    """The input at time t [samples]: held, or in straight lines; zero before the first sample."""
    if t < 0.0:
        return 0.0 if hold_kind == "zoh" or t < -1.0 else float(u[0] * (1.0 + t))
    k = int(t)
    if hold_kind == "zoh" or k + 1 >= u.size:
        return float(u[min(k, u.size - 1)])
    return float(u[k] + (u[k + 1] - u[k]) * (t - k))


def runge_kutta(
    plants: list[EHA], u: Array, fs: float, hold_kind: str, delay: float, switch: int = 0, steps: int = 400
) -> Array:
    """y (N,) of an open loop by classical Runge-Kutta, steps per sample, pressure in MPa: the slow oracle."""
    scale = np.array([1.0, 1.0, 1e6])
    scaled = [(A * scale / scale[:, None], B[:, 0] / scale) for A, B, _ in (p.state_space() for p in plants)]
    h = 1.0 / fs / steps
    x, y = np.zeros(3), np.zeros(u.size)
    for k in range(u.size):
        y[k] = x[0]
        A, B = scaled[0] if k < switch else scaled[-1]
        for i in range(steps):
            # A jump of the input falls on the border of two steps: look just inside of them.
            at = k + np.array([i + 1e-7, i + 0.5, i + 1.0 - 1e-7]) / steps - delay * fs
            u_0, u_1, u_2 = (hold(u, hold_kind, float(t)) for t in at)
            k_1 = A @ x + B * u_0
            k_2 = A @ (x + 0.5 * h * k_1) + B * u_1
            k_3 = A @ (x + 0.5 * h * k_2) + B * u_1
            k_4 = A @ (x + h * k_3) + B * u_2
            x = x + h / 6.0 * (k_1 + 2.0 * k_2 + 2.0 * k_3 + k_4)
    return y


def recurse(plant: EHA, u: Array, fs: float, hold_kind: Any, delay: float) -> Array:
    """y (N,) of an open loop by the discretised plant, straight from its definition."""
    A, b_next, b_now, b_late, c, m = discretise(plant.state_space(), fs, hold=hold_kind, delay=delay)

    def acting(k: int) -> float:
        return float(u[k]) if 0 <= k < u.size else 0.0

    x, y = np.zeros(A.shape[0]), np.zeros(u.size)
    for k in range(u.size):
        y[k] = c @ x
        x = A @ x + b_next * acting(k - m + 1) + b_now * acting(k - m) + b_late * acting(k - m - 1)
    return y


class TestDiscretise:
    @pytest.mark.parametrize("delay", [0.0, 0.004, 0.01, 0.017])
    @pytest.mark.parametrize("ratios", [{}, {"beta": 0.01}, {"b_p": 20.0}])
    def test_held_input_is_exact(self, loop: Loop, ratios: dict[str, float], delay: float) -> None:
        assert isinstance(loop.plant, EHA)
        plant = loop.plant.with_ratios(ratios)
        u = np.random.default_rng(1).standard_normal(12)
        exact = runge_kutta([plant], u, 100.0, "zoh", delay)
        assert recurse(plant, u, 100.0, "zoh", delay) == pytest.approx(exact, rel=1e-6, abs=1e-9)

    @pytest.mark.parametrize("delay", [0.0, 0.004, 0.01, 0.013])
    def test_straight_lines_are_exact(self, loop: Loop, delay: float) -> None:
        assert isinstance(loop.plant, EHA)
        u = np.concatenate([[0.0, 0.0], np.random.default_rng(1).standard_normal(12)])
        exact = runge_kutta([loop.plant], u, 100.0, "foh", delay)
        assert recurse(loop.plant, u, 100.0, "foh", delay) == pytest.approx(exact, rel=1e-6, abs=1e-9)

    def test_against_scipy(self, loop: Loop) -> None:
        from scipy.signal import cont2discrete

        A, B, C = loop.plant.state_space()
        for name in ("zoh", "foh"):
            mine = discretise((A, B, C), 100.0, hold="zoh" if name == "zoh" else "foh")
            theirs = cont2discrete((A, B, C, np.zeros((1, 1))), 0.01, method=name)
            f = np.exp(2j * np.pi * np.array([0.1, 1.0, 10.0, 40.0]) / 100.0)
            for z in f:
                inputs = mine.b_next * z + mine.b_now
                G = mine.c @ np.linalg.solve(z * np.eye(3) - mine.A, inputs)
                H = (theirs[2] @ np.linalg.solve(z * np.eye(3) - theirs[0], theirs[1]) + theirs[3])[0, 0]
                assert pytest.approx(H, rel=1e-6) == G

    def test_steady_state_gain(self, loop: Loop) -> None:
        A, _, b_now, _, c, _ = discretise(loop.plant.state_space(), 100.0)
        gain = c @ np.linalg.solve(np.eye(3) - A, b_now)
        assert gain == pytest.approx(1.0 / loop.plant.theta()[0], rel=1e-9)


class TestClosedLoop:
    @pytest.mark.parametrize("ratios", [{"b_p": 20.0}, {"beta": 0.1}, {"p_s": 0.6}])
    def test_a_switch_keeps_position_and_speed(self, loop: Loop, ratios: dict[str, float]) -> None:
        assert isinstance(loop.plant, EHA)
        plants = [loop.plant, loop.plant.with_ratios(ratios)]
        u, y = simulate_response(loop, reference("profile", 0.3, 100.0), plants=plants, switch=[0, 15])
        assert y == pytest.approx(runge_kutta(plants, u, 100.0, "zoh", 0.0, switch=15), rel=1e-6, abs=1e-10)

    @pytest.mark.parametrize("delay", [0.0, 0.004, 0.013])
    @pytest.mark.parametrize("hold_kind", ["zoh", "foh"])
    def test_controller_and_plant_both_hold(self, rig: dict[str, Any], hold_kind: str, delay: float) -> None:
        loop = make(rig, hold=hold_kind, delay=delay, controller={"kind": "pi", "k_p": 10.0, "k_i": 5.0})
        assert isinstance(loop.plant, EHA)
        r = np.concatenate([[0.0], reference("multisine", 0.3, 100.0)])
        u, y = simulate_response(loop, r)
        e = r - y
        assert u == pytest.approx(10.0 * e + 0.05 * np.cumsum(e), abs=1e-12)
        assert y == pytest.approx(runge_kutta([loop.plant], u, 100.0, hold_kind, delay), rel=1e-6, abs=1e-10)
