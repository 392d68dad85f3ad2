"""Whether a loop is stable with a plant: poles of the sampled closed loop."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from servoscope.core.errors import SimulationError
from servoscope.models.discretise import DiscretePlant, discretise
from servoscope.models.loop import Controller, Loop
from servoscope.models.lti import LinearSystem, input_to_output
from servoscope.models.plants import Plant


def require_controller(loop: Loop) -> Controller:
    """Return the controller.

    Raises SimulationError if the loop has no controller.
    """
    if loop.controller is None:
        raise SimulationError(f"loop {loop.name!r} has no [controller]: a simulation needs one, kind, k_p and k_i")
    return loop.controller


def closed_loop_poles(loop: Loop, plant: Plant | None = None) -> npt.NDArray[np.complex128]:
    """Return the poles in z of the loop with its plant or another; stable if all magnitudes are below 1.

    Friction and offset of a plant are left out, and so are limits and dead zone. A delay adds poles near 0.

    Raises SimulationError if the loop has no controller; raises LoopError if the plant has no nominal values.
    """
    require_controller(loop)
    plant = loop.plant if plant is None else plant
    return discrete_closed_loop_poles(
        loop, discretise(plant.state_space(), loop.sample_rate, hold=loop.hold, delay=loop.delay)
    )


def settling_samples(loop: Loop, plant: Plant, share: float) -> int:
    """Return how many samples a loop takes until a share of its initial state is left; 0 where it never does."""
    slowest = float(np.abs(closed_loop_poles(loop, plant)).max())
    return int(np.ceil(np.log(share) / np.log(slowest))) if 0.0 < slowest < 1.0 else 0


def discrete_closed_loop_poles(loop: Loop, discrete: DiscretePlant) -> npt.NDArray[np.complex128]:
    """Return the closed-loop poles of a plant that is discretised already."""
    # States in SI differ by ten decades, which eigvals evens out itself only in part.
    from scipy.linalg import matrix_balance

    A = close_loop(loop, input_to_output(discrete)).A
    if not require_controller(loop).k_i:  # the sum stays 0: its pole is none of the loop
        A = A[:-1, :-1]
    return np.asarray(np.linalg.eigvals(matrix_balance(A)[0]), dtype=np.complex128)


def close_loop(loop: Loop, plant: LinearSystem) -> LinearSystem:
    """Put the PI controller around a sampled plant from u as logged to y: [r, n_u, n_y] -> [u, y as measured].

    Its states are those of the plant, and the sum of past errors. Raises SimulationError if the loop has no controller.
    """
    controller, dt, n = require_controller(loop), 1.0 / loop.sample_rate, len(plant.A)
    # rows below act on [x, s, r, n_u, n_y]. With y = c x + d (u + n_u) + n_y and u = gain e + k_i s, the error follows
    # from one linear equation.
    k_i, d = controller.k_i, float(plant.D[0, 0])
    gain = controller.k_p + k_i * dt
    s, r, n_u, n_y = np.eye(n + 4)[n:]
    output = np.zeros(n + 4)
    output[:n] = plant.C[0]
    e = (r - output - d * n_u - n_y - d * k_i * s) / (1.0 + d * gain)
    u = gain * e + k_i * s
    y = output + d * (u + n_u) + n_y
    x_next = np.hstack([plant.A, np.zeros((n, 4))]) + np.outer(plant.B[:, 0], u + n_u)
    s_next = s + dt * e if k_i else np.zeros(n + 4)  # where the sum is not used, its pole at 1 must not count
    both, outputs = np.vstack([x_next, s_next]), np.vstack([u, y])
    return LinearSystem(both[:, : n + 1], both[:, n + 1 :], outputs[:, : n + 1], outputs[:, n + 1 :])


def check_stable(loop: Loop, discrete: DiscretePlant, what: str) -> None:
    """Raise a SimulationError if a closed-loop pole with this plant lies on or outside the unit circle."""
    largest = float(np.max(np.abs(discrete_closed_loop_poles(loop, discrete))))
    if largest >= 1.0:
        raise SimulationError(
            f"loop {loop.name!r} is unstable with {what}: closed-loop pole of magnitude {largest:.4f}"
        )
