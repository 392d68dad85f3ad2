"""The square-root valve law: what it makes of u, in the same state row, and what that is worth to a diagnosis."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from servoscope import learn
from servoscope.core.errors import LoopError, SimulationError
from servoscope.diagnosis.diagnose import diagnose
from servoscope.diagnosis.monitor import Monitor
from servoscope.estimation.pipeline import Pipeline
from servoscope.estimation.valve import ValveLaw
from servoscope.fit.tuning import least_squares
from servoscope.models.loop import Loop
from servoscope.models.lti import sample_system, state_variable_filter
from servoscope.signals import Recording
from servoscope.simulation import FaultEvent, reference, simulate, simulate_response, simulate_rig

SILENT = {"noise_u_std": 0.0, "noise_y_std": 0.0}
Array = npt.NDArray[np.float64]


def loop_of(rig: dict[str, Any], valve_law: str = "square-root", **changes: Any) -> Loop:
    slower = {"kind": "pi", "k_p": 10.0, "k_i": 5.0}
    return Loop.from_dict(rig | {"controller": slower, "plant": rig["plant"] | {"valve_law": valve_law}} | changes)


def naive(loop: Loop, u: Array, y: Array) -> Array:
    """u of a delay's whole samples ago, times the root, by the slow filter."""
    late = math.floor(loop.delay * loop.sample_rate + 1e-9)
    plant = loop.plant
    derivatives = (
        sample_system(state_variable_filter(20.0, 3), loop.sample_rate, "foh")
        .output(np.eye(3)[1:])
        .simulate(y[:, None])
    )
    p_L = (plant.k_p * y + derivatives @ [plant.b_p, plant.m_p]) / plant.A_p
    before = np.concatenate([np.full(late, u[0]), u])[: len(u)]
    return before * np.sqrt(1.0 - np.sign(before) * p_L / plant.p_s)


@pytest.mark.parametrize("delay", [0.0, 0.0128, 0.03])
def test_it_is_u_times_the_root_of_the_pressure_left(rig: dict[str, Any], delay: float) -> None:
    loop = loop_of(rig, delay=delay)
    recording, _ = simulate(loop_of(rig), reference("multisine", 5.0, 100.0), seed=1)
    valve = ValveLaw(loop)
    flow = valve.run(valve.start(), recording.u, recording.y, recording.restart)
    assert flow == pytest.approx(naive(loop, recording.u, recording.y), rel=1e-12)


def test_a_missing_sample_is_missing_and_what_follows_starts_anew(rig: dict[str, Any]) -> None:
    loop = loop_of(rig, delay=0.02)
    recording, _ = simulate(loop, reference("multisine", 5.0, 100.0), seed=1)
    u, y = recording.u.copy(), recording.y.copy()
    u[200], y[201], y[202] = np.nan, np.nan, 1e200
    valve = ValveLaw(loop)
    flow = valve.run(valve.start(), u, y, recording.restart)
    assert np.flatnonzero(np.isnan(flow)).tolist() == [200, 201, 202]
    assert flow[203:] == pytest.approx(naive(loop, u[203:], y[203:]), rel=1e-12)


def test_before_the_limiter_u_is_limited_first(rig: dict[str, Any]) -> None:
    limits = {"input_limits": [-0.1, 0.1]}
    before, after = loop_of(rig, input_logged="before_limiter", **limits), loop_of(rig)
    asked, _ = simulate(before, reference("multisine", 5.0, 100.0), seed=1)
    assert np.abs(asked.u).max() > 0.2
    one = Pipeline.of(before).regression(asked.r, asked.u, asked.y, asked.restart)
    other = Pipeline.of(after).regression(asked.r, np.clip(asked.u, -0.1, 0.1), asked.y, asked.restart)
    assert np.array_equal(one.eta, other.eta)


def test_small_motions_do_not_know_the_law(rig: dict[str, Any]) -> None:
    r = reference("multisine", 10.0, 100.0)
    linear = simulate_response(loop_of(rig, "linear"), r)
    for size, far in ((1.0, True), (1e-3, False)):
        curved = [signal / size for signal in simulate_response(loop_of(rig), size * r)]
        off = [np.abs(a - b).max() / np.abs(b).max() for a, b in zip(curved, linear, strict=True)]
        assert bool(max(off) > 0.04) is far
        assert far or max(off) < 1e-3


def test_its_inverse_does_not_move_with_the_amplitude(rig: dict[str, Any]) -> None:
    """The load pressure takes flow from the valve as a leak does: to the linear inverse a larger motion leaks more."""

    def real_part(law: str, amplitude: float) -> float:
        loop = loop_of(rig, law)
        u, y = simulate_response(loop_of(rig), amplitude * reference("multisine", 20.0, 100.0))
        r = restart = np.zeros(len(u))
        pipeline = Pipeline.of(loop)
        theta = least_squares(pipeline.regression(r, u, y, restart.astype(bool)))
        return float((pipeline.bank.E(1.0) @ theta)[0].real / loop.plant.frequency_response(1.0).real)

    assert [real_part("square-root", size) for size in (0.1, 0.5, 1.0)] == pytest.approx([1.0, 1.0, 1.0], abs=0.01)
    assert [real_part("linear", size) for size in (0.1, 0.5, 1.0)] == pytest.approx([1.047, 1.235, 1.476], abs=0.01)


def followed(monitor: Monitor, recording: Recording, cuts: list[int]) -> tuple[Array, Array]:
    state, thetas = monitor.init(), []
    signals = (recording.r, recording.u, recording.y, recording.restart)
    for block in np.split(np.arange(recording.samples), cuts):
        state, trace = monitor.run(state, *(signal[block] for signal in signals))
        thetas.append(trace.theta)
    return state, np.concatenate(thetas)


@pytest.mark.slow
def test_blocks_and_single_samples_leave_the_same_bits(rig: dict[str, Any]) -> None:
    loop = loop_of(rig, delay=0.0128)
    recording, _ = simulate(loop, reference("multisine", 30.0, 100.0), seed=1)
    monitor = Monitor(learn(loop, [recording]))
    part = recording.part(0.0, 3.0)
    whole, thetas = followed(monitor, part, [])
    for cuts in ([1], [7, 8, 150], [299]):
        state, again = followed(monitor, part, cuts)
        assert np.array_equal(state, whole) and np.array_equal(again, thetas)
    state = monitor.init()
    for sample in zip(part.r, part.u, part.y, strict=True):
        monitor.step(state, *(float(x) for x in sample))
    assert np.array_equal(state, whole)
    # a monitor and a diagnosis run the same recursion, whatever a monitor adds to its result once and for all
    added = thetas - monitor.pipeline.estimate(monitor.baselines[0].tuning, part).theta
    assert added == pytest.approx(np.broadcast_to(added[0], added.shape), abs=1e-12)


def test_what_does_not_go_together_is_refused(rig: dict[str, Any]) -> None:
    both = loop_of(rig, monitor={"two_stage": "adaptive"})
    recording, _ = simulate(both, reference("multisine", 30.0, 100.0), seed=1)
    with pytest.raises(LoopError, match="valve_law"):
        learn(both, [recording])
    with pytest.raises(SimulationError, match="zoh"):
        simulate(loop_of(rig, hold="foh"), np.zeros(9))


@pytest.mark.slow
def test_on_a_rig_with_friction_valve_and_warm_oil_it_sizes_a_leak_and_stands_a_smaller_motion(
    rig: dict[str, Any],
) -> None:
    def recorded(seed: int, amplitude: float = 1.0, faults: tuple[FaultEvent, ...] = ()) -> Recording:
        r = reference("multisine", 60.0, 100.0, amplitude=amplitude)
        return simulate_rig(loop_of(rig), r, seed=seed, faults=faults)[0]

    half, leaking = recorded(2, 0.5), recorded(3, faults=(FaultEvent("leakage", 1.2, 30.0),))
    linear, curved = (learn(loop_of(rig, law, delay=0.0128), [recorded(1)]) for law in ("linear", "square-root"))
    assert curved.recursion.R < 0.4 * linear.recursion.R
    assert diagnose(curved, half).verdict == "healthy"
    (found,) = diagnose(curved, leaking).faults
    assert found.parameter == "C_ie"
    assert found.ratio == pytest.approx(1.2, abs=0.02)
