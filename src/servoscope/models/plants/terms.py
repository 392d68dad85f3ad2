"""Plants that are lists of terms: ``input_gain u = sum of coefficient x column(y, y', y'', ...)``."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import LoopError
from servoscope.models.plants.base import SIGN_CUTOFF, Fault, Plant, StateSpace, VelocitySign, matrices
from servoscope.models.plants.columns import Column


def _as_tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value  # TOML has lists, and plants are read strictly


def _check_distinct(terms: tuple[str, ...]) -> tuple[str, ...]:
    if len(set(terms)) < len(terms):
        raise ValueError("one stands twice, remove it")
    return terms


TERM_TUPLE, UNIQUE_TERMS = BeforeValidator(_as_tuple), AfterValidator(_check_distinct)


@dataclass(frozen=True)
class TermColumn:
    """One coefficient of a term and what it multiplies."""

    coefficient: str
    column: int | Column  # power of s, or a function of y and y'
    degree: int = 0  # 1 where it grows with y or y' in proportion
    signed: bool = False  # whether the coefficient may be negative


class TermPlant(Plant):
    """Plant whose coefficients each multiply one column; its parameters multiply one or several coefficients."""

    # smallest and largest ratio to the nominal value that is searched, by parameter, and of all others
    RATIO_RANGES: ClassVar[Mapping[str, tuple[float, float]]] = {
        "inertia": (0.2, 5.0),
        "moved_mass": (0.2, 5.0),
        "input_gain": (0.3, 3.0),
    }
    DEFAULT_RANGE: ClassVar[tuple[float, float]] = (0.1, 10.0)

    # the parameters that move several coefficients: by parameter, the power of its ratio with which each goes
    EXPONENTS: ClassVar[Mapping[str, Mapping[str, float]]] = {}

    # speed [output per s] below which sign(y') is not trusted and set to 0
    sign_speed: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 0.0
    # where the sign of the recursion comes from: the measured output, or the reference where y is noisy or slow
    sign_from: Literal["output", "reference"] = "output"
    # cutoff [Hz] of the differentiator behind the sign
    sign_cutoff: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] = SIGN_CUTOFF
    # nominal values by name, all of `names`; `learn` needs none
    coefficients: dict[str, Annotated[float, Field(allow_inf_nan=False)]] | None = None

    @model_validator(mode="after")
    def _coefficients_fit(self) -> Self:
        if self.coefficients is None:
            return self
        if wrong := sorted(set(self.coefficients) ^ set(self.names)):
            raise ValueError(f"coefficients: give each of {', '.join(self.names)}; check {', '.join(wrong)}")
        positive = {column.coefficient for column in self.columns if not column.signed}
        if negative := [name for name, value in self.coefficients.items() if value < 0.0 and name in positive]:
            raise ValueError(f"coefficients: {negative[0]} must not be negative")
        if zero := [name for name in self.leading if not self.coefficients[name]]:
            raise ValueError(f"coefficients: {zero[0]} must not be 0{self.leading[zero[0]]}")
        return self

    @property
    def leading(self) -> Mapping[str, str]:
        """Coefficients that may not be 0, each with what an error adds to that."""
        return {}

    @property
    def has_physics(self) -> bool:
        """Whether nominal coefficients are given."""
        return self.coefficients is not None

    @property
    def velocity_sign(self) -> VelocitySign:
        """As its settings say."""
        return VelocitySign(self.sign_from == "reference", self.sign_cutoff, self.sign_speed)

    def with_sample_rate(self, rate: float) -> Self:
        """Return the same plant; a `sign_cutoff` that nobody set lies below the Nyquist frequency."""
        if "sign_cutoff" in self.model_fields_set or self.sign_cutoff < rate / 2:
            return self
        return self.model_copy(update={"sign_cutoff": rate / 4})

    @property
    @abc.abstractmethod
    def columns(self) -> tuple[TermColumn, ...]:
        """All columns, powers of s first and in order."""

    @property
    def names(self) -> tuple[str, ...]:
        """Coefficients of the powers, then the others."""
        return tuple(column.coefficient for column in self.columns)

    @property
    def powers(self) -> tuple[int, ...]:
        """Powers of s; one less where y is a speed."""
        return tuple(column.column - self.derivative for column in self.columns if isinstance(column.column, int))

    @property
    def extras(self) -> tuple[Column, ...]:
        """Columns of the other terms."""
        return tuple(column.column for column in self.columns if isinstance(column.column, Column))

    def exponents(self, parameter: str, healthy: Mapping[str, float] | None = None) -> Mapping[str, float]:
        """Return, by coefficient, the power of the parameter's ratio with which it goes."""
        if parameter == "input_gain":
            return dict.fromkeys(self.names, 1.0)
        known = self.EXPONENTS.get(parameter, {parameter: 1.0})
        return {name: power for name, power in known.items() if name in self.names}

    def scaled(self, factors: Mapping[str, Any]) -> Self:
        """Return the same plant with what its parameters move."""
        return self.model_copy(update={"coefficients": self.scaled_coefficients(factors)})

    def scaled_coefficients(self, factors: Mapping[str, Any]) -> dict[str, Any]:
        """Return the coefficients with what parameters move; ``input_gain`` multiplies all of them.

        A factor of the input gain above 1 means that the same motion asks for more u.
        """
        moved = {name: value * factors.get("input_gain", 1.0) for name, value in self._nominal().items()}
        for parameter, factor in factors.items():
            if parameter != "input_gain":
                for name, power in self.exponents(parameter).items():
                    moved[name] = moved[name] * (factor if power == 1.0 else factor**power)
        return moved

    def theta(self) -> FloatArray:
        """Nominal coefficients, shape (n,) [u per output per s^power]."""
        nominal = self._nominal()
        return np.array([nominal[name] for name in self.names], dtype=np.float64)

    def _nominal(self) -> dict[str, float]:
        if self.coefficients is None:
            raise LoopError("[plant] coefficients: missing, simulation and nominal values need them")
        return self.coefficients

    def _fault(self, name: str, parameter: str, words: str, checks: str) -> Fault:
        return Fault(name, parameter, self.RATIO_RANGES.get(parameter, self.DEFAULT_RANGE), words, checks)

    def _polynomial(self) -> list[Any]:
        """Return the coefficients of all powers of s from 0 on; friction by direction enters with its mean."""
        nominal = self._nominal()
        polynomial: list[Any] = [0.0] * (1 + max([1 - self.derivative, *self.powers]))
        for column in self.columns:
            if isinstance(column.column, int):
                polynomial[column.column - self.derivative] = nominal[column.coefficient]
            elif column.column in (Column.FORWARD, Column.BACKWARD):
                polynomial[1 - self.derivative] = polynomial[1 - self.derivative] + 0.5 * nominal[column.coefficient]
        return polynomial

    def state_spaces(self, factors: Mapping[str, Any], count: int) -> StateSpace:
        """Return those of so many plants at once, n the order; states y and its derivatives.

        Friction by direction enters with the mean of both directions; all other columns are left out.
        """
        *lower, leading = self.scaled(factors)._polynomial()
        n = len(lower)
        A = [*np.eye(n, k=1)[:-1].tolist(), [-value / leading for value in lower]]
        B = [[0.0]] * (n - 1) + [[self.input_gain / leading]]
        return matrices(A, count), matrices(B, count), matrices(np.eye(1, n).tolist(), count)
