"""The compiled loop of the cylinder rig: controller, valve with four edges, two chambers, supply and friction."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

from servoscope.core.jit import maximum, minimum, sqrt, where
from servoscope.core.jit.array_function import ArrayFunction
from servoscope.core.jit.arrays import Array, Variable
from servoscope.simulation.linear_kernels import runge_kutta_step

TURBULENT_PA = 1e4  # pressure drop below which the flow through an edge becomes laminar, so that its slope is finite
MIN_PRESSURE_PA = 1e4  # of a chamber: below it oil evaporates, and the bulk modulus is that of foam
CONTACT_M = 0.005  # distance over which the process force rises after the contact

ATMOSPHERE_PA, POLYTROPIC = 1e5, 1.4  # of the air in the oil

STATES = 8


def flow(drop: Any) -> Any:
    """Return sign(drop) sqrt(|drop|), laminar near zero (Merritt, 1967, section 3-2)."""
    return drop / sqrt(abs(drop) + TURBULENT_PA)


def derivative(printer: Any, p: Any, law: Any, drive: Any, x: Sequence[Any]) -> list[Any]:
    """Return x' under a held drive, x = [y, y', p_A, p_B, spool, spool', bristle, p_S], of the rig p."""
    y, v, p_a, p_b, spool, spool_speed, z, p_s = x
    at, valve = spool + law.zero, 2.0 * math.pi * law.valve_hz
    out = maximum(at - law.overlap, 0.0) * law.gain_extend
    back = maximum(-at - law.overlap, 0.0) * law.gain_retract
    null = p.null_opening * law.gain_extend
    into_a, into_b = (out + null) * flow(p_s - p_a), (back + null) * flow(p_s - p_b)
    from_a, from_b = (back + null) * flow(p_a - p.tank), (out + null) * flow(p_b - p.tank)
    leak = law.leakage * (p_a - p_b)
    stiffness = []
    for pressure in (p_a, p_b):
        low = maximum(pressure, MIN_PRESSURE_PA)
        stiffness.append(p.bulk_modulus / (1.0 + p.bulk_modulus * (law.air * ATMOSPHERE_PA / POLYTROPIC) / (low * low)))
    volume_a = p.dead_volume + p.area_a * (0.5 * p.stroke + y)
    volume_b = p.dead_volume + p.area_b * (0.5 * p.stroke - y)
    coulomb = law.friction + p.seal * (p_a + p_b)
    ratio = v / p.stribeck_speed
    limit = coulomb * (1.0 + (p.static_ratio - 1.0) * printer.call_library("exp", -ratio * ratio))
    slip = v - p.bristle * abs(v) / limit * z
    friction = p.bristle * z + p.bristle_damping * slip + law.viscous * v
    pressed = law.process_force * minimum(maximum((y - p.contact) / CONTACT_M, 0.0), 1.0)
    force = p.area_a * p_a - p.area_b * p_b - friction - p.spring * y - p.weight - pressed
    return [
        v,
        force * (1.0 / law.mass),
        (into_a - from_a - p.area_a * v - leak) * stiffness[0] / volume_a,
        (into_b - from_b + p.area_b * v + leak) * stiffness[1] / volume_b,
        spool_speed,
        valve * (valve * (drive - spool) - 2.0 * p.valve_damping * spool_speed),
        slip,
        ((law.pump_pressure - p_s) / p.supply_resistance - into_a - into_b) / p.supply_capacity,
    ]


@ArrayFunction
def run_cylinder(
    printer: Any, rig: Any, laws: Any, r: Any, feed: Any, n_y: Any, begin: Any, u: Any, acting: Any,
    y: Any, truth: Any, *, names: tuple[str, ...], parameters: tuple[str, ...],
) -> None:  # fmt: skip
    """Run the closed loop; `laws` (N, 12) holds rows of `parameters`, `begin` (STATES,) the state at the first sample.

    `rig` holds the numbers of a `CylinderRig`, which are called `names`; `feed` (N,) is the feed-forward of u. Writes u
    as logged, the spool's command from each sample to the next, y as measured, each (N,), and the states (N, STATES).
    """
    p, x = SimpleNamespace(**dict(zip(names, rig, strict=True))), Array.scratch(printer, "double", STATES)
    T, integral_gain, hysteresis = 1.0 / p.sample_rate, p.k_i / p.sample_rate, 0.5 * p.hysteresis * p.limit
    input_step, resolution = 2.0 * p.limit / 4096.0, p.stroke / 2.0**16  # u has 12 bits, the sensor 16
    # the controller's sum, u of the sample before, and what the hysteresis of the valve makes of it
    total, late, held = (Variable(printer, 0.0 * feed[0]) for _ in range(3))
    for i in range(STATES):
        x[i] = begin[i]
    h = T / p.substeps
    for k in printer.loop(0, r.shape[0]):
        law = SimpleNamespace(**{name: laws[k, i] for i, name in enumerate(parameters)})
        for i in range(STATES):
            truth[k, i] = x[i]
        y[k] = resolution * ((x[0] + n_y[k]) / resolution).call("rint")
        error = r[k] - y[k]
        summed = total.value + integral_gain * error
        wanted = feed[k] + p.k_p * error + summed
        limited = minimum(maximum(wanted, -p.limit), p.limit)
        # a sum that would only grow while u is at its limit is held
        total.value = where(abs(wanted) <= p.limit, summed, total.value)
        u[k] = input_step * (limited / input_step).call("rint")
        held.value = minimum(maximum(held.value, late.value - hysteresis), late.value + hysteresis)
        late.value = u[k]  # one sample of dead time
        drive = held.value / p.limit
        acting[k] = drive
        for _ in printer.loop(0, printer.truncate(p.substeps)):
            runge_kutta_step(x, STATES, h, functools.partial(derivative, printer, p, law, drive))
