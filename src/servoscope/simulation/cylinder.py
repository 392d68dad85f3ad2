"""A differential cylinder behind a servo valve, as machines have it: recordings beside their truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import SimulationError
from servoscope.signals import Recording
from servoscope.simulation.cylinder_kernels import STATES, run_cylinder
from servoscope.simulation.faults import FaultEvent
from servoscope.simulation.measurement import check_reference

REFERENCE_C = 45.0  # degC at which the rig's parameters hold
SETTLING_S = 1.5  # for which the reference is held before the recording begins


@dataclass(frozen=True)
class CylinderRig:
    """Two chambers, a valve with four edges, a supply that droops, friction with bristles, spring and process force.

    ::

        p_A' = beta(p_A)/V_A (q_A - A_A v - C_i (p_A - p_B)),   q = g o sqrt(dp) per edge,   o = max(|x| - overlap, 0)
        m v' = A_A p_A - A_B p_B - F_f - k y - F_g - F_p
        z' = v - sigma_0 |v| z/g(v),   F_f = sigma_0 z + sigma_1 z' + b v
        p_S' = ((p_0 - p_S)/R - q_S)/C,   1/beta(p) = 1/beta_0 + air p_atm/(n p^2)

    Valve and chambers follow Merritt (*Hydraulic Control Systems*, 1967), air in the oil and the supply Jelali and
    Kroll (*Hydraulic Servo-systems*, 2003), friction Canudas de Wit et al. (*IEEE Trans. Automatic Control* 40, 1995)
    with seals that press harder under pressure. Oil that is d kelvin warmer than 45 degC has the viscosity ratio
    exp(-viscosity_per_k d), to which leakage is inverse and viscous friction proportional; edges pass
    flow_per_k d more. The controller is a PI with feed-forward of the reference's speed by direction; u has 12 bits
    and acts one sample late.
    """

    # areas of the piston [m^2] and the rod's side, stroke [m], volume of each line [m^3]
    area_a: float = 1.963e-3
    area_b: float = 1.309e-3
    stroke: float = 0.3
    dead_volume: float = 4e-5
    bulk_modulus: float = 1.2e9  # of the oil without air [Pa]
    air: float = 0.005  # share of the volume at atmospheric pressure
    tank: float = 5e5  # Pa
    pump_pressure: float = 166e5  # without flow [Pa]
    supply_resistance: float = 7e9  # Pa s/m^3
    supply_capacity: float = 7e-11  # of the accumulator [m^3/Pa]
    # flow through an edge at full opening [m^3/(s sqrt(Pa))], for each direction
    gain_extend: float = 1.34e-7
    gain_retract: float = 1.34e-7
    overlap: float = 0.01  # share of the full stroke of the spool
    zero: float = 0.005  # where the spool is at u = 0, as such a share
    null_opening: float = 2e-4  # of the shut edges, as such a share
    valve_hz: float = 80.0
    valve_damping: float = 0.7
    hysteresis: float = 0.004  # width, as a share of full u
    leakage: float = 1.5e-13  # from one chamber to the other [m^3/(s Pa)]
    mass: float = 150.0  # kg
    weight: float = 1200.0  # N, against extension
    spring: float = 4e4  # N/m
    friction: float = 250.0  # Coulomb friction without pressure [N]
    seal: float = 2e-5  # more of it by pressure [N/Pa]
    static_ratio: float = 1.4  # static over Coulomb friction
    stribeck_speed: float = 0.01  # m/s
    viscous: float = 900.0  # N s/m
    bristle: float = 5e6  # stiffness sigma_0 [N/m]
    bristle_damping: float = 8e3  # sigma_1 [N s/m]
    process_force: float = 4000.0  # while it presses [N]
    process_scatter: float = 0.1  # its relative standard deviation from stroke to stroke
    contact: float = 0.06  # position at which it begins to press [m]
    temperature: float = REFERENCE_C  # of the oil [degC]
    warming: float = 1.5  # by which it rises during a recording [K]
    viscosity_per_k: float = 0.03
    flow_per_k: float = 0.0006
    sample_rate: float = 250.0  # Hz
    k_p: float = 330.0  # V/m
    k_i: float = 400.0  # V/(m s)
    feed_extend: float = 42.0  # V s/m
    feed_retract: float = 45.0
    limit: float = 10.0  # of u, at which the valve is fully open [V]
    noise_y: float = 4e-6  # m
    substeps: int = 40

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not np.isfinite(value):
                raise SimulationError(f"cylinder rig: {name} = {value:g} must be finite")
        if min(self.area_a, self.area_b, self.stroke, self.mass, self.sample_rate, self.substeps) <= 0.0:
            raise SimulationError("cylinder rig: areas, stroke, mass, sample_rate and substeps must be positive")


@dataclass(frozen=True, eq=False)
class CylinderTruth:
    """What no recording contains; arrays of shape (N,)."""

    drive: FloatArray  # of the valve, as a share of its full stroke, from each sample to the next
    # (N, 8): y [m], y', p_A [Pa], p_B, spool as a share of its full stroke, spool', bristle, p_S
    states: FloatArray
    laws: FloatArray  # (N, 12): `PARAMETERS` with faults and temperature, in the units of the rig


PARAMETERS = (
    "pump_pressure",
    "gain_extend",
    "gain_retract",
    "overlap",
    "zero",
    "valve_hz",
    "leakage",
    "air",
    "friction",
    "viscous",
    "mass",
    "process_force",
)
"""Parameters of the rig that a fault may multiply."""


def cylinder_motion(kind: str, duration_s: float, sample_rate: float, seed: int = 0) -> FloatArray:
    """Return a reference position [m], shape (duration_s sample_rate,).

    Parameters
    ----------
    kind
        ``production``, strokes that press at their end; ``teach``, slow moves between positions; ``sweep``, a chirp
        from 0.1 to 3 Hz.
    duration_s, sample_rate
        Length [s] and rate [Hz].
    seed
        Of positions and speeds.

    Raises SimulationError if the kind is unknown.
    """
    rng, samples = np.random.default_rng([seed, 7]), round(duration_s * sample_rate)
    if kind == "sweep":
        t = np.arange(samples) / sample_rate
        period = 20.0
        phase = 2.0 * np.pi * (0.1 * (t % period) + 0.5 * (2.9 / period) * (t % period) ** 2)
        speed = 2.0 * np.pi * (0.1 + 2.9 / period * (t % period))
        size = np.minimum(0.08, 0.12 / speed) * rng.uniform(0.9, 1.05)
        return np.asarray(size * np.sin(phase) * np.minimum(1.0, (t % period)) * np.minimum(1.0, period - t % period))
    if kind not in ("production", "teach"):
        raise SimulationError(f"motion {kind!r}: unknown, choose production, teach or sweep")
    position, pieces, count = -0.1, [], 0
    while count < samples:
        if kind == "production":
            moves = [
                (0.05 + rng.uniform(-0.004, 0.004), 0.15),
                (0.11 + rng.uniform(-0.003, 0.003), 0.05),
                (-0.1 + rng.uniform(-0.004, 0.004), 0.16),
            ]
        else:
            moves = [(rng.uniform(-0.11, 0.11), rng.uniform(0.02, 0.08))]
        for target, top in moves:
            length = max(0.2, 1.9 * abs(target - position) / top)  # the fastest of least jerk is at 15/8 of the mean
            s = np.arange(0.0, 1.0, 1.0 / (sample_rate * length))
            move = position + (target - position) * (10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5)
            pieces += [move, np.full(int(rng.uniform(0.2, 0.5) * sample_rate), target)]
            position, count = target, count + len(pieces[-1]) + len(move)
    return np.concatenate(pieces)[:samples]


def simulate_cylinder(
    r: npt.ArrayLike, rig: CylinderRig | None = None, *, faults: Sequence[FaultEvent] = (), seed: int = 0
) -> tuple[Recording, CylinderTruth]:
    """Simulate the rig under a reference.

    Parameters
    ----------
    r
        Reference [m], shape (N,), for example of `cylinder_motion`; it must stay within the stroke.
    rig
        The rig; None for the defaults.
    faults
        Changes of one of `PARAMETERS`, by the ratio to the rig's own value.
    seed
        Of noise and process forces.

    Returns
    -------
    Recording, CylinderTruth
        r [m], u [V] and y [m] as a machine logs them, with the channels ``p_A``, ``p_B``, ``p_S`` [Pa] and
        ``T_oil`` [degC]; and the truth.

    Raises SimulationError if r or a fault does not fit.
    """
    rig = CylinderRig() if rig is None else rig
    r = check_reference(r)
    if np.abs(r).max() >= 0.5 * rig.stroke:
        raise SimulationError(f"the reference must stay within half the stroke, {0.5 * rig.stroke:g} m")
    settling = round(SETTLING_S * rig.sample_rate)
    whole = np.concatenate([np.full(settling, r[0]), r])
    N = whole.size
    rng = np.random.default_rng([seed, 1])
    t = (np.arange(N) - settling) / rig.sample_rate
    temperature = rig.temperature + rig.warming * np.maximum(t, 0.0) / max(t[-1], 1.0)
    laws = _laws(rig, faults, t, temperature, _forces(rig, whole, rng))
    speed = np.gradient(whole) * rig.sample_rate
    feed = np.where(speed > 0.0, rig.feed_extend, rig.feed_retract) * speed
    noise = rig.noise_y * rng.standard_normal(N)
    begin = np.zeros(STATES)
    p_b = 0.35 * rig.pump_pressure
    p_a = (rig.area_b * p_b + rig.spring * r[0] + rig.weight) / rig.area_a
    begin[[0, 2, 3, 4, 7]] = r[0], p_a, p_b, -rig.zero, rig.pump_pressure
    u, acting, y, states = np.empty(N), np.empty(N), np.empty(N), np.empty((N, STATES))
    numbers, names = tuple(map(float, vars(rig).values())), tuple(vars(rig))
    run_cylinder(numbers, laws, whole, feed, noise, begin, u, acting, y, states, names=names, parameters=PARAMETERS)
    if not np.isfinite(states).all():
        raise SimulationError("cylinder rig: the integration left all bounds, raise substeps")
    used = slice(settling, None)
    channels = dict(zip(("p_A", "p_B", "p_S"), states[used, [2, 3, 7]].T.copy(), strict=True))
    recording = Recording(
        name="cylinder simulated",
        t=t[used],
        r=r,
        u=u[used],
        y=y[used],
        sample_rate=rig.sample_rate,
        restart=np.arange(r.size) == 0,
        run=np.zeros(r.size, dtype=np.int32),
        channels={**channels, "T_oil": temperature[used]},
    )
    return recording, CylinderTruth(
        drive=acting[used],
        states=states[used],
        laws=laws[used],
    )


def _forces(rig: CylinderRig, r: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return the process force of each sample's stroke [N], shape (N,)."""
    pressing = r > rig.contact
    strokes = np.cumsum(pressing & ~np.append(False, pressing[:-1]))
    return np.asarray(rig.process_force * (1.0 + rig.process_scatter * rng.standard_normal(strokes[-1] + 1))[strokes])


def _laws(
    rig: CylinderRig, faults: Sequence[FaultEvent], t: FloatArray, temperature: FloatArray, force: FloatArray
) -> FloatArray:
    """Return the rows of the kernel, (N, 12), with faults and temperature."""
    values = {name: np.full(len(t), getattr(rig, name)) for name in PARAMETERS} | {"process_force": force}
    warm = temperature - REFERENCE_C
    thickness = np.exp(-rig.viscosity_per_k * warm)
    for name, factor in (("leakage", 1.0 / thickness), ("viscous", thickness)):
        values[name] = values[name] * factor
    for name in ("gain_extend", "gain_retract"):
        values[name] = values[name] * (1.0 + rig.flow_per_k * warm)
    for fault in faults:
        if fault.parameter not in values:
            raise SimulationError(f"fault {fault}: the cylinder rig has {', '.join(PARAMETERS)}")
        grown = np.clip((t - fault.at_s) / fault.ramp_s, 0.0, 1.0) if fault.ramp_s else (t >= fault.at_s) * 1.0
        values[fault.parameter] = values[fault.parameter] * fault.ratio ** np.where(t < 0.0, fault.at_s <= 0.0, grown)
    return np.column_stack(list(values.values()))
