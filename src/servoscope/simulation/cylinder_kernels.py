"""The compiled loop of the cylinder rig: controller, valve with four edges, two chambers, supply and friction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from servoscope.core.jit import maximum, minimum, sqrt, where
from servoscope.core.jit.array_function import ArrayFunction
from servoscope.core.jit.arrays import Array, Variable

TURBULENT_PA = 1e4  # pressure drop below which the flow through an edge becomes laminar, so that its slope is finite
MIN_PRESSURE_PA = 1e4  # of a chamber: below it oil evaporates, and the bulk modulus is that of foam
CONTACT_M = 0.005  # distance over which the process force rises after the contact

STATES = 8


class Law(NamedTuple):
    """What may change with faults and temperature, one row per sample, in SI units."""

    pump_pressure: Any
    gain_extend: Any  # flow through an edge at full opening [m^3/(s sqrt(Pa))]
    gain_retract: Any
    overlap: Any  # share of the full stroke of the spool
    zero: Any  # the same: where the spool is at u = 0
    valve: Any  # natural frequency [rad/s]
    leakage: Any
    air: Any
    friction: Any
    viscous: Any
    mobility: Any  # 1/mass
    process_force: Any


class CylinderConstants(NamedTuple):
    """What does not change during a recording, in plain numbers and SI units."""

    area_a: float
    area_b: float
    half_stroke: float
    dead_volume: float
    bulk_modulus: float
    tank: float
    supply_resistance: float
    supply_capacity: float
    null_opening: float
    damping: float
    bristle: float
    bristle_damping: float
    static_ratio: float
    seal: float
    stribeck_speed: float
    spring: float
    weight: float
    contact: float
    full_input: float
    k_p: float
    integral_gain: float
    limit: float
    hysteresis: float
    input_step: float
    resolution: float
    T: float
    substeps: int


def flow(drop: Any) -> Any:
    """Return sign(drop) sqrt(|drop|), laminar near zero (Merritt, 1967, section 3-2)."""
    return drop / sqrt(abs(drop) + TURBULENT_PA)


def derivative(printer: Any, p: CylinderConstants, law: Law, x: Sequence[Any], drive: Any) -> list[Any]:
    """Return the time derivative of x = [y, y', p_A, p_B, spool, spool', bristle, p_S] under a held drive."""
    y, v, p_a, p_b, spool, spool_speed, z, p_s = x
    at = spool + law.zero
    out = maximum(at - law.overlap, 0.0) * law.gain_extend
    back = maximum(-at - law.overlap, 0.0) * law.gain_retract
    null = p.null_opening * law.gain_extend
    into_a, into_b = (out + null) * flow(p_s - p_a), (back + null) * flow(p_s - p_b)
    from_a, from_b = (back + null) * flow(p_a - p.tank), (out + null) * flow(p_b - p.tank)
    leak = law.leakage * (p_a - p_b)
    stiffness = []
    for pressure in (p_a, p_b):
        low = maximum(pressure, MIN_PRESSURE_PA)
        stiffness.append(p.bulk_modulus / (1.0 + p.bulk_modulus * law.air / (low * low)))
    volume_a = p.dead_volume + p.area_a * (p.half_stroke + y)
    volume_b = p.dead_volume + p.area_b * (p.half_stroke - y)
    coulomb = law.friction + p.seal * (p_a + p_b)
    ratio = v / p.stribeck_speed
    limit = coulomb * (1.0 + (p.static_ratio - 1.0) * printer.call_library("exp", -ratio * ratio))
    slip = v - p.bristle * abs(v) / limit * z
    friction = p.bristle * z + p.bristle_damping * slip + law.viscous * v
    pressed = law.process_force * minimum(maximum((y - p.contact) / CONTACT_M, 0.0), 1.0)
    force = p.area_a * p_a - p.area_b * p_b - friction - p.spring * y - p.weight - pressed
    return [
        v,
        force * law.mobility,
        (into_a - from_a - p.area_a * v - leak) * stiffness[0] / volume_a,
        (into_b - from_b + p.area_b * v + leak) * stiffness[1] / volume_b,
        spool_speed,
        law.valve * (law.valve * (drive - spool) - 2.0 * p.damping * spool_speed),
        slip,
        ((law.pump_pressure - p_s) / p.supply_resistance - into_a - into_b) / p.supply_capacity,
    ]


@ArrayFunction
def run_cylinder(
    printer: Any, p: CylinderConstants, laws: Any, r: Any, feed: Any, n_y: Any, begin: Any, u: Any, acting: Any,
    y: Any, truth: Any,
) -> None:  # fmt: skip
    """Run the closed loop; `laws` (N, 12) holds rows of `Law`, `begin` (STATES,) the state at the first sample.

    `feed` (N,) is the feed-forward of u. Writes u as logged, the spool's command from each sample to the next, y as
    measured, each (N,), and the states (N, STATES).
    """
    x = Array.scratch(printer, "double", STATES)
    # the controller's sum, u of the sample before, and what the hysteresis of the valve makes of it
    total, late, held = (Variable(printer, 0.0 * feed[0]) for _ in range(3))
    for i in range(STATES):
        x[i] = begin[i]
    h = p.T / printer.number(p.substeps)
    for k in printer.loop(0, r.shape[0]):
        law = Law(*(laws[k, i] for i in range(len(Law._fields))))
        for i in range(STATES):
            truth[k, i] = x[i]
        y[k] = p.resolution * ((x[0] + n_y[k]) / p.resolution).call("rint")
        error = r[k] - y[k]
        summed = total.value + p.integral_gain * error
        wanted = feed[k] + p.k_p * error + summed
        limited = minimum(maximum(wanted, -p.limit), p.limit)
        # a sum that would only grow while u is at its limit is held
        total.value = where(abs(wanted) <= p.limit, summed, total.value)
        u[k] = p.input_step * (limited / p.input_step).call("rint")
        held.value = minimum(maximum(held.value, late.value - p.hysteresis), late.value + p.hysteresis)
        late.value = u[k]  # one sample of dead time
        drive = held.value / p.full_input
        acting[k] = drive
        for _ in printer.loop(0, p.substeps):
            start, slopes = [x[i] for i in range(STATES)], []
            at = start
            for share in (0.5, 0.5, 1.0, None):
                slopes.append(derivative(printer, p, law, at, drive))
                if share is not None:
                    at = [value + share * h * slope for value, slope in zip(start, slopes[-1], strict=True)]
            for i, (a, b, c, d) in enumerate(zip(*slopes, strict=True)):
                x[i] = start[i] + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
