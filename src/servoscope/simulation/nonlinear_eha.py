"""A rig closer to a real one: the EHA with square-root valve, friction, limits, valve dynamics, sensor, warm oil."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import SimulationError
from servoscope.models.discretise import discretise
from servoscope.models.loop import Loop
from servoscope.models.lti import LinearSystem
from servoscope.models.plants import Plant, StateSpace
from servoscope.models.plants.eha import EHA
from servoscope.signals import Recording
from servoscope.simulation.faults import FaultEvent, PlantSchedule, describe_plants, resolve_faults, schedule_plants
from servoscope.simulation.linear_kernels import HEADER_SIZE, ControllerConstants
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
from servoscope.simulation.nonlinear_eha_kernels import run_rig
from servoscope.simulation.stability import check_stable

REFERENCE_C = 40.0  # degC at which the plant's parameters hold
# largest rate times sub-step: on the reference rig y is then within 1e-5 m, a thirtieth of its noise
MAX_RATE_STEP = 0.5


@dataclass(frozen=True)
class Rig:
    """What a real electrohydraulic actuator has and the linear one has not; every field can be switched off.

    ::

        Q = K_q x sqrt(1 - sign(x) p_L/p_s),   x'' = w^2 (u - x) - 2 zeta w x',   w = 2 pi valve_hz
        F = b_p y' + (coulomb + (static - coulomb) exp(-(y'/stribeck_speed)^2)) tanh(y'/smooth_speed)

    with the load pressure p_L and the spool x in units of current (Merritt, *Hydraulic Control Systems*, 1967;
    Armstrong, Dupont and Canudas de Wit, *Automatica* 30, 1994). Oil that is d kelvin warmer than 40 degC
    has the viscosity ratio n = exp(-viscosity_per_k d): leakage C_ie/n, viscous friction b_p n, bulk modulus
    beta (1 - stiffness_per_k d).
    """

    load_pressure_flow: bool = True  # whether the flow follows the square root; if not, Q = K_q x
    coulomb: float = 60.0  # coulomb, static: friction in motion and when it begins [N]; 0 for none
    static: float = 90.0
    stribeck_speed: float = 0.03  # speed [m/s] within which static friction gives way
    # speed [m/s] within which the friction changes its sign; creep takes the place of sticking
    smooth_speed: float = 0.01
    current_limit: float | None = 0.5  # largest magnitude of u [A]; None for none beyond the loop's `input_limits`
    stroke: float | None = 0.2  # distance [m] between the hard stops, which lie evenly about 0; None for no stops
    # valve_hz, valve_damping: natural frequency [Hz] and damping of the valve; None for a valve that follows at once
    valve_hz: float | None = 80.0
    valve_damping: float = 0.7
    # resolution of the position sensor over the stroke, or over 0.2 m without one; None for no quantisation
    sensor_bits: int | None = 16
    # from u as logged to u acting, whatever the loop file believes; None for the loop file's delay
    delay_samples: float | None = 1.0
    temperature: float = REFERENCE_C  # of the oil at the first sample [degC]
    # warming, warming_time: by how much it rises in the end [K], and the time constant of that [s]
    warming: float = 2.0
    warming_time: float = 600.0
    viscosity_per_k: float = 0.04  # relative loss of viscosity [1/K]; 0.04 is an ISO VG 46 oil between 30 and 60 degC
    stiffness_per_k: float = 0.005  # relative loss of bulk modulus [1/K]
    substeps: int | None = None  # steps of the integration per sample; None for as many as the fastest mode asks for

    def __post_init__(self) -> None:
        positive = {
            name: getattr(self, name)
            for name in ("stribeck_speed", "smooth_speed", "current_limit", "stroke", "valve_hz", "valve_damping")
        } | {"sensor_bits": self.sensor_bits, "warming_time": self.warming_time, "substeps": self.substeps}
        for name, value in positive.items():
            if value is not None and not 0.0 < value < np.inf:
                raise SimulationError(f"rig: {name} = {value:g} must be positive and finite")
        if not 0.0 <= self.coulomb <= self.static < np.inf:
            raise SimulationError(f"rig: 0 <= coulomb = {self.coulomb:g} <= static = {self.static:g} must hold")
        if self.delay_samples is not None and not 0.0 <= self.delay_samples < np.inf:
            raise SimulationError(f"rig: delay_samples = {self.delay_samples:g} must not be negative")
        hottest = max(self.temperature, self.temperature + self.warming)
        if not (np.isfinite(self.temperature + self.warming) and self.stiffness_per_k * (hottest - REFERENCE_C) < 1.0):
            raise SimulationError(f"rig: at {hottest:g} degC nothing is left of the bulk modulus")

    @classmethod
    def ideal(cls) -> Rig:
        """Return a rig with everything switched off: the linear actuator, integrated instead of solved."""
        return cls(
            load_pressure_flow=False, coulomb=0.0, static=0.0, current_limit=None, stroke=None, valve_hz=None,
            sensor_bits=None, delay_samples=None, warming=0.0,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class RigTruth(Truth):
    """What no recording contains, `Truth` and more; `theta` is that of the linear plant at 40 degC, with its faults."""

    load_pressure: FloatArray  # p_L [Pa] at the samples, shape (N,)
    spool: FloatArray  # position of the valve's spool at the samples, in units of u, shape (N,)
    temperature: FloatArray  # of the oil [degC], shape (N,)
    # p_s, C_ie, b_p and beta as they were, with faults and temperature, each of shape (N,)
    parameters: dict[str, FloatArray]


def simulate_rig(
    loop: Loop,
    r: npt.ArrayLike,
    rig: Rig | None = None,
    *,
    faults: Sequence[FaultEvent] = (),
    noise_u_std: float = NOISE_U_STD,
    noise_y_std: float = NOISE_Y_STD,
    seed: int = 0,
) -> tuple[Recording, RigTruth]:
    """Simulate a loop as `simulate` does, on the nonlinear rig: fourth-order Runge-Kutta with fixed sub-steps.

    Parameters
    ----------
    loop
        Loop with a controller, a plant of kind ``eha``, and a held u. Valve and Coulomb friction are the rig's.
    r
        Reference [m], shape (N,).
    rig
        What the actuator has beyond the linear one; None for the defaults of `Rig`.
    faults, noise_u_std, noise_y_std, seed
        As in `simulate`.

    Returns
    -------
    Recording, RigTruth
        r, u and y as a machine would log them, and the truth.

    Raises SimulationError if the plant is no EHA, u is not held, or as for `simulate`; stability is judged without
    friction, at p_L = 0.
    """
    rig = Rig() if rig is None else rig
    r = check_reference(r)
    plant = loop.plant
    if not isinstance(plant, EHA):
        raise SimulationError(f"loop {loop.name!r}: the nonlinear rig is an actuator of kind 'eha', not {plant.kind!r}")
    _check_hold(loop)
    if rig.delay_samples is not None:
        loop = loop.model_copy(update={"delay": rig.delay_samples / loop.sample_rate})
    events = resolve_faults(plant, faults)
    plan = schedule_plants(plant, events, r.size, loop.sample_rate)
    for variant, what in zip(plan.plants, describe_plants(plan), strict=True):
        system = _prepend_valve(variant.state_space(), rig)
        check_stable(loop, discretise(system, loop.sample_rate, delay=loop.delay), what)
    t = np.arange(r.size) / loop.sample_rate
    temperature = rig.temperature + rig.warming * -np.expm1(-t / rig.warming_time)
    parameters = _parameters(plant, plan, rig, temperature)
    n_u, n_y = draw_noise(r.size, noise_u_std, noise_y_std, seed)
    settings = _without_areas(controller_constants(loop))
    limit = np.inf if rig.current_limit is None else rig.current_limit
    settings = settings._replace(low=max(settings.low, -limit), high=min(settings.high, limit))
    supply, leakage, friction, beta = parameters.values()
    leakage = plant.leakage_share * leakage + plant.K_c
    stiffness = (1.0 + plant.area_ratio**2) * beta / plant.V_o
    rows = np.column_stack([_flow_gain(plant, supply), 1.0 / supply, leakage, friction, stiffness])
    physics, past = _rig_constants(plant, rig, loop, rows), settings.delay_samples + 2
    u, limited, y = np.empty((3, r.size))
    acting = np.zeros(past + r.size)
    state = np.zeros(HEADER_SIZE + 5)
    measured, p_L, spool = run_rig(
        physics, settings, rows, FeedForward(loop).run(r), n_u, n_y, state, u, limited, acting, y
    )
    acting = acting[past:]
    recording = make_recording(loop, r, limited if loop.input_logged == "after_limiter" else u, measured)
    ratios = {name: values[plan.plant_index] for name, values in plan.ratios.items()}
    theta = np.array([plant.theta() for plant in plan.plants])[plan.plant_index]
    return recording, RigTruth(t, y, acting, ratios, theta, events, plant, p_L, spool, temperature, parameters)


def nonlinear_run(loop: Loop, plants: Sequence[Plant], settings: ControllerConstants) -> Callable[..., object]:
    """Return what runs the closed loop of actuators with the valve law and the Coulomb friction of their loop file.

    It takes which, r, n_u, n_y, the state, and what `servoscope.simulation.linear_kernels.run_linear` writes.

    Raises SimulationError if u is not held.
    """
    _check_hold(loop)
    actuators = [plant for plant in plants if isinstance(plant, EHA)]
    losses = [p.leakage_share * p.C_ie + p.K_c for p in actuators]
    rows = np.array(
        [
            [_flow_gain(p, p.p_s), 1.0 / p.p_s, lost, p.b_p, 1.0 / p.capacity]
            for p, lost in zip(actuators, losses, strict=True)
        ]
    )
    first = actuators[0]
    rig = replace(
        Rig.ideal(), load_pressure_flow=first.load_pressure is not None, coulomb=first.coulomb, static=first.coulomb
    )
    physics = _rig_constants(first, rig, loop, rows)
    return lambda which, *signals: run_rig(physics, _without_areas(settings), rows[which], *signals)


def _without_areas(settings: ControllerConstants) -> ControllerConstants:
    """Return settings under which u is the same in both directions: the rig tells them by its spool."""
    return settings._replace(negative_gain=1.0, positive_gain=1.0)


def _check_hold(loop: Loop) -> None:
    if loop.hold != "zoh":
        raise SimulationError(f"loop {loop.name!r}: a nonlinear actuator is simulated with a held u, set hold = 'zoh'")


def _flow_gain(plant: EHA, p_s: npt.ArrayLike) -> FloatArray:
    return np.asarray(plant.input_gain * plant.flow_gain * np.sqrt(np.asarray(p_s) / plant.p_s))


def _parameters(plant: EHA, plan: PlantSchedule, rig: Rig, temperature: FloatArray) -> dict[str, FloatArray]:
    """Return p_s, C_ie, b_p and beta at every sample, with faults and temperature."""
    above = temperature - REFERENCE_C
    thickness = np.exp(-rig.viscosity_per_k * above)
    factor = {"C_ie": 1.0 / thickness, "b_p": thickness, "beta": 1.0 - rig.stiffness_per_k * above}
    nominal = plant.model_dump(include=set(plant.parameters))
    healthy = {name: nominal[name] * factor.get(name, np.ones_like(above)) for name in plant.parameters}
    ratios = plant.expand_rays(plan.ratios)
    return {
        name: values * ratios[name][plan.plant_index] if name in ratios else values for name, values in healthy.items()
    }


def _prepend_valve(system: StateSpace, rig: Rig) -> StateSpace:
    """Put the valve's dynamics in front of a linear plant."""
    if rig.valve_hz is None:
        return system
    w, nothing = 2.0 * np.pi * rig.valve_hz, np.zeros((1, 1))
    A, B = np.array([[0.0, 1.0], [-w * w, -2.0 * rig.valve_damping * w]]), np.array([[0.0], [w * w]])
    whole = LinearSystem(A, B, np.eye(1, 2), nothing).then(LinearSystem(*system, nothing))
    return whole.A, whole.B, whole.C


def _rig_constants(plant: EHA, rig: Rig, loop: Loop, rows: FloatArray) -> dict[str, Any]:
    """Return what does not change during a recording, in plain numbers and SI units."""
    w = 0.0 if rig.valve_hz is None else 2.0 * np.pi * rig.valve_hz
    _, _, leakage, friction, stiffness = rows.T
    # rates of the modes that the sub-steps must follow: oil spring, leakage, friction (steepest at rest), valve
    swing = np.sqrt(float(np.max((plant.A_p**2 * stiffness + plant.k_p) / plant.m_p)))
    damping = (float(np.max(friction)) + rig.static / rig.smooth_speed) / plant.m_p
    fastest = max(swing, damping, float(np.max(leakage * stiffness)), w)
    substeps = rig.substeps or max(4, int(np.ceil(fastest / (MAX_RATE_STEP * loop.sample_rate))))
    stroke = np.inf if rig.stroke is None else rig.stroke
    span = 0.2 if rig.stroke is None else rig.stroke
    return {
        "mobility": 1.0 / plant.m_p,  # there are no divisions in the innermost loop
        "stiffness": plant.k_p,
        "area": plant.A_p,
        "square_root": rig.load_pressure_flow,
        "area_ratio": plant.area_ratio,
        "coulomb": rig.coulomb,
        "breakaway": rig.static - rig.coulomb,  # static friction beyond Coulomb friction
        "stribeck_speed": rig.stribeck_speed,
        "smooth_speed": rig.smooth_speed,
        "half_stroke": 0.5 * stroke,
        "valve": w,  # 0: the spool follows at once
        "damping": rig.valve_damping,
        "resolution": 0.0 if rig.sensor_bits is None else span / 2.0**rig.sensor_bits,  # 0: continuous
        "T": 1.0 / loop.sample_rate,
        "substeps": substeps,
    }
