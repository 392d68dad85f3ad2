"""The filter bank against its definition: eta, phi, z and E(f), for every structure and kind of column."""

from __future__ import annotations

from typing import Any

import naive
import numpy as np
import pytest

from servoscope.core.errors import LoopError
from servoscope.estimation.filter_bank import (
    build_filter_bank,
    closed_loop_system,
    instrument_system,
    nominal_theta,
    tustin_coefficients,
)
from servoscope.estimation.pipeline import Pipeline, Regression
from servoscope.models.loop import Loop
from servoscope.simulation import reference, simulate, simulate_response

AXIS = {"kind": "polynomial", "order": 2}


def signals(samples: int = 300) -> tuple[naive.Array, naive.Array, naive.Array]:
    """Three smooth signals that start at rest, away from zero."""
    raw = np.random.default_rng(3).standard_normal((3, samples)).cumsum(axis=1)
    raw[:, :5] = raw[:, 4:5]
    return raw[0], raw[1], raw[2]


def regression(loop: Loop, r: naive.Array, u: naive.Array, y: naive.Array) -> Regression:
    restart = np.zeros(len(r), dtype=bool)
    restart[0] = True
    return Pipeline.of(loop).regression(r, u, y, restart)


def close(ours: naive.Array, theirs: naive.Array, tolerance: float = 1e-9) -> bool:
    return bool(np.abs(ours - theirs).max() <= tolerance * np.abs(theirs).max())


class TestRegressors:
    @pytest.mark.parametrize("hold", ["zoh", "foh"])
    @pytest.mark.parametrize("delay", [0.0, 0.0123])
    def test_state_variable_filter(self, rig: dict[str, Any], hold: str, delay: float) -> None:
        r, u, y = signals()
        loop = Loop.from_dict(rig | {"hold": hold, "delay": delay, "monitor": {"cutoff": 8.0}})
        g = regression(loop, r, u, y)
        assert close(g.eta, naive.svf(u, 0, 8.0, 4, 100.0, hold, delay, steps=100))
        for power in range(4):
            assert close(g.phi[:, power], naive.svf(y, power, 8.0, 4, 100.0, "foh")), power
        assert np.array_equal(g.z, g.phi)

    @pytest.mark.parametrize("structure", ["tustin", "tustin-held"])
    def test_tustin_is_equation_4(self, rig: dict[str, Any], structure: str) -> None:
        r, u, y = signals()
        g = regression(Loop.from_dict(rig | {"monitor": {"structure": structure}}), r, u, y)
        eta, phi = naive.tustin(u, y, held=structure == "tustin-held")
        assert close(g.eta, eta, 1e-13)
        assert close(g.phi, phi, 1e-13)

    def test_tustin_takes_whole_samples_of_delay(self, rig: dict[str, Any]) -> None:
        r, u, y = signals()
        g = regression(Loop.from_dict(rig | {"delay": 0.02, "monitor": {"structure": "tustin"}}), r, u, y)
        assert close(g.eta[2:], naive.tustin(u, y)[0][:-2], 1e-13)

    def test_friction_and_offset_are_formed_before_the_filter(self) -> None:
        plant = AXIS | {
            "friction": "directional",
            "offset": True,
            "input_gain": -2.0,
            "sign_speed": 5.0,
            "sign_cutoff": 20.0,
        }
        loop = Loop.from_dict({"sample_rate": 100.0, "plant": plant, "monitor": {"cutoff": 9.0}})
        r, u, y = signals()
        g = regression(loop, r, u, y)
        columns = dict(zip(loop.plant.names, g.phi.T, strict=True))
        order = max(loop.plant.powers) + 1

        def smooth(w: naive.Array, power: int = 0, hold: str = "foh") -> naive.Array:
            return naive.svf(w, power, 9.0, order, 100.0, hold)

        v = naive.svf(y, 1, 20.0, 2, 100.0, "foh")
        assert close(g.eta, -2.0 * smooth(u, hold="zoh"))
        assert close(columns["inertia"], smooth(y, 2))
        assert close(columns["coulomb_friction"], smooth(np.where(np.abs(v) <= 5.0, 0.0, np.sign(v))))
        assert close(columns["viscous_friction_forward"], smooth(np.maximum(v, 0.0)))
        assert close(columns["viscous_friction_backward"], smooth(np.minimum(v, 0.0)))
        assert np.array_equal(columns["offset"], np.ones(len(y)))

    def test_sign_from_the_reference(self) -> None:
        plant = AXIS | {"friction": "coulomb", "sign_from": "reference"}
        loop = Loop.from_dict({"sample_rate": 100.0, "plant": plant})
        r, u, y = signals()
        g = regression(loop, r, u, y)
        v = naive.svf(r, 1, 25.0, 2, 100.0, "foh")  # 50 Hz is the default; a quarter of the sample rate is the most
        sign = np.where(v > 1e-9, 1.0, np.where(v < -1e-9, -1.0, 0.0))
        assert close(g.phi[20:, -1], naive.svf(sign, 0, 10.0, 3, 100.0, "foh")[20:], 1e-2)

    @pytest.mark.parametrize("place", [0.0, 0.3, -17.0])
    @pytest.mark.parametrize("way", [1.0, -1.0])
    def test_a_reference_that_stands_keeps_the_sign_of_its_last_motion(self, way: float, place: float) -> None:
        # a move that ends at `place`, then rest for longer than any filter remembers; rounding has no say in the sign
        plant = AXIS | {"friction": "coulomb", "sign_from": "reference"}
        loop = Loop.from_dict({"sample_rate": 100.0, "plant": plant, "monitor": {"cutoff": 10.0, "frequencies": [1.0]}})
        move = place - way * np.maximum(1.0 - np.arange(6000) / 200.0, 0.0)
        for ulps in range(3):
            r = move * (1.0 + ulps * 2.0**-52)
            phi = regression(loop, r, r, r).phi[:, -1]
            assert close(phi[400:], np.full(5600, way))

    def test_a_reference_that_has_not_moved_has_no_sign(self) -> None:
        plant = AXIS | {"friction": "coulomb", "sign_from": "reference"}
        loop = Loop.from_dict({"sample_rate": 100.0, "plant": plant, "monitor": {"cutoff": 10.0, "frequencies": [1.0]}})
        for place in (0.0, 0.1, 1.7e5, -3e-7):
            r = np.full(300, place)
            assert not regression(loop, r, r, r).phi[:, -1].any()

    def test_gates(self, rig: dict[str, Any]) -> None:
        """Nothing is used near rest and the dead zone or while the filters settle; u is limited where it was not."""
        speed = np.repeat([0.0, 1.0, 0.0, -1.0], [60, 120, 40, 180])
        y = 2.0 + np.cumsum(speed) / 100.0
        u = 5.0 * np.cos(np.arange(400) / 60.0)
        loop = Loop.from_dict(
            rig
            | {"input_deadzone": [-1.0, 1.0], "input_limits": [-4.0, 4.0], "input_logged": "before_limiter"}
            | {"monitor": {"update_when": "moving", "rest_speed": 0.5}}
        )
        g = regression(loop, y, u, y)
        limited = np.clip(u, -4.0, 4.0)
        resting = (np.abs(naive.svf(y, 1, 25.0, 2, 100.0, "foh")) <= 0.5) | (np.abs(limited) <= 1.0)
        expected = naive.usable(y, u, y, np.zeros(400, dtype=bool), Pipeline.of(loop).bank.wait, resting)
        assert 50 < expected.sum() < 250
        assert np.array_equal(g.ok, expected)
        assert close(g.eta, naive.svf(limited, 0, 10.0, 4, 100.0, "zoh"))


class TestInstrument:
    def test_is_the_nominal_loop_behind_the_same_filters(self, rig: dict[str, Any]) -> None:
        loop = Loop.from_dict(rig | {"monitor": {"estimator": "iv-akf"}})
        r = reference("multisine", 5.0, 100.0)
        r -= r[0]
        _, u, y = signals(500)
        _, y_a = simulate_response(loop, r)
        g = regression(loop, r, u, y)
        for power in range(4):
            assert close(g.z[:, power], naive.svf(y_a, power, 10.0, 4, 100.0, "foh"), 1e-7), power
            assert close(g.phi[:, power], naive.svf(y, power, 10.0, 4, 100.0, "foh")), power

    @pytest.mark.parametrize("hold", ["zoh", "foh"])
    @pytest.mark.parametrize("delay", [0.0, 0.004, 0.02])
    def test_closed_loop_is_what_the_simulator_does(self, rig: dict[str, Any], hold: str, delay: float) -> None:
        loop = Loop.from_dict(
            rig | {"hold": hold, "delay": delay, "controller": {"kind": "pi", "k_p": 15.0, "k_i": 60.0}}
        )
        r = reference("multisine", 5.0, 100.0)
        recording, _ = simulate(loop, r, noise_u_std=0.1, noise_y_std=0.01, seed=8)
        rng = np.random.default_rng(8)
        inputs = np.column_stack([r, 0.1 * rng.standard_normal(len(r)), 0.01 * rng.standard_normal(len(r))])
        from_rest = np.vstack([np.zeros((1, 3)), inputs])
        u, y = closed_loop_system(loop, loop.plant).simulate(from_rest)[1:].T
        # in straight lines, the two differ in how u came to its first value
        late = slice(0 if hold == "zoh" else 400, None)
        assert close(u[late], recording.u[late], 1e-8)
        assert close(y[late], recording.y[late], 1e-8)
        y_a = instrument_system(loop).simulate(from_rest[:, :1])[1:, 0]
        assert close(y_a[late], simulate_response(loop, r)[1][late], 1e-8)

    def test_needs_a_controller_and_a_stable_loop(self, rig: dict[str, Any]) -> None:
        wild = Loop.from_dict(rig | {"controller": {"kind": "pi", "k_p": 2000.0, "k_i": 5.0}})
        with pytest.raises(LoopError, match="unstable"):
            closed_loop_system(wild, wild.plant)
        del rig["controller"]
        lonely = Loop.from_dict(rig)
        with pytest.raises(LoopError, match="controller"):
            closed_loop_system(lonely, lonely.plant)


class TestTheta:
    def test_golden_tustin_coefficients(self, rig: dict[str, Any]) -> None:
        c = tustin_coefficients(Loop.from_dict(rig).plant.theta(), 100.0)
        assert c == pytest.approx([57.83402840, 43.54921424, -46.40504564, -52.89873074], abs=5e-9)

    def test_golden_frequency_response(self, rig: dict[str, Any]) -> None:
        loop = Loop.from_dict(rig)
        H = build_filter_bank(loop).E([1.0, 10.0, 20.0]) @ nominal_theta(loop)
        golden = np.array([0.257754 + 1.657709j, 0.042040 + 16.497358j, -0.611638 + 32.511519j])
        assert np.abs(H - golden).max() < 1e-6

    def test_tustin_sees_a_warped_frequency(self, rig: dict[str, Any]) -> None:
        """E(f) c is H at s = 2 f_s (1 - q)/(1 + q), that is at tan(pi f/f_s) f_s/pi instead of f."""
        loop = Loop.from_dict(rig | {"monitor": {"structure": "tustin"}})
        f = np.array([0.5, 1.0, 10.0, 20.0, 45.0])
        s = 2j * 100.0 * np.tan(np.pi * f / 100.0)
        H = np.polyval(loop.plant.theta()[::-1], s)
        assert build_filter_bank(loop).E(f) @ nominal_theta(loop) == pytest.approx(H, rel=1e-10)

    def test_input_gain_and_extras_leave_H_in_units_of_u(self) -> None:
        plant = AXIS | {"friction": "coulomb", "offset": True, "input_gain": 4.0}
        bank = build_filter_bank(Loop.from_dict({"sample_rate": 100.0, "plant": plant}))
        theta = np.array([3.0, 5.0, 7.0, 9.0])  # viscous friction, inertia, coulomb friction, offset
        assert bank.names == ("viscous_friction", "inertia", "coulomb_friction", "offset")
        s = 2j * np.pi * 6.0
        assert (bank.E(6.0) @ theta)[0] == pytest.approx((3.0 * s + 5.0 * s**2) / 4.0)

    def test_tustin_refuses_columns_that_it_cannot_form(self) -> None:
        loop = Loop.from_dict(
            {"sample_rate": 100.0, "plant": AXIS | {"friction": "coulomb"}, "monitor": {"structure": "tustin"}}
        )
        with pytest.raises(LoopError, match="structure = 'svf'"):
            build_filter_bank(loop)
