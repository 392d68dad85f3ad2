"""Polynomial inverse with friction and offset; a motor axis is u = M y'' + F_v y' + F_c sign(y') + offset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from servoscope.models.plants.base import Fault, read_translations
from servoscope.models.plants.columns import Column
from servoscope.models.plants.terms import TermColumn, TermPlant

POWER_NAMES = ("stiffness", "viscous_friction", "inertia", "jerk", "snap")
EXTRA_NAMES = {
    Column.SIGN: "coulomb_friction",
    Column.FORWARD: "viscous_friction_forward",
    Column.BACKWARD: "viscous_friction_backward",
    Column.CONSTANT: "offset",
}
FRICTION_COLUMNS = {
    "none": (),
    "coulomb": (Column.SIGN,),
    "directional": (Column.FORWARD, Column.BACKWARD, Column.SIGN),
}
INPUT_GAIN_WORDS = "more u for the same motion (weak motor, magnet or amplifier, or all coefficients up together)"
DIRECTION_CHECKS = "lubricant and seals; a load that acts in one direction only"
CHECKS = {
    "stiffness": "springs, stops and cables that hold the axis",
    "inertia": "what is moved: workpiece, tool, coupling",
    "viscous_friction": "lubricant: amount, kind, temperature; seals that are too tight",
    "viscous_friction_forward": DIRECTION_CHECKS,
    "viscous_friction_backward": DIRECTION_CHECKS,
    "coulomb_friction": "brake: does it open fully; guides and bearings: dirt, preload, alignment",
    "input_gain": "motor, amplifier and supply: temperature, voltage, pressure; scale of u in the log",
    "offset": "weight or force that acts on the axis; zero of amplifier or valve",
}

FrictionKind = Literal["none", "coulomb", "directional"]


class PolynomialPlant(TermPlant):
    """Plant whose inverse is a polynomial in s, plus Coulomb friction, friction per direction and a constant."""

    translations: ClassVar[Mapping[str, Mapping[str, str]]] = read_translations(__file__)
    parameters_are_coefficients: ClassVar[bool] = True

    kind: Literal["polynomial"] = "polynomial"
    order: Annotated[int, Field(ge=1, le=4)]  # highest power of s, 1 to 4; a motor axis has 2
    stiffness: bool = False  # whether the power 0 belongs to it
    # ``coulomb`` adds F_c sign(y'); ``directional`` also lets the viscous friction differ by direction
    friction: FrictionKind = "none"
    offset: bool = False  # whether a constant is added, for example gravity or a biased amplifier

    @property
    def leading(self) -> Mapping[str, str]:
        """The highest power; it may be that of the velocity by direction."""
        if self.order == 1 and self.friction == "directional":
            names = [EXTRA_NAMES[Column.FORWARD], EXTRA_NAMES[Column.BACKWARD]]
        else:
            names = [POWER_NAMES[self.order]]
        return dict.fromkeys(names, ", it is the highest power")

    @property
    def columns(self) -> tuple[TermColumn, ...]:
        """Stiffness, viscous friction, inertia, jerk, snap as far as present, then friction, sign and constant.

        The power 1 is missing where the viscous friction goes by direction.
        """
        first = 0 if self.stiffness else 1
        powers = [p for p in range(first, self.order + 1) if p != 1 or self.friction != "directional"]
        extras = (*FRICTION_COLUMNS[self.friction], *((Column.CONSTANT,) if self.offset else ()))
        named = [TermColumn(POWER_NAMES[power], power, 1) for power in powers]
        return *named, *(TermColumn(EXTRA_NAMES[extra], extra, signed=extra is Column.CONSTANT) for extra in extras)

    @property
    def unwatched(self) -> tuple[str, ...]:
        """Friction, load and compliance only where no coefficient of their own shows them."""
        friction = () if self.friction != "none" else ("coulomb_friction",)
        return (
            "backlash",
            *friction,
            *(() if self.order == 4 else ("compliance",)),
            *(() if self.offset else ("load",)),
        )

    @property
    def faults(self) -> tuple[Fault, ...]:
        """One per coefficient, and the input gain, which scales them all."""
        words = {name: name.replace("_", " ") for name in self.names} | {"input_gain": INPUT_GAIN_WORDS}
        return tuple(self._fault(name, name, text, CHECKS.get(name, "")) for name, text in words.items())
