"""The closed loop itself: PI controller and exact plant, noisy with its truth or noise-free and fast."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Self

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import SimulationError
from servoscope.models.discretise import discretise
from servoscope.models.loop import Loop
from servoscope.models.plants import Plant
from servoscope.signals import Recording
from servoscope.simulation.faults import FaultEvent, describe_plants, resolve_faults, schedule_plants
from servoscope.simulation.linear_kernels import HEADER_SIZE, axis_constants, run_axis, run_linear
from servoscope.simulation.measurement import (
    NOISE_U_STD,
    NOISE_Y_STD,
    FeedForward,
    Truth,
    check_reference,
    controller_constants,
    draw_noise,
    make_recording,
)
from servoscope.simulation.nonlinear_eha import nonlinear_run
from servoscope.simulation.stability import check_stable


def simulate(
    loop: Loop,
    r: npt.ArrayLike,
    *,
    faults: Sequence[FaultEvent] = (),
    noise_u_std: float = NOISE_U_STD,
    noise_y_std: float = NOISE_Y_STD,
    seed: int = 0,
) -> tuple[Recording, Truth]:
    """Simulate a loop with its plant, faults and noise.

    The controller computes u(k) = k_p e(k) + k_i T sum e + k_v (r(k) - r(k-1))/T from e = r - y as measured,
    without anti-windup.
    Limits and the dead zone of the loop apply: inside the dead zone nothing passes, outside u acts as it
    is.

    Parameters
    ----------
    loop
        Loop with a controller and a plant whose nominal values are known.
    r
        Reference, shape (N,), for example of `reference`.
    faults
        Events, one or several; times count from the first sample.
    noise_u_std, noise_y_std
        Standard deviations of white noise that enters the plant with u, and that is part of the measured y.
    seed
        Seed of the noise.

    Returns
    -------
    Recording, Truth
        r, u and y as a machine would log them (u before or after its limiter, as the loop says), and the
        truth.

    Raises SimulationError if the loop has no controller or is unstable with one of the plants, or r or a fault does
    not fit, LoopError if the plant has no nominal values.

    Examples
    --------
    >>> from servoscope.simulation import FaultEvent, reference
    >>> from servoscope.simulation.tutorial import AXIS
    >>> loop = ss.Loop.from_dict(AXIS)
    >>> r = reference("trapezoid", 20.0, loop.sample_rate)
    >>> recording, truth = simulate(loop, r, faults=[FaultEvent.parse("inertia=1.5@10")], seed=1)
    >>> truth.ratios["inertia"][[0, -1]]
    array([1. , 1.5])
    """
    r = check_reference(r)
    n_u, n_y = draw_noise(r.size, noise_u_std, noise_y_std, seed)
    events = resolve_faults(loop.plant, faults)
    plan = schedule_plants(loop.plant, events, r.size, loop.sample_rate)
    u, acting, y = LoopSimulation(loop, plan.plants, describe_plants(plan)).run(plan.plant_index, r, n_u, n_y)
    recording = make_recording(loop, r, u, y + n_y)
    ratios = {name: values[plan.plant_index] for name, values in plan.ratios.items()}
    theta = np.array([plant.theta() for plant in plan.plants])[plan.plant_index]
    return recording, Truth(recording.t, y, acting, ratios, theta, events, loop.plant)


def simulate_response(
    loop: Loop, r: npt.ArrayLike, *, plants: Sequence[Plant] | None = None, switch: Sequence[int] = (0,)
) -> tuple[FloatArray, FloatArray]:
    """Return u as logged and y, each (N,), of the loop without noise, from rest.

    `plants`: plants that follow each other, that of the loop if None; position, speed and pressure go on across a
    switch; `switch`: sample from which each of them holds. Raises SimulationError if the loop has no controller or is
    unstable with one of the plants, or the arguments do not fit together.
    """
    r = check_reference(r)
    plants = (loop.plant,) if plants is None else tuple(plants)
    edges = np.asarray(switch, dtype=np.int64)
    if edges.shape != (len(plants),) or edges.size == 0 or edges[0] != 0 or np.any(np.diff(edges) <= 0):
        raise SimulationError("switch needs one sample per plant, increasing, the first of them 0")
    which = np.searchsorted(edges, np.arange(r.size), side="right") - 1
    u, _, y = LoopSimulation(loop, plants).run(which, r)
    return u, y


class LoopSimulation:
    """A loop from rest at zero, simulated chunk by chunk: any size of chunks gives the same result.

    `plants`: those that the loop may have; `called`: what errors call them. Raises SimulationError if the loop has no
    controller or is unstable with one of the plants.
    """

    def __init__(self, loop: Loop, plants: Sequence[Plant], called: Sequence[str] | None = None) -> None:
        settings = controller_constants(loop)
        called = called or [f"plant {i + 1} of {len(plants)}" for i in range(len(plants))]
        discrete = [discretise(p.state_space(), loop.sample_rate, hold=loop.hold, delay=loop.delay) for p in plants]
        for discrete_plant, what in zip(discrete, called, strict=True):
            check_stable(loop, discrete_plant, what)
        self._unlimited, self._feed = loop.input_logged != "after_limiter", FeedForward(loop)
        self._kernel: Callable[..., object]
        if not loop.plant.linear:
            self._kernel, states = nonlinear_run(loop, plants, settings), 5
        elif loop.plant.extras:
            motion, states = axis_constants(plants, loop), 2
            order = 2 if "inertia" in plants[0].names else 1
            self._kernel = lambda which, *signals: run_axis(motion, which, settings, *signals, order=order)
        else:
            A, b_next, b_now, b_late, c = (np.stack([plant[i] for plant in discrete]) for i in range(5))
            states = c.shape[1]
            self._kernel = lambda which, *signals: run_linear(
                A, b_next, b_now, b_late, c, which, settings, *signals, n=states
            )
        self._state, self._past_input = (
            np.zeros(HEADER_SIZE + states),
            np.zeros(settings.delay_samples + 2),
        )

    def again(self) -> Self:
        """Return one at rest, whose constants are these."""
        other = copy.copy(self)
        other._state, other._past_input = np.zeros_like(self._state), np.zeros_like(self._past_input)
        other._feed = copy.copy(self._feed)
        other._feed.rewind()
        return other

    def run(
        self, which: npt.NDArray[np.int64], r: FloatArray, n_u: FloatArray | None = None, n_y: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return u as logged, what acts on the plant, and y without noise, each (N,).

        `which` (N,) numbers the plant from each sample to the next; without noises there are none.
        """
        nothing = np.zeros(r.size)
        noises = [nothing if noise is None else noise for noise in (n_u, n_y)]
        u, limited, y = np.empty((3, r.size))
        acting = np.concatenate([self._past_input, nothing])
        self._kernel(which, self._feed.run(r), *noises, self._state, u, limited, acting, y)
        past = self._past_input.size
        self._past_input = acting[r.size :]
        return (u if self._unlimited else limited), acting[past:], y
