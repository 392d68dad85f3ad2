"""A motor axis or joint: inertia, and the terms of friction, gravity and cogging that its loop file declares."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from servoscope.core.arrays import FloatArray
from servoscope.models.plants.base import Fault, FaultRay, read_translations
from servoscope.models.plants.columns import COLUMN_FORMS, Column
from servoscope.models.plants.terms import TERM_TUPLE, UNIQUE_TERMS, TermColumn, TermPlant

Finite = Annotated[float, Field(allow_inf_nan=False)]
NOT_DUMPED = Field(exclude_if=lambda value: value in (None, "position"))  # hashes of loops without it stay as they were
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
TermName = Literal[
    "stiffness",
    "viscous",
    "viscous_by_direction",
    "coulomb",
    "stribeck",
    "offset",
    "gravity",
    "load_friction",
    "cogging",
]


TERMS: dict[str, tuple[TermColumn, ...]] = {
    "stiffness": (TermColumn("stiffness", 0, 1),),
    "viscous": (TermColumn("viscous_friction", 1, 1),),
    "viscous_by_direction": (
        TermColumn("viscous_friction_forward", Column.FORWARD, 1),
        TermColumn("viscous_friction_backward", Column.BACKWARD, 1),
    ),
    "coulomb": (TermColumn("coulomb_friction", Column.SIGN),),
    # Stribeck's fall of friction with speed by Hess and Soom (1990), which needs no exponential
    "stribeck": (TermColumn("stribeck_friction", Column.STRIBECK),),
    "offset": (TermColumn("offset", Column.CONSTANT, signed=True),),
    "gravity": (TermColumn("gravity", Column.SINE, signed=True),),
    # friction of a gear in proportion to the weight that it carries (Bittencourt and Gunnarsson, 2012)
    "load_friction": (TermColumn("load_friction", Column.LOAD),),
    "cogging": (
        TermColumn("cogging_sin", Column.COGGING_SIN, signed=True),
        TermColumn("cogging_cos", Column.COGGING_COS, signed=True),
    ),
}
"""What may act on an axis besides its inertia, by the name that a loop file declares."""

OF_POSITION = "stiffness", "gravity", "load_friction", "cogging"

MOVED_MASS_CHECKS = "what is moved: workpiece, tool; a loose belt or coupling, where the encoder sits at the motor"
# parameter -> name of the fault, all that does the same to u and y, and what to check
FAULTS = {
    "inertia": ("payload", "more moved mass: a payload, a coupling, a tool", MOVED_MASS_CHECKS),
    "viscous_friction": (
        "lubrication",
        "more friction at speed: thick, cold or too much lubricant, a tight seal",
        "lubricant: amount, kind, temperature; seals that are too tight",
    ),
    "coulomb_friction": (
        "dry_friction",
        "more friction at any speed: a dragging brake, a tight guide, dry bearings",
        "brake: does it open fully; guides and bearings: dirt, preload, alignment",
    ),
    "stribeck_friction": (
        "stick_slip",
        "more friction at low speed: worn or missing lubricant",
        "lubricant of guides and screw; wear of the guide",
    ),
    "stiffness": (
        "stiffness",
        "more force for the same way: a stiffer spring",
        "springs, stops and cables that hold the axis",
    ),
    "gravity": (
        "gravity",
        "more weight without more inertia: a balance that has lost its force",
        "weight balance: pressure, spring, counterweight",
    ),
    "input_gain": (
        "motor_constant",
        "more u for the same force: weak motor, magnets or amplifier",
        "motor and amplifier: temperature, phases, current limit; force or torque constant after an exchange",
    ),
}
# all that rubs: Viscous and Coulomb friction doubled together are half the inertia with twice the input gain
FRICTION = "viscous_friction", "coulomb_friction", "stribeck_friction", "load_friction"
FRICTION_FAULT = (
    "friction",
    "more friction of every kind: worn bearings, a tight guide, an old lubricant",
    "bearings and guides: wear, preload, alignment; lubricant: amount, age, temperature",
)
BY_DIRECTION = "viscous_friction_forward", "viscous_friction_backward"

# where a payload has weight and a known place
PAYLOAD_FAULTS = {
    "moved_mass": ("payload", "more moved mass: a payload, a tool", MOVED_MASS_CHECKS),
    "inertia": (
        "inertia",
        "more inertia without more weight: a coupling, a flywheel, a balanced load",
        MOVED_MASS_CHECKS,
    ),
}
GRAVITY_ACCELERATION = 9.81  # m/s^2


@cache  # a search asks for them at each of its thousands of steps
def _columns_of(terms: tuple[TermName, ...]) -> tuple[TermColumn, ...]:
    columns = [column for term in TERMS if term in terms for column in TERMS[term]]
    powers = [column for column in columns if isinstance(column.column, int)]
    return (*powers, TermColumn("inertia", 2, 1), *(column for column in columns if column not in powers))


@cache
def _names_of(terms: tuple[TermName, ...]) -> tuple[str, ...]:
    return tuple(column.coefficient for column in _columns_of(terms))


class AxisPlant(TermPlant):
    """Motor axis ``input_gain u = inertia y'' + sum of terms``, each a coefficient times a function of y and y'.

    Where y is a speed, y' and y'' are y itself and its derivative.
    """

    translations: ClassVar[Mapping[str, Mapping[str, str]]] = read_translations(__file__)
    kind: Literal["axis"] = "axis"
    terms: Annotated[tuple[TermName, ...], TERM_TUPLE, UNIQUE_TERMS] = ("viscous", "coulomb", "offset")
    # speed [output per s] at which the term ``stribeck`` has fallen to a half
    stribeck_speed: Positive | None = None
    # distance [output] after which the term ``cogging`` repeats
    period: Positive | None = None
    # output at which the load of the term ``gravity`` hangs, in rad
    hanging_at: Finite = 0.0
    # distance of a payload from the joint [m], with input_gain u in N m; 1 on a linear axis, with input_gain u in N
    payload_arm: Annotated[Positive | None, NOT_DUMPED] = None
    # mass of the payload in the healthy recordings [kg], where u is in no unit of force: it tells the scale of u
    payload_mass: Annotated[Positive | None, NOT_DUMPED] = None
    # what the output is: a position, or a speed, as drives log it; then no term can depend on the position
    y: Annotated[Literal["position", "speed"], NOT_DUMPED] = "position"

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if {"viscous", "viscous_by_direction"} <= set(self.terms):
            raise ValueError("terms: viscous_by_direction takes the place of viscous, remove one of them")
        for term, key in (("stribeck", "stribeck_speed"), ("cogging", "period")):
            if (term in self.terms) != (getattr(self, key) is not None):
                raise ValueError(f"{key}: belongs to the term {term}, give both or none of them")
        placed = [term for term in self.terms if term in OF_POSITION]
        if placed and self.derivative:
            raise ValueError(f'terms: {placed[0]} acts by the position, which y = "speed" does not tell, remove it')
        if "load_friction" in self.terms and "gravity" not in self.terms:
            raise ValueError("terms: load_friction grows with the load of gravity, add gravity")
        if self.payload_mass is not None and not self._lifts:
            raise ValueError("payload_mass: needs payload_arm and the term gravity, which tells what it weighs")
        return self

    @property
    def leading(self) -> Mapping[str, str]:
        """The inertia, and gravity beside a payload."""
        side = {"gravity": " beside payload_arm, its sign says where a payload pulls"} if self._lifts else {}
        return {"inertia": "", **side}

    @property
    def columns(self) -> tuple[TermColumn, ...]:
        """The columns of all terms and of the inertia, powers of s first."""
        return _columns_of(self.terms)

    @property
    def names(self) -> tuple[str, ...]:
        """Coefficients of the columns."""
        return _names_of(self.terms)

    @property
    def derivative(self) -> int:
        """The power of s by which y is ahead of a position."""
        return int(self.y == "speed")

    @property
    def column_shapes(self) -> Mapping[Column, tuple[float, float]]:
        """Factors and phases of Stribeck friction, gravity and cogging."""
        wave_number = 2.0 * np.pi / (self.period or 1.0)
        return {
            Column.STRIBECK: (1.0 / (self.stribeck_speed or 1.0), 0.0),
            Column.SINE: (1.0, -self.hanging_at),
            Column.LOAD: (1.0, -self.hanging_at),
            Column.COGGING_SIN: (wave_number, 0.0),
            Column.COGGING_COS: (wave_number, 0.5 * np.pi),
        }

    @property
    def acting(self) -> tuple[TermColumn, ...]:
        """All columns but that of the inertia, as the refit takes them."""
        return tuple(column for column in self.columns if column.coefficient != "inertia")

    def regressors(self, y: FloatArray, v: FloatArray) -> FloatArray:
        """Return what the coefficients of `acting` multiply, shape (columns, N), of y and y', shapes (N,)."""
        columns, shapes = [term.column for term in self.acting], self.column_shapes
        return np.array(
            [
                COLUMN_FORMS[column].values(y, v, *shapes.get(column, ()))
                if isinstance(column, Column)
                else (y, v)[column]
                for column in columns
            ]
        ).reshape(len(columns), len(y))

    @property
    def unwatched(self) -> tuple[str, ...]:
        """What no term shows."""
        friction = () if "coulomb" in self.terms else ("coulomb_friction",)
        return ("backlash", *friction, "compliance", *(() if {"offset", "gravity"} & set(self.terms) else ("load",)))

    @property
    def faults(self) -> tuple[Fault, ...]:
        """Changes that are told by name; friction that differs by direction changes in both."""
        by_direction = "viscous_by_direction" in self.terms
        known = {*self.names, "input_gain", *(("viscous_friction",) if by_direction else ())}
        told = FAULTS | PAYLOAD_FAULTS if self._lifts else FAULTS
        known |= {"moved_mass"} & {*told}
        if self.payload_mass is not None:  # what hangs there is that mass: more weight of it is more of it
            known -= {"gravity"}
        return tuple(
            self._fault(name, parameter, words, checks)
            for parameter, (name, words, checks) in told.items()
            if parameter in known
        )

    @property
    def ray_angles(self) -> Mapping[str, float]:  # type: ignore[override]
        """Of a payload whose mass gives the scale of u: friction carries it, too, and u is no exact force."""
        return {} if self.payload_mass is None else {"moved_mass": 0.2}

    @property
    def rays(self) -> tuple[FaultRay, ...]:
        """All terms of friction together where there are several, then what the loop file defines."""
        rubbing = [name for name in FRICTION if self.exponents(name)]
        name, words, checks = FRICTION_FAULT
        if len(rubbing) < 2 or any(ray.name == name for ray in self._rays):
            return self._rays
        known = self._fault(name, name, words, checks)
        return (FaultRay(name, tuple((parameter, 2.0) for parameter in rubbing), known), *self._rays)

    @property
    def _lifts(self) -> bool:
        return self.payload_arm is not None and "gravity" in self.terms

    def added_mass(self, parameter: str, ratio: float) -> float | None:
        """Return the payload [kg] that a ratio of the inertia or of the moved mass stands for.

        None: it is no mass, or the loop file does not know where the payload is.
        """
        if self.payload_arm is None or parameter != ("moved_mass" if self._lifts else "inertia"):
            return None
        own = self._nominal()["inertia"] / self.payload_arm**2 if self.payload_mass is None else self.payload_mass
        return (ratio - 1.0) * own

    def exponents(self, parameter: str, healthy: Mapping[str, float] | None = None) -> Mapping[str, float]:
        """Return the powers by coefficient; friction that differs by direction changes in both."""
        if parameter == "viscous_friction" and "viscous_by_direction" in self.terms:
            return dict.fromkeys(BY_DIRECTION, 1.0)
        if parameter == "moved_mass":
            # the motor's own inertia does not grow with the payload
            share = self._unit_inertia(healthy) / healthy["inertia"] if healthy else 1.0
            return {"inertia": share, "gravity": 1.0, "load_friction": 1.0}
        return super().exponents(parameter)

    def scaled_coefficients(self, factors: Mapping[str, Any]) -> dict[str, Any]:
        """Return the coefficients multiplied; ``input_gain`` multiplies all of them."""
        mass = factors.get("moved_mass")
        moved = super().scaled_coefficients({name: factor for name, factor in factors.items() if name != "moved_mass"})
        if mass is not None:
            inertia = (mass - 1.0) * self._unit_inertia(self._nominal()) * factors.get("input_gain", 1.0)
            self._load(moved, inertia)
        return moved

    def _unit_inertia(self, coefficients: Mapping[str, float]) -> float:
        """Return the inertia that a ratio of 1 more stands for: the axis's own, or that of the mass that it carries."""
        if self.payload_mass is None or self.payload_arm is None:
            return coefficients["inertia"]
        return abs(coefficients["gravity"]) * self.payload_arm / GRAVITY_ACCELERATION

    def _load(self, coefficients: dict[str, Any], inertia: Any) -> None:
        """Add the inertia m l^2 of a payload, its weight m g l on the side of the arm's own, and its share of friction.

        It is added to the nominal inertia, so that the mass does not hang on how well a recording shows the inertia.
        """
        assert self.payload_arm is not None
        own = coefficients["gravity"]
        weight = np.sign(np.real(own)) * inertia * GRAVITY_ACCELERATION / self.payload_arm
        coefficients["inertia"] += inertia
        coefficients["gravity"] += weight
        if "load_friction" in coefficients:
            coefficients["load_friction"] *= 1.0 + weight / own

    def acceleration_coefficients(self, coefficients: Mapping[str, Any] | None = None) -> Any:
        """Return b and all a_i of ``y'' = b u - sum a_i column_i``, in the order of `acting`; they may be complex.

        `coefficients`: in the place of the nominal ones.
        """
        own = self._nominal() if coefficients is None else coefficients
        acting = [own[name] for name in self.names if name != "inertia"]
        return np.array([self.input_gain, *acting]) / own["inertia"]
