"""What every plant offers: an inverse with coefficients theta, named faults and, where known, physics."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Self

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from servoscope.errors import LoopError

FloatArray = npt.NDArray[np.float64]
StateSpace = tuple[FloatArray, FloatArray, FloatArray]

EXTRAS = ("sign_v", "forward_v", "backward_v", "one")
"""Columns beyond the powers of s: sign(y'), max(y', 0), min(y', 0) and the constant one."""


def _not_zero(value: float) -> float:
    if value == 0.0:
        raise ValueError("must not be 0")
    return value


@dataclass(frozen=True)
class Fault:
    """One way in which a plant fails: a physical parameter that leaves its nominal value.

    Parameters
    ----------
    name
        Short word of the vocabulary, for example ``leakage``.
    parameter
        The parameter that moves, for example ``C_ie``.
    ratio_range
        Smallest and largest ratio to the nominal value that is searched.
    words
        What the fault means to the person who reads the report.
    """

    name: str
    parameter: str
    ratio_range: tuple[float, float]
    words: str


class Plant(BaseModel, abc.ABC):
    """Settings and physics of a plant without finite zeros.

    Its inverse is ``input_gain u = sum theta_i s^powers_i y + sum theta_j extra_j(y')``; `theta` lists the
    coefficients of the powers first, those of the extras after them. SI units throughout.

    Parameters
    ----------
    kind
        Name of the plant in a loop file.
    input_gain
        Factor on u as recorded, before anything else is done with it, for example a torque constant.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: str
    input_gain: Annotated[float, AfterValidator(_not_zero), Field(allow_inf_nan=False)] = 1.0

    @property
    @abc.abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names of the n coefficients, in column order."""

    @property
    @abc.abstractmethod
    def powers(self) -> tuple[int, ...]:
        """Powers of s of the linear columns; the first ``len(powers)`` coefficients belong to them."""

    @property
    def extras(self) -> tuple[str, ...]:
        """Columns after the powers, out of `EXTRAS`."""
        return ()

    @property
    def units(self) -> tuple[str, str]:
        """Units of y and u; empty where they depend on the machine."""
        return "", ""

    @property
    def coefficient_units(self) -> tuple[str, ...]:
        """Units of the n coefficients, in u and y themselves where theirs are not known."""
        of_y, of_u = self.units[0] or "y", self.units[1] or ("u" if self.input_gain == 1.0 else "input_gain u")
        extra = [f"{of_u} s/{of_y}" if name in ("forward_v", "backward_v") else of_u for name in self.extras]
        return (*(f"{of_u}{('', ' s', ' s²', ' s³', ' s⁴')[power]}/{of_y}" for power in self.powers), *extra)

    @property
    def linear(self) -> bool:
        """Whether it is linear but for `extras`, which are simulated and regressed as what they are."""
        return True

    @property
    @abc.abstractmethod
    def has_physics(self) -> bool:
        """Whether nominal values are known, so that `theta`, `state_space` and simulation work."""

    @abc.abstractmethod
    def theta(self) -> FloatArray:
        """Nominal coefficients, shape (n,), in the order of `names`.

        Raises
        ------
        LoopError
            If no nominal values are known (`has_physics` is false).
        """

    @property
    @abc.abstractmethod
    def faults(self) -> tuple[Fault, ...]:
        """The faults that the plant knows, in the order in which they are reported."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters that `with_ratios` takes."""
        return tuple(fault.parameter for fault in self.faults)

    @property
    def causes(self) -> Mapping[str, str]:
        """Further names that `scaled` takes, changes that are no fault of the list, each with what it would mean."""
        return {}

    def with_ratios(self, ratios: Mapping[str, float]) -> Self:
        """Return the same plant with some parameters multiplied, ``{"C_ie": 1.2}``.

        Raises
        ------
        LoopError
            If a parameter is not one of `parameters`, a ratio is not positive, or no nominal value is known.
        """
        self._check_ratios(ratios)
        return self.scaled({name: float(ratio) for name, ratio in ratios.items()})

    @abc.abstractmethod
    def scaled(self, factors: Mapping[str, Any]) -> Self:
        """Return the same plant with `parameters` and `causes` multiplied by factors that nobody checks.

        They may be complex, as complex-step derivatives of `state_space` need them (Squire and Trapp, 1998).

        Raises
        ------
        LoopError
            If no nominal value is known.
        """

    @abc.abstractmethod
    def state_space(self) -> StateSpace:
        """Continuous linear part from u as recorded to y: A (n, n), B (n, 1), C (1, n), in physical states.

        The states keep their meaning when a parameter changes, so a switch of plants carries them over.

        Raises
        ------
        LoopError
            If no nominal values are known.
        """

    def _check_ratios(self, ratios: Mapping[str, float]) -> None:
        for name, ratio in ratios.items():
            if name not in self.parameters:
                raise LoopError(f"{name}: not a parameter of plant {self.kind}, which has {', '.join(self.parameters)}")
            if not (np.isfinite(ratio) and ratio > 0.0):
                raise LoopError(f"{name}={ratio:g}: the ratio to the nominal value must be positive and finite")
