"""A motor axis with friction and offset, cut into sub-steps for the compiled loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from servoscope.errors import SimulationError
from servoscope.plants import FloatArray, Plant
from servoscope.simulation.discretise import transition

if TYPE_CHECKING:
    from servoscope.loop import Loop
    from servoscope.simulation.kernels import Motion

SUB_STEPS = 20  # per sample; the axis stops and reverses to within one of them


def motion(plants: Sequence[Plant], loop: Loop) -> Motion:
    """Return the sub-steps of axes of order 1 or 2 that hold their input.

    Raises
    ------
    SimulationError
        If an axis has a higher order, or the input is not held.
    """
    from servoscope.simulation.kernels import Motion

    values = [dict(zip(plant.names, (float(v) for v in plant.theta()), strict=True)) for plant in plants]
    if any(name in value for value in values for name in ("jerk", "snap")):
        raise SimulationError("friction and offset are simulated up to order 2; without them any order is")
    if loop.hold != "zoh":
        raise SimulationError('friction and offset are simulated with hold = "zoh" only')
    duration = 1.0 / loop.sample_rate / SUB_STEPS
    steps = [[_sub_step(value, direction, duration) for direction in ("forward", "backward")] for value in values]
    gain = [plant.input_gain for plant in plants]
    stiffness, coulomb, offset = (
        np.array([value.get(name, 0.0) for value in values]) for name in ("stiffness", "coulomb_friction", "offset")
    )
    return Motion(
        order=2 if "inertia" in values[0] else 1,
        Phi=np.array([[Phi for Phi, _ in pair] for pair in steps]),
        g=np.array([[g for _, g in pair] for pair in steps]),
        gain=np.array(gain, dtype=np.float64),
        stiffness=stiffness,
        coulomb=coulomb,
        offset=offset,
        steps=SUB_STEPS,
    )


def _sub_step(value: dict[str, float], direction: str, duration: float) -> tuple[FloatArray, FloatArray]:
    """Return the transition (2, 2) of (y, y') and its response (2,) to a unit force, in one direction."""
    viscous = value.get("viscous_friction", value.get(f"viscous_friction_{direction}", 0.0))
    stiffness, inertia = value.get("stiffness", 0.0), value.get("inertia", 0.0)
    if inertia == 0.0:
        Phi, g, _ = transition(np.array([[-stiffness / viscous]]), np.array([[1.0 / viscous]]), duration)
        return np.diag([Phi[0, 0], 0.0]), np.array([g[0], 0.0])
    A = np.array([[0.0, 1.0], [-stiffness / inertia, -viscous / inertia]])
    Phi, g, _ = transition(A, np.array([[0.0], [1.0 / inertia]]), duration)
    return Phi, g
