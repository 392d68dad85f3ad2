"""Feed-forward of the reference's speed and damping by the valve: loops as machines have them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from servoscope.core.errors import SimulationError
from servoscope.estimation.filter_bank import closed_loop_system
from servoscope.models.discretise import discretise
from servoscope.models.loop import Loop
from servoscope.models.plants import parse_plant
from servoscope.simulation import check_stable, reference, simulate, simulate_response
from servoscope.simulation.closed_loop import LoopSimulation


@pytest.fixture
def settings(rig: dict[str, Any]) -> dict[str, Any]:
    return rig | {"controller": {"kind": "pi", "k_p": 15.0, "k_i": 4.0, "k_v": 1.5}}


def by_hand(loop: Loop, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Run controller and plant sample by sample, as the docstring of the controller says."""
    assert loop.controller is not None
    plant = discretise(loop.plant.state_space(), loop.sample_rate)
    T, x, total, before = 1.0 / loop.sample_rate, np.zeros(3), 0.0, r[0]
    us, ys = [], []
    for value in r:
        y = float(plant.c @ x)
        total += T * (value - y)
        u = loop.controller.k_p * (value - y) + loop.controller.k_i * total + loop.controller.k_v * (value - before) / T
        if loop.input_limits:
            u = float(np.clip(u, *loop.input_limits))
        x, before = plant.A @ x + plant.b_now * u, value
        us.append(u)
        ys.append(y)
    return np.array(us), np.array(ys)


@pytest.mark.parametrize("change", [{}, {"input_limits": [-0.3, 0.3]}])
@pytest.mark.parametrize("k_i", [0.0, 4.0])
def test_it_is_the_law_of_the_docstring(settings: dict[str, Any], change: dict[str, Any], k_i: float) -> None:
    loop = Loop.from_dict(settings | change | {"controller": settings["controller"] | {"k_i": k_i}})
    r = reference("multisine", 10.0, loop.sample_rate)
    u, y = simulate_response(loop, r)
    expected_u, expected_y = by_hand(loop, r)
    np.testing.assert_allclose(u, expected_u, atol=1e-9)
    np.testing.assert_allclose(y, expected_y, atol=1e-10)


def test_the_closed_loop_as_a_linear_system_says_the_same(settings: dict[str, Any]) -> None:
    loop = Loop.from_dict(settings)
    r = reference("profile", 10.0, loop.sample_rate)
    u, y = simulate_response(loop, r)
    system = closed_loop_system(loop, loop.plant)
    said = system.simulate(np.column_stack([r, np.zeros((len(r), 2))]))
    np.testing.assert_allclose(said[200:], np.column_stack([u, y])[200:], atol=1e-6)


def test_pieces_and_a_second_run_change_nothing(settings: dict[str, Any]) -> None:
    loop = Loop.from_dict(settings)
    r, which = reference("multisine", 10.0, loop.sample_rate), np.zeros(1000, dtype=np.int64)
    whole = LoopSimulation(loop, [loop.plant])
    u = whole.run(which, r)[0]
    pieces = whole.again()
    parts = [pieces.run(which[k : k + 130], r[k : k + 130])[0] for k in range(0, 1000, 130)]
    np.testing.assert_array_equal(np.concatenate(parts), u)


def test_without_it_nothing_changes(rig: dict[str, Any]) -> None:
    plain, zero = Loop.from_dict(rig), Loop.from_dict(rig | {"controller": rig["controller"] | {"k_v": 0.0}})
    assert plain.hash() == zero.hash()
    r = reference("profile", 10.0, plain.sample_rate)
    np.testing.assert_array_equal(simulate(plain, r, seed=1)[0].u, simulate(zero, r, seed=1)[0].u)


def test_a_valve_that_gives_way_to_the_load_damps_the_loop(rig: dict[str, Any]) -> None:
    plant = parse_plant(rig["plant"])
    leaky = parse_plant(rig["plant"] | {"K_c": 3e-12, "C_ie": 3e-12})
    np.testing.assert_allclose(leaky.theta(), plant.theta(), rtol=1e-12)
    for a, b in zip(leaky.state_space(), plant.state_space(), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)
    assert "K_c" not in plant.model_dump()
    gains = {"controller": {"kind": "pi", "k_p": 400.0, "k_i": 5.0}, "sample_rate": 1000.0}
    undamped, damped = (Loop.from_dict(rig | gains | {"plant": rig["plant"] | {"K_c": K_c}}) for K_c in (0.0, 5e-10))
    with pytest.raises(SimulationError, match="unstable"):
        check_stable(undamped, discretise(undamped.plant.state_space(), 1000.0), "healthy")
    check_stable(damped, discretise(damped.plant.state_space(), 1000.0), "healthy")
