"""What every plant offers: an inverse with coefficients theta, named faults and, where known, physics."""

from __future__ import annotations

import abc
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, PrivateAttr

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import LoopError
from servoscope.core.settings import NOT_ZERO
from servoscope.models.plants.columns import COLUMN_UNITS, Column

StateSpace = tuple[FloatArray, FloatArray, FloatArray]

MAX_RAY_SIZE = 1.5  # times the logarithms of the full size of a fault ray, as far as it is searched
SIGN_CUTOFF = 50.0  # Hz


def matrices(rows: Sequence[Sequence[Any]], count: int) -> Any:
    """Return so many matrices, (count, r, c), of entries by row and column: numbers, or arrays (count,)."""
    stack = np.empty((count, len(rows), len(rows[0])), np.result_type(np.float64, *(x for row in rows for x in row)))
    for i, row in enumerate(rows):
        for j, entry in enumerate(row):
            stack[:, i, j] = entry
    return stack


@dataclass(frozen=True)
class Fault:
    """One way in which a plant fails: a physical parameter that leaves its nominal value."""

    name: str  # short word of the vocabulary, for example ``leakage``
    parameter: str  # the parameter that moves, for example ``C_ie``
    ratio_range: tuple[float, float]  # smallest and largest ratio to the nominal value that is searched
    words: str  # what the fault means to the person who reads the report
    checks: str = ""  # what to check on the machine for it


class VelocitySign(NamedTuple):
    """Where the sign of y' comes from, of which the columns of friction are made."""

    of_reference: bool = False  # from r instead of y
    cutoff: float | None = None  # of the differentiator behind it [Hz]; None: `SIGN_CUTOFF`
    dead_speed: float = 0.0  # speed up to which the sign is not trusted and is 0 [output per s]


def read_translations(module: str) -> Mapping[str, Mapping[str, str]]:
    """Return the TOML file beside a module of a plant: by language, words by their English."""
    return tomllib.loads(Path(module).with_suffix(".toml").read_text(encoding="utf-8"))


@dataclass(frozen=True)
class FaultRay:
    """A fault that moves several parameters at once: a ray in their log-ratios, from 1 to its full size and beyond.

    Its size is told as the ratio of the first parameter, so that the others are ``ratio ** exponent``.
    """

    name: str
    full: tuple[tuple[str, float], ...]  # parameters and their ratios at full size, none of them 1
    known: Fault | None = None  # of a ray that the plant has by itself: range, words and checks

    @property
    def exponents(self) -> dict[str, float]:
        """By parameter, the logarithm of its ratio over that of the first one."""
        first = float(np.log(self.full[0][1]))
        return {name: float(np.log(ratio)) / first for name, ratio in self.full}

    @property
    def fault(self) -> Fault:
        """The ray as a fault, whose parameter has the name of the ray."""
        if self.known is not None:
            return self.known
        ends = sorted((1.0, self.full[0][1] ** MAX_RAY_SIZE))
        words = " with ".join(f"{name} x {ratio:g}" for name, ratio in self.full)
        return Fault(self.name, self.name, (ends[0], ends[1]), f"{words} at full size")


def expand_rays(rays: Sequence[FaultRay], factors: Mapping[str, Any]) -> dict[str, Any]:
    """Return factors by parameter, in which those of rays have become those of what they move."""
    expanded = dict(factors)
    for ray in rays:
        if ray.name in expanded:
            size = expanded.pop(ray.name)
            for name, exponent in ray.exponents.items():
                expanded[name] = expanded.get(name, 1.0) * size**exponent
    return expanded


class Plant(BaseModel, abc.ABC):
    """Settings and physics of a plant without finite zeros.

    Its inverse is ``input_gain u = sum theta_i s^powers_i y + sum theta_j extra_j(y')``; `theta` lists the
    coefficients of the powers first, those of the extras after them. SI units throughout.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    # by language, as "de": names, words and checks of its faults and the words of its causes, by their English
    translations: ClassVar[Mapping[str, Mapping[str, str]]] = {}
    # whether its parameters are its coefficients and the input gain, so that a healthy estimate gives their ratios
    parameters_are_coefficients: ClassVar[bool] = False
    # by parameter, the angle by which coefficients leave its curve, in their standard deviations [rad]
    ray_angles: ClassVar[Mapping[str, float]] = {}
    # by parameter, the standard deviation of the logarithm of its ratio as a share of that, where it is known roughly
    size_errors: ClassVar[Mapping[str, float]] = {}
    # whether names come from coefficients fitted to all samples since the onset, by how such fits scatter when healthy
    fits_stretches: ClassVar[bool] = False

    kind: str  # name of the plant in a loop file
    # factor on u as recorded, before anything else is done with it, for example a torque constant
    input_gain: Annotated[float, NOT_ZERO, Field(allow_inf_nan=False)] = 1.0

    # of the loop file, no setting of the plant's own table
    _rays: tuple[FaultRay, ...] = PrivateAttr(default=())

    @property
    @abc.abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names of the n coefficients, in column order."""

    @property
    @abc.abstractmethod
    def powers(self) -> tuple[int, ...]:
        """Powers of s of the linear columns; the first ``len(powers)`` coefficients belong to them."""

    @property
    def channels(self) -> Mapping[str, str]:
        """Columns of a log that it takes besides r, u and y, by the name that they have in a recording."""
        return {}

    @property
    def derivative(self) -> int:
        """The power of s by which y is ahead of a position: 1 where it is a speed."""
        return 0

    @property
    def extras(self) -> tuple[Column, ...]:
        """Columns after the powers."""
        return ()

    @property
    def column_shapes(self) -> Mapping[Column, tuple[float, float]]:
        """By column that is shaped (`COLUMN_FORMS`): factor on y' or on y, and phase."""
        return {}

    @property
    def velocity_sign(self) -> VelocitySign:
        """Where the sign of y' comes from."""
        return VelocitySign()

    def with_sample_rate(self, rate: float) -> Self:
        """Return the same plant with defaults that suit a sample rate [Hz]."""
        return self

    @property
    def load_pressure(self) -> tuple[float, float, float] | None:
        """What y, y' and y'' contribute to p_L/p_s of a valve whose flow is K_q u sqrt(1 - sign(u) p_L/p_s).

        None: the flow is proportional to u.
        """
        return None

    @property
    def retraction_gain(self) -> float:
        """What u < 0 does over what u > 0 does, by which it acts."""
        return 1.0

    def effective_input(self, u: FloatArray) -> FloatArray:
        """Return what u acts like if both directions were alike, same shape."""
        gain = self.retraction_gain
        return u if gain == 1.0 else np.where(u * self.input_gain < 0.0, gain * u, u)

    @property
    def units(self) -> tuple[str, str]:
        """Units of y and u; empty where they depend on the machine."""
        return "", ""

    @property
    def coefficient_units(self) -> tuple[str, ...]:
        """Units of the n coefficients, in u and y themselves where theirs are not known."""
        of_y, of_u = self.units[0] or "y", self.units[1] or ("u" if self.input_gain == 1.0 else "input_gain u")
        extra = [f"{of_u}{COLUMN_UNITS.get(column, '').replace('y', of_y)}" for column in self.extras]
        return (*(f"{of_u}{('', ' s', ' s²', ' s³', ' s⁴')[power]}/{of_y}" for power in self.powers), *extra)

    @property
    def linear(self) -> bool:
        """Whether it is linear but for `extras`, which are simulated and regressed as what they are."""
        return True

    @property
    def affine(self) -> bool:
        """Whether it is linear but for a constant."""
        return self.linear and set(self.extras) <= {Column.CONSTANT}

    @property
    @abc.abstractmethod
    def has_physics(self) -> bool:
        """Whether nominal values are known, so that `theta`, `state_space` and simulation work."""

    @abc.abstractmethod
    def theta(self) -> FloatArray:
        """Nominal coefficients, shape (n,), in the order of `names`.

        Raises LoopError if no nominal values are known (`has_physics` is false).
        """

    @property
    @abc.abstractmethod
    def faults(self) -> tuple[Fault, ...]:
        """The faults that the plant knows, in the order in which they are reported."""

    @property
    def rays(self) -> tuple[FaultRay, ...]:
        """The faults that are directions of several parameters: those that the loop file defines."""
        return self._rays

    def with_rays(self, rays: tuple[FaultRay, ...]) -> Self:
        """Return the same plant with faults that move several parameters."""
        plant = self.model_copy()
        plant._rays = rays
        return plant

    @property
    def all_faults(self) -> tuple[Fault, ...]:
        """Its own faults, then those of the loop file."""
        return (*self.faults, *(ray.fault for ray in self.rays))

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters that move one by one; `with_ratios` takes names of `rays` too."""
        return tuple(fault.parameter for fault in self.faults)

    @property
    def physical_parameters(self) -> tuple[str, ...]:
        """Names of all that may move one by one: `parameters`, then those of `causes`."""
        return (*self.parameters, *(name for name in self.causes if name not in self.parameters))

    @property
    def error_factors(self) -> Mapping[str, float]:
        """How much larger the error of a parameter is than that of one in the loop file, for those that count others'.

        Parameters that move the plant alike cannot be told apart; the errors of all are then counted to one of them.
        """
        return {}

    def exponents(self, parameter: str, healthy: Mapping[str, float] | None = None) -> Mapping[str, float]:
        """Return, by coefficient, the power of a parameter's ratio with which it goes, about `healthy` coefficients.

        So it is where the coefficients are all that is known of a plant.
        """
        return {parameter: 1.0} if parameter in self.names else dict.fromkeys(self.names, 1.0)

    def expand_rays(self, factors: Mapping[str, Any]) -> dict[str, Any]:
        """Return what `expand_rays` does, with its own rays."""
        return expand_rays(self.rays, factors)

    def added_mass(self, parameter: str, ratio: float) -> float | None:
        """Return the mass [kg] that was added where a parameter has a ratio to its nominal value; None: not known."""
        return None

    @property
    def unwatched(self) -> tuple[str, ...]:
        """Kinds of change of which no coefficient tells, by their key among the catalogue's causes."""
        return "backlash", "compliance", "load"

    @property
    def causes(self) -> Mapping[str, str]:
        """Further names that `scaled` takes, changes that are no fault of the list, each with what it would mean."""
        return {}

    def with_ratios(self, ratios: Mapping[str, float]) -> Self:
        """Return the same plant with some parameters multiplied, ``{"C_ie": 1.2}``.

        Raises LoopError if a parameter is not one of `parameters`, a ratio is not positive, or no nominal value
        is known.
        """
        self._check_ratios(ratios)
        return self.scaled(self.expand_rays({name: float(ratio) for name, ratio in ratios.items()}))

    @abc.abstractmethod
    def scaled(self, factors: Mapping[str, Any]) -> Self:
        """Return the same plant with `parameters` and `causes` multiplied by factors that nobody checks.

        They may be complex, as complex-step derivatives of `state_space` need them (Squire and Trapp, 1998).

        Raises LoopError if no nominal value is known.
        """

    def state_space(self) -> StateSpace:
        """Continuous linear part from u as recorded to y: A (n, n), B (n, 1), C (1, n), in physical states.

        The states keep their meaning when a parameter changes, so a switch of plants carries them over. A plant has
        this, or `state_spaces`.

        Raises LoopError if no nominal values are known.
        """
        A, B, C = self.state_spaces({}, 1)
        return A[0], B[0], C[0]

    def state_spaces(self, factors: Mapping[str, Any], count: int) -> StateSpace:
        """Return the `state_space` of so many plants at once: A (count, n, n), B (count, n, 1), C (count, 1, n).

        `factors`: what `scaled` takes, an array (count,) for each.
        """
        plants = (self.scaled({name: factor[i] for name, factor in factors.items()}) for i in range(count))
        A, B, C = (np.stack(matrices) for matrices in zip(*(plant.state_space() for plant in plants), strict=True))
        return A, B, C

    def _check_ratios(self, ratios: Mapping[str, float]) -> None:
        for name, ratio in ratios.items():
            known = (*self.parameters, *(ray.name for ray in self.rays))
            if name not in known:
                raise LoopError(f"{name}: not a parameter of plant {self.kind}, which has {', '.join(known)}")
            if not (np.isfinite(ratio) and ratio > 0.0):
                raise LoopError(f"{name}={ratio:g}: the ratio to the nominal value must be positive and finite")
