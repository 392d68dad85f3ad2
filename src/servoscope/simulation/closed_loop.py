"""The closed loop itself: PI controller and exact plant, noisy with its truth or noise-free and fast."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from servoscope.errors import SimulationError
from servoscope.plants import FloatArray, Plant
from servoscope.simulation.discretise import discretise, split_delay
from servoscope.simulation.faults import FaultEvent, resolve, schedule, words
from servoscope.simulation.stability import check_stable, gains

if TYPE_CHECKING:
    from servoscope.loop import Loop
    from servoscope.recording import Recording
    from servoscope.simulation.kernels import Settings

NOISE_U_STD = 1e-4
NOISE_Y_STD = float(np.sqrt(1e-7))


@dataclass(frozen=True, eq=False)
class Truth:
    """What no recording contains.

    Parameters
    ----------
    t
        Times of the samples [s], shape (N,).
    y_true
        Output without measurement noise, shape (N,).
    u_true
        What acts on the plant: u after limits and dead zone, plus its noise, before the delay, shape (N,).
    ratios
        Parameters that change, each with its ratio to the nominal value from each sample to the next, shape
        (N,).
    theta
        Coefficients of the plant from each sample to the next, shape (N, n).
    faults
        The events, in order of time, with the names of their parameters.
    plant
        The nominal plant.
    """

    t: FloatArray
    y_true: FloatArray
    u_true: FloatArray
    ratios: dict[str, FloatArray]
    theta: FloatArray
    faults: tuple[FaultEvent, ...]
    plant: Plant


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

    The controller computes u(k) = k_p e(k) + k_i T sum e from e = r - y as measured, without anti-windup.
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

    Raises
    ------
    SimulationError
        If the loop has no controller or is unstable with one of the plants, or r or a fault does not fit.
    LoopError
        If the plant has no nominal values.
    """
    r = checked(r)
    n_u, n_y = noises(r.size, noise_u_std, noise_y_std, seed)
    events = resolve(loop.plant, faults)
    plan = schedule(loop.plant, events, r.size, loop.sample_rate)
    u, acting, y = Simulation(loop, plan.plants, words(plan)).advance(plan.which, r, n_u, n_y)
    recording = recorded(loop, r, u, y + n_y)
    ratios = {name: values[plan.which] for name, values in plan.ratios.items()}
    theta = np.array([plant.theta() for plant in plan.plants])[plan.which]
    return recording, Truth(recording.t, y, acting, ratios, theta, events, loop.plant)


def response(
    loop: Loop, r: npt.ArrayLike, *, plants: Sequence[Plant] | None = None, switch: Sequence[int] = (0,)
) -> tuple[FloatArray, FloatArray]:
    """Return u as logged and y, each (N,), of the loop without noise, from rest.

    Parameters
    ----------
    loop
        Loop with a controller.
    r
        Reference, shape (N,).
    plants
        Plants that follow each other, that of the loop if None; position, speed and pressure go on across a
        switch.
    switch
        Sample from which each of them holds; the first is 0, and they increase.

    Raises
    ------
    SimulationError
        If the loop has no controller or is unstable with one of the plants, or the arguments do not fit
        together.
    """
    r = checked(r)
    plants = (loop.plant,) if plants is None else tuple(plants)
    edges = np.asarray(switch, dtype=np.int64)
    if edges.shape != (len(plants),) or edges.size == 0 or edges[0] != 0 or np.any(np.diff(edges) <= 0):
        raise SimulationError("switch needs one sample per plant, increasing, the first of them 0")
    which = np.searchsorted(edges, np.arange(r.size), side="right") - 1
    u, _, y = Simulation(loop, plants).advance(which, r)
    return u, y


def checked(r: npt.ArrayLike) -> FloatArray:
    """Return a reference as a row of numbers, or refuse it."""
    reference = np.ascontiguousarray(r, dtype=np.float64)
    if reference.ndim != 1 or reference.size == 0 or not np.all(np.isfinite(reference)):
        raise SimulationError("the reference must be one row of finite numbers")
    return reference


def noises(samples: int, noise_u_std: float, noise_y_std: float, seed: int) -> tuple[FloatArray, FloatArray]:
    """Draw n_u and n_y, each (samples,)."""
    if not (noise_u_std >= 0.0 and noise_y_std >= 0.0):
        raise SimulationError("standard deviations of the noise must not be negative")
    rng = np.random.default_rng(seed)
    n_u = noise_u_std * rng.standard_normal(samples)
    return n_u, noise_y_std * rng.standard_normal(samples)


def recorded(loop: Loop, r: FloatArray, u: FloatArray, y: FloatArray) -> Recording:
    """Return signals that begin at time 0 as a recording without defects."""
    from servoscope.recording import Recording

    first = np.zeros(r.size, dtype=bool)
    first[0] = True
    return Recording(
        name=f"{loop.name} simulated",
        t=np.arange(r.size) / loop.sample_rate,
        r=r,
        u=u,
        y=y,
        sample_rate=loop.sample_rate,
        restart=first,
        run=np.zeros(r.size, dtype=np.int32),
        defects=(),
    )


class Simulation:
    """A loop from rest at zero, simulated piece by piece: its state is carried on, and where it is cut changes nothing.

    Parameters
    ----------
    loop
        Loop with a controller.
    plants
        Plants that it may have.
    called
        What errors call them.

    Raises
    ------
    SimulationError
        If the loop has no controller or is unstable with one of the plants.
    """

    def __init__(self, loop: Loop, plants: Sequence[Plant], called: Sequence[str] | None = None) -> None:
        settings = settings_of(loop)
        from servoscope.simulation import axis, kernels

        called = called or [f"plant {i + 1} of {len(plants)}" for i in range(len(plants))]
        discrete = [discretise(p.state_space(), loop.sample_rate, hold=loop.hold, delay=loop.delay) for p in plants]
        for each, what in zip(discrete, called, strict=True):
            check_stable(loop, each, what)
        self._unlimited = loop.input_logged != "after_limiter"
        self._run: Callable[..., object]
        if not loop.plant.linear:
            from servoscope.simulation.rig import nonlinear

            self._run, states = nonlinear(loop, plants, settings), 5
        elif loop.plant.extras:
            motion, states = axis.motion(plants, loop), 2
            self._run = lambda which, *signals: kernels.run_axis(motion, which, settings, *signals)
        else:
            A, b_next, b_now, b_late, c = (np.stack([each[i] for each in discrete]) for i in range(5))
            states, room = c.shape[1], np.zeros(c.shape[1])
            self._run = lambda which, *signals: kernels.run_linear(
                A, b_next, b_now, b_late, c, room, which, settings, *signals
            )
        self._state, self._acted = np.zeros(kernels.HEAD + states), np.zeros(settings.m + 2)

    def advance(
        self, which: npt.NDArray[np.int64], r: FloatArray, n_u: FloatArray | None = None, n_y: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return u as logged, what acts on the plant, and y without noise, each (N,).

        `which` (N,) numbers the plant from each sample to the next; without noises there are none.
        """
        nothing = np.zeros(r.size)
        noises = [nothing if noise is None else noise for noise in (n_u, n_y)]
        u, limited, y = np.empty((3, r.size))
        acting = np.concatenate([self._acted, nothing])
        self._run(which, r, *noises, self._state, u, limited, acting, y)
        past = self._acted.size
        self._acted = acting[r.size :]
        return (u if self._unlimited else limited), acting[past:], y


def settings_of(loop: Loop) -> Settings:
    """Return controller, limits, dead zone and delay of a loop as plain numbers."""
    from servoscope.simulation.kernels import Settings

    k_p, integrating = gains(loop)
    low, high = loop.input_limits or (-np.inf, np.inf)
    shut_low, shut_high = loop.input_deadzone or (np.inf, -np.inf)
    m, rest = split_delay(loop.delay, loop.sample_rate)
    return Settings(k_p, integrating, low, high, shut_low, shut_high, m, rest)
