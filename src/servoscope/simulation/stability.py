"""Whether a loop is stable with a plant: poles of the sampled closed loop."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from servoscope.core.errors import SimulationError
from servoscope.models.discretise import DiscretePlant, discretise
from servoscope.models.loop import Loop
from servoscope.models.plants import Plant


def controller_gains(loop: Loop) -> tuple[float, float]:
    """Return k_p and k_i T of the controller.

    Raises SimulationError if the loop has no controller.
    """
    if loop.controller is None:
        raise SimulationError(f"loop {loop.name!r} has no [controller]: a simulation needs one, kind, k_p and k_i")
    return loop.controller.k_p, loop.controller.k_i / loop.sample_rate


def closed_loop_poles(loop: Loop, plant: Plant | None = None) -> npt.NDArray[np.complex128]:
    """Return the poles in z of the loop with its plant or another; stable if all magnitudes are below 1.

    Friction and offset of a plant are left out, and so are limits and dead zone. A delay adds poles near 0.

    Raises SimulationError if the loop has no controller; raises LoopError if the plant has no nominal values.
    """
    controller_gains(loop)
    plant = loop.plant if plant is None else plant
    return discrete_closed_loop_poles(
        loop, discretise(plant.state_space(), loop.sample_rate, hold=loop.hold, delay=loop.delay)
    )


def settling_samples(loop: Loop, plant: Plant, share: float) -> int:
    """Return how many samples a loop takes until a share of its initial state is left; 0 where it never does."""
    slowest = float(np.abs(closed_loop_poles(loop, plant)).max())
    return int(np.ceil(np.log(share) / np.log(slowest))) if 0.0 < slowest < 1.0 else 0


def discrete_closed_loop_poles(loop: Loop, discrete: DiscretePlant) -> npt.NDArray[np.complex128]:
    """Return the closed-loop poles of a plant that is discretised already.

    The state is [w, s, u(k-1) ... u(k-m-1)], w the plant's state without the present u, s = k_i T sum e up
    to k-1.
    """
    k_p, integrating = controller_gains(loop)
    gain = k_p + integrating
    n, m, c = discrete.c.size, discrete.delay_samples, discrete.c
    size = n + 1 + m + 1
    share = float(c @ discrete.b_next) if m == 0 else 0.0
    # u as a row of the state: from u = gain e + s, e = -c w - share u.
    u = np.zeros(size)
    u[:n], u[n] = -gain * c, 1.0
    u /= 1.0 + gain * share
    e = -share * u
    e[:n] -= c
    past = np.eye(size)[n + 1 :]  # row i is u(k-1-i)
    acting = [u, *past]
    state = np.eye(size)[:n]
    if m == 0:
        state = state + np.outer(discrete.b_next, u)
    loop_matrix = np.zeros((size, size))
    loop_matrix[:n] = (
        discrete.A @ state + np.outer(discrete.b_now, acting[m]) + np.outer(discrete.b_late, acting[m + 1])
    )
    if m > 0:
        loop_matrix[:n] += np.outer(discrete.b_next, acting[m - 1])
    loop_matrix[n] = np.eye(size)[n] + integrating * e
    loop_matrix[n + 1] = u
    loop_matrix[n + 2 :] = past[:-1]
    if integrating == 0.0:  # the sum stays 0: its pole at 1 is none of the loop
        loop_matrix = np.delete(np.delete(loop_matrix, n, axis=0), n, axis=1)
    # States in SI differ by ten decades, which eigvals evens out itself only in part.
    from scipy.linalg import matrix_balance

    return np.asarray(np.linalg.eigvals(matrix_balance(loop_matrix)[0]), dtype=np.complex128)


def check_stable(loop: Loop, discrete: DiscretePlant, what: str) -> None:
    """Raise a SimulationError if a closed-loop pole with this plant lies on or outside the unit circle."""
    largest = float(np.max(np.abs(discrete_closed_loop_poles(loop, discrete))))
    if largest >= 1.0:
        raise SimulationError(
            f"loop {loop.name!r} is unstable with {what}: closed-loop pole of magnitude {largest:.4f}"
        )
