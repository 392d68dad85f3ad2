"""Motor axes in simulation: Newton, sticking, friction per direction, and what is not supported."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from servoscope.core.errors import LoopError, SimulationError
from servoscope.models.loop import Loop
from servoscope.simulation import FaultEvent, reference, simulate, simulate_response

AXIS: dict[str, Any] = {
    "kind": "polynomial",
    "order": 2,
    "friction": "directional",
    "offset": True,
    "coefficients": {
        "inertia": 95.0,
        "viscous_friction_forward": 160.0,
        "viscous_friction_backward": 240.0,
        "coulomb_friction": 20.4,
        "offset": -3.2,
    },
}


def make(rig: dict[str, Any], **changes: Any) -> Loop:
    return Loop.from_dict(rig | changes, source="rig")


@pytest.fixture
def axis(rig: dict[str, Any]) -> Loop:
    controller = {"kind": "pi", "k_p": 2000.0, "k_i": 50.0}
    return make(rig, plant=AXIS, controller=controller, sample_rate=1000.0)


class TestAxis:
    def test_newton_holds_while_it_moves(self, axis: Loop) -> None:
        r = reference("profile", 4.0, 1000.0, amplitude=2.0)
        recording, truth = simulate(axis, r, noise_u_std=0.0, noise_y_std=0.0)
        y, T = truth.y_true, 1e-3
        speed = (y[2:] - y[:-2]) / (2.0 * T)
        # u is held, so the acceleration between two samples belongs to the mean of both u.
        acceleration = (y[2:] - 2.0 * y[1:-1] + y[:-2]) / T**2
        u = 0.5 * (truth.u_true[1:-1] + truth.u_true[:-2])
        viscous = np.where(speed > 0.0, 160.0, 240.0)
        model = 95.0 * acceleration + viscous * speed + 20.4 * np.sign(speed) - 3.2
        moving = np.abs(speed) > 0.01
        assert np.mean(moving) > 0.8
        assert np.abs(u - model)[moving].max() < 1e-3 * np.abs(recording.u).max()

    def test_it_sticks(self, rig: dict[str, Any]) -> None:
        proportional = {"kind": "pi", "k_p": 2000.0, "k_i": 0.0}
        loop = make(rig, plant=AXIS, controller=proportional, sample_rate=1000.0)
        # 20.4 N hold 2000 N/m x 8.6 mm and the offset of 3.2 N; not 8.7 mm.
        assert np.all(simulate_response(loop, np.full(500, 0.0085))[1] == 0.0)
        assert simulate_response(loop, np.full(500, 0.0087))[1][-1] > 0.0
        # It comes to rest, away from the reference, and stays there.
        y = simulate_response(loop, np.full(8000, 0.05))[1]
        assert np.all(y[-1000:] == y[-1])
        assert 0.0 < abs(y[-1] - 0.05) < 0.0119

    def test_without_friction_it_is_the_linear_axis(self, rig: dict[str, Any]) -> None:
        plain = {"inertia": 95.0, "viscous_friction": 203.5}
        linear = AXIS | {"friction": "none", "offset": False, "coefficients": plain}
        coulomb = linear | {"friction": "coulomb", "coefficients": plain | {"coulomb_friction": 0.0}}
        controller = {"kind": "pi", "k_p": 2000.0, "k_i": 50.0}
        r = reference("profile", 4.0, 1000.0)
        exact, stepped = (
            simulate_response(make(rig, plant=plant, controller=controller, sample_rate=1000.0, delay=0.0022), r)[1]
            for plant in (linear, coulomb)
        )
        assert stepped == pytest.approx(exact, abs=1e-9)

    def test_gravity_cogging_and_stribeck_friction_act(self) -> None:
        """Against an integrator with small steps, whose friction changes its sign over a speed of 1 mm/s."""
        from scipy.integrate import solve_ivp

        terms = ["viscous", "coulomb", "stribeck", "gravity", "load_friction", "cogging"]
        values = {"inertia": 2.0, "viscous_friction": 0.3, "coulomb_friction": 0.5, "stribeck_friction": 0.4}
        values |= {"gravity": 9.0, "load_friction": 0.6, "cogging_sin": 0.7, "cogging_cos": -0.3}
        shapes = {"stribeck_speed": 0.2, "period": 0.5, "hanging_at": 0.2}
        loop = Loop.from_dict({
            "sample_rate": 500.0,
            "plant": {"kind": "axis", "terms": terms, **shapes, "coefficients": values},
            "controller": {"kind": "pi", "k_p": 60.0, "k_i": 0.0},
        })  # fmt: skip
        t = np.arange(300) / 500.0
        u, y = simulate_response(loop, 1.0 + 0.8 * np.sin(2.0 * t))
        state, expected = np.zeros(2), []
        for force in u:
            expected.append(state[0])

            def motion(_: float, x: np.ndarray[Any, Any], force: float = force) -> list[float]:
                q, v = x
                rubs = 0.5 + 0.4 / (1.0 + (v / 0.2) ** 2) + 0.6 * abs(np.sin(q - 0.2))
                friction = np.tanh(v / 1e-3) * rubs + 0.3 * v
                waves = 9.0 * np.sin(q - 0.2) + 0.7 * np.sin(4.0 * np.pi * q) - 0.3 * np.cos(4.0 * np.pi * q)
                return [v, (force - friction - waves) / 2.0]

            state = solve_ivp(motion, (0.0, 0.002), state, method="LSODA", rtol=1e-8, atol=1e-10).y[:, -1]
        assert np.abs(y).max() > 1.0
        assert y == pytest.approx(np.array(expected), abs=3e-4)

    def test_order_one(self, rig: dict[str, Any]) -> None:
        plant = {
            "kind": "polynomial",
            "order": 1,
            "friction": "coulomb",
            "coefficients": {"viscous_friction": 10.0, "coulomb_friction": 2.0},
        }
        loop = make(rig, plant=plant, controller={"kind": "pi", "k_p": 50.0, "k_i": 0.0})
        u, y = simulate_response(loop, np.full(3000, 1.0))
        assert y[-1] == pytest.approx(1.0 - 2.0 / 50.0, abs=1e-3)
        assert np.diff(y)[:20] == pytest.approx((u[:20] - 2.0) / 10.0 * 0.01, rel=1e-9)

    def test_input_gain_is_one_with_its_coefficients(self, rig: dict[str, Any], axis: Loop) -> None:
        doubled = {name: 2.0 * value for name, value in AXIS["coefficients"].items()}
        plant = AXIS | {"input_gain": 2.0, "coefficients": doubled}
        scaled = make(rig, plant=plant, controller=axis.to_dict()["controller"], sample_rate=1000.0)
        r = reference("profile", 2.0, 1000.0)
        assert simulate_response(scaled, r)[1] == pytest.approx(simulate_response(axis, r)[1], rel=1e-9, abs=1e-15)

    def test_a_fault_by_the_name_of_its_coefficient(self, axis: Loop) -> None:
        _, truth = simulate(axis, np.zeros(200), faults=[FaultEvent("inertia", 1.3, 0.1)])
        assert truth.theta[-1, 0] == pytest.approx(1.3 * 95.0)

    @pytest.mark.parametrize("change", [{"hold": "foh"}, {"plant": AXIS | {"order": 3}}])
    def test_what_is_not_supported(self, rig: dict[str, Any], axis: Loop, change: dict[str, Any]) -> None:
        if "plant" in change:
            change = {"plant": change["plant"] | {"coefficients": AXIS["coefficients"] | {"jerk": 0.05}}}
        loop = make(
            rig,
            **{"plant": AXIS, "controller": axis.to_dict()["controller"], "sample_rate": 1000.0, **change},
        )
        with pytest.raises(SimulationError, match="friction and offset"):
            simulate(loop, np.zeros(100))

    def test_no_nominal_values(self, rig: dict[str, Any]) -> None:
        loop = make(rig, plant={"kind": "polynomial", "order": 2})
        with pytest.raises(LoopError, match="coefficients: missing"):
            simulate(loop, np.zeros(100))
