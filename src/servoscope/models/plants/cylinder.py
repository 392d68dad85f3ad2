"""A hydraulic cylinder behind a valve, without data sheet: what u asks for at each speed, position and load."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from servoscope.core.errors import LoopError
from servoscope.core.settings import NonEmptyStr, Settings
from servoscope.models.plants.base import Fault, StateSpace, read_translations
from servoscope.models.plants.columns import Column
from servoscope.models.plants.terms import TERM_TUPLE, UNIQUE_TERMS, TermColumn, TermPlant

TermName = Literal["jerk", "spring", "process", "droop", "overlap", "leakage", "offset"]

CHANNELS = "p_A", "p_B", "p_S"  # of logged pressures, in a recording
BY_DIRECTION = "velocity_forward", "velocity_backward"
ACCELERATION = TermColumn("acceleration", 2, 1, signed=True)
# term -> its column; the velocity by direction, for two areas, and the acceleration are part of every cylinder
TERMS: dict[str, TermColumn] = {
    "leakage": TermColumn("leakage", 0, 1, signed=True),
    "jerk": TermColumn("jerk", 3, 1, signed=True),
    # the root of the pressure that a spring leaves to the valve, to first order in the load
    "spring": TermColumn("spring", Column.SPEED_POSITION, 2, signed=True),
    # the same of a force beyond a position
    "process": TermColumn("process", Column.SPEED_BEYOND, 1, signed=True),
    # of a supply that gives way to the flow
    "droop": TermColumn("droop", Column.SPEED_SQUARED, 2, signed=True),
    "overlap": TermColumn("overlap", Column.SIGN),
    "offset": TermColumn("offset", Column.CONSTANT, signed=True),
}
"""What moves u besides the velocity, by the name that a loop file declares, in the order of the coefficients."""

LOAD_SHARE = 0.15  # of the supply pressure that load, friction and lines take, as the middle of 0 to 0.3
SUPPLY = {
    **dict.fromkeys(("acceleration", "jerk", "leakage"), -0.5),
    **dict.fromkeys(BY_DIRECTION, -0.5 / (1.0 - LOAD_SHARE)),
    **dict.fromkeys(("spring", "process", "droop"), -1.0 - 0.5 / (1.0 - LOAD_SHARE)),
}
EXPONENTS: dict[str, dict[str, float]] = {
    "supply_pressure": SUPPLY,
    "gain_forward": {"velocity_forward": -1.0, "acceleration": -0.5, "spring": -0.5, "process": -0.5},
    "gain_backward": {"velocity_backward": -1.0, "acceleration": -0.5, "spring": -0.5, "process": -0.5},
    # a force takes its part of the pressure, as a lower supply does, by the area on which it acts
    "load": {**dict.fromkeys(BY_DIRECTION, 1.0), **dict.fromkeys(("spring", "process", "droop"), 3.0)},
}
"""Parameters that move several coefficients; the flow through an edge is g x sqrt(p_S - p_load) (Merritt, 1967)."""

VALVE_CHECKS = "valve: contamination, worn edges, amplifier; its flow at a given pressure drop"
FAULTS = (
    Fault(
        "supply",
        "supply_pressure",
        (0.3, 2.0),
        "another supply pressure, or another flow of the valve both ways",
        "pump, relief valve, filter and accumulator: pressure at rest and in motion; or the valve and its amplifier",
    ),
    Fault("valve_forward", "gain_forward", (0.3, 3.0), "another flow of the valve forward", VALVE_CHECKS),
    Fault("valve_backward", "gain_backward", (0.3, 3.0), "another flow of the valve backward", VALVE_CHECKS),
    Fault(
        "friction",
        "load",
        (0.5, 3.0),
        "more u for the same speed, whatever the load: friction",
        "rod seal, guide and bearing: alignment, lubrication, side load",
    ),
    Fault(
        "leakage",
        "leakage",
        (0.05, 50.0),
        "more u to hold a load: leakage of piston or valve",
        "piston seal and valve edges: warm cylinder, drift under load with the valve shut, oil return flow",
    ),
    Fault(
        "overlap",
        "overlap",
        (0.1, 20.0),
        "more u before anything moves: overlap of the valve, hysteresis, static friction",
        "valve: worn edges, its zero, contamination; amplifier: dead band",
    ),
    Fault(
        "lag",
        "acceleration",
        (1.0, 20.0),
        "u comes late: a slow spool, a heavier load",
        "valve: pilot pressure, contamination, amplifier; mass that is moved",
    ),
    Fault(
        "air", "jerk", (1.0, 20.0), "softer oil: air", "oil: air in it, foam, water, age; oil level and suction line"
    ),
    Fault(
        "zero",
        "offset",
        (0.1, 10.0),
        "more u at rest: zero of the valve, another load at rest",
        "valve: zero and its amplifier; a load that hangs",
    ),
    Fault(
        "process_force",
        "process",
        (0.1, 10.0),
        "another process force, which is no fault of the cylinder",
        "process: product, tool, material",
    ),
)


class Pressures(Settings):
    """Columns of logged pressures, all three in one unit."""

    A: NonEmptyStr
    B: NonEmptyStr
    supply: NonEmptyStr


class CylinderPlant(TermPlant):
    """Cylinder ``input_gain u = c_forward max(y', 0) + c_backward min(y', 0) + acceleration y'' + sum of terms``.

    ::

        u = v/(g sqrt(p_S - p_load)),   p_load = (k y + F)/A sign(v)      orifice flow, to first order in the load
          = c v + spring abs(v) y + process abs(v) [y > contact] + overlap sign(v) + ... + offset
    """

    faults: ClassVar[tuple[Fault, ...]] = FAULTS  # of some no term shows anything, which `learn` says
    EXPONENTS: ClassVar[Mapping[str, Mapping[str, float]]] = EXPONENTS
    # the root of the load pressure is of first order here, so that large changes move other terms too
    ray_angles: ClassVar[Mapping[str, float]] = {
        **dict.fromkeys((fault.parameter for fault in FAULTS), 0.1),
        **dict.fromkeys(("supply_pressure", "load", "offset"), 0.05),
        "overlap": 0.25,
        "process": 0.3,
    }
    size_errors: ClassVar[Mapping[str, float]] = {"supply_pressure": 0.1}  # as `LOAD_SHARE` may be 0 to 0.3
    fits_stretches: ClassVar[bool] = True
    translations: ClassVar[Mapping[str, Mapping[str, str]]] = read_translations(__file__)

    kind: Literal["cylinder"] = "cylinder"
    terms: Annotated[tuple[TermName, ...], TERM_TUPLE, UNIQUE_TERMS] = (
        "spring",
        "overlap",
        "offset",
    )
    # output beyond which the force of the term ``process`` acts
    contact: Annotated[float | None, Field(allow_inf_nan=False)] = None
    # columns of the pressures at both sides of the piston, and of the supply: A is the side that u > 0 fills
    pressures: Annotated[Pressures, Field(exclude_if=lambda value: value is None)] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if ("process" in self.terms) != (self.contact is not None):
            raise ValueError("contact: belongs to the term process, give both or none of them")
        return self

    @property
    def has_physics(self) -> bool:
        """The columns say what u a motion asks for, and nothing of the motion that u makes."""
        return False

    @property
    def channels(self) -> Mapping[str, str]:
        """The pressures."""
        return {} if self.pressures is None else dict(zip(CHANNELS, vars(self.pressures).values(), strict=True))

    @property
    def columns(self) -> tuple[TermColumn, ...]:
        """Powers of s, the velocity by direction, and the other terms."""
        chosen = [column for term, column in TERMS.items() if term in self.terms]
        directions = TermColumn(BY_DIRECTION[0], Column.FORWARD, 1), TermColumn(BY_DIRECTION[1], Column.BACKWARD, 1)
        powers = {column.column: column for column in (*chosen, ACCELERATION) if isinstance(column.column, int)}
        others = [column for column in chosen if column.column not in powers]
        return *(powers[power] for power in sorted(powers)), *directions, *others

    @property
    def column_shapes(self) -> Mapping[Column, tuple[float, float]]:
        """Where the process force begins."""
        return {Column.SPEED_BEYOND: (self.contact or 0.0, 0.0)}

    @property
    def unwatched(self) -> tuple[str, ...]:
        """What no term shows."""
        return ("backlash", *(() if "overlap" in self.terms else ("coulomb_friction",)))

    def exponents(self, parameter: str, healthy: Mapping[str, float] | None = None) -> Mapping[str, float]:
        """Return the powers by coefficient; a force weighs more where it acts on the smaller area.

        At the same u the speeds of both directions are as the roots of the areas (Jelali and Kroll, 2003).
        """
        powers = super().exponents(parameter, healthy)
        if parameter != "load" or healthy is None:
            return powers
        forward, backward = (healthy[name] for name in BY_DIRECTION)
        return {**powers, "velocity_backward": (backward / forward) ** 2}

    def state_spaces(self, factors: Mapping[str, Any], count: int) -> StateSpace:
        """Raise LoopError: see `has_physics`."""
        raise LoopError('[plant] kind = "cylinder": cannot be simulated from its coefficients; simulate_cylinder can')
