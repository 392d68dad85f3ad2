"""Traced arithmetic as C: the symbols of `core.jit.symbolic` around a builder that writes statements of C99.

The text is in static single assignment: one operation, one constant of type `double`. So no compiler may fuse a product
with a sum (C99 6.5p8 lets it do so within an expression only); where the arithmetic has a fused multiply-add, the text
says ``fma``. Constants are hexadecimal, exact to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from servoscope.core.jit.symbolic import Bool, Float

__all__ = ["CBuilder", "CRows", "c_literal"]

OPERATORS = {"fadd": "+", "fsub": "-", "fmul": "*", "fdiv": "/"}


def c_literal(number: float, single: bool = False) -> str:
    """Return a constant of C, a double or a `single` float, with the bits of a number."""
    suffix = "f" if single else ""
    if single:
        number = float(np.float32(number))
    if math.isnan(number):
        return "NAN" if single else "(double)NAN"
    if math.isinf(number):
        return f"{'' if number > 0.0 else '-'}HUGE_VAL{suffix.upper()}"
    if number == int(number) and abs(number) < 1e6:
        return f"{number:.1f}{suffix}"  # exact, and easier to read
    return float(number).hex() + suffix


@dataclass(frozen=True, eq=False)
class CValue:
    """A constant of the C text: its name, and its type as a compiler would have it."""

    name: str
    type: Any


@dataclass(frozen=True, eq=False)
class _Statement:
    target: str  # empty: it stores
    text: str
    needs: tuple[str, ...]


class CBuilder:
    """Stands in the place of LLVM's builder in symbols, and writes each operation down as a statement.

    Another language is a subclass with its own literals, assignments, selections and calls. With `single`, numbers are
    floats where nothing else is said.

    Attributes
    ----------
    module
        What symbols declare functions in; nothing of it is used.
    """

    AND, OR = "&", "|"
    SELECT = "({0} != 0) ? {1} : {2}"
    # The larger and smaller of two numbers as comparisons: that is one instruction of a processor, which ISO C's fmax,
    # with its rule for NaN, is not.
    CALLS: ClassVar[dict[str, str]] = {
        "fma": "fma({}, {}, {})",
        "fabs": "fabs({})",
        "sqrt": "sqrt({})",
        "maxnum": "({0} > {1}) ? {0} : {1}",
        "minnum": "({0} < {1}) ? {0} : {1}",
    }

    def __init__(self, single: bool = False) -> None:
        from llvmlite import ir

        self.module = ir.Module()
        self.double, self._flag = ir.DoubleType(), ir.IntType(1)
        self.kind = ir.FloatType() if single else self.double
        self._statements: list[_Statement] = []
        self._known: dict[str, str] = {}

    def read(self, place: str, kind: Any = None) -> Float:
        """Return what stands at a place, as a number of the builder's kind or another; it is read now."""
        return Float(self, self._assign(place, (), kind or self.kind, pure=False))

    def condition(self, text: str) -> Bool:
        """Return an expression of C of type int, 0 or 1, as a condition."""
        return Bool(self, CValue(text, self._flag))

    def store(self, place: str, number: Float) -> None:
        """Write a number to a place."""
        name = self._name(number.value)
        self._statements.append(_Statement("", self.assignment(place, name), (name,)))

    def literal(self, number: float, kind: Any) -> str:
        """Return how a number is written."""
        return c_literal(number, kind != self.double)

    def assignment(self, place: str, text: str) -> str:
        """Return the statement that writes a value to a place."""
        return f"{place} = {text};"

    def definition(self, name: str, text: str, kind: Any) -> str:
        """Return the statement that makes a number or a condition."""
        word = "int" if kind is self._flag else "double" if kind == self.double else "float"
        return f"const {word} {name} = {text};"

    def text(self) -> list[str]:
        """Return the statements that lead to a store."""
        needed: set[str] = set()
        lines = []
        for statement in reversed(self._statements):
            if not statement.target or statement.target in needed:
                needed.update(statement.needs)
                lines.append(statement.text)
        return lines[::-1]

    def fadd(self, a: Any, b: Any) -> CValue:
        """Write a + b."""
        return self._operate("fadd", a, b)

    def fsub(self, a: Any, b: Any) -> CValue:
        """Write a - b."""
        return self._operate("fsub", a, b)

    def fmul(self, a: Any, b: Any) -> CValue:
        """Write a b."""
        return self._operate("fmul", a, b)

    def fdiv(self, a: Any, b: Any) -> CValue:
        """Write a / b."""
        return self._operate("fdiv", a, b)

    def fneg(self, a: Any) -> CValue:
        """Write -a."""
        return self._assign(f"-{self._name(a)}", (a,), a.type)

    def fpext(self, a: Any, kind: Any) -> CValue:
        """Write a as a double."""
        return self._assign(f"(double){self._name(a)}", (a,), kind)

    def fptrunc(self, a: Any, kind: Any) -> CValue:
        """Write a, rounded to a float."""
        return self._assign(f"(float){self._name(a)}", (a,), kind)

    def fcmp_ordered(self, sign: str, a: Any, b: Any) -> CValue:
        """Write a comparison, which does not hold where one of the two is NaN."""
        return self._assign(f"{self._name(a)} {sign} {self._name(b)}", (a, b), self._flag)

    def and_(self, a: Any, b: Any) -> CValue:
        """Write that both conditions hold."""
        return self._assign(f"{self._name(a)} {self.AND} {self._name(b)}", (a, b), self._flag)

    def or_(self, a: Any, b: Any) -> CValue:
        """Write that one of the conditions holds."""
        return self._assign(f"{self._name(a)} {self.OR} {self._name(b)}", (a, b), self._flag)

    def select(self, condition: Any, a: Any, b: Any) -> CValue:
        """Write a where the condition holds, b where not."""
        text = self.SELECT.format(self._name(condition), self._name(a), self._name(b))
        return self._assign(text, (condition, a, b), a.type)

    def call(self, function: Any, arguments: Sequence[Any], fastmath: Iterable[str] = ()) -> CValue:
        """Write a call of one of LLVM's own functions as the same in C."""
        name = function.name.split(".")[1]
        text = self.CALLS[name].format(*map(self._name, arguments))
        if arguments[0].type != self.double:
            text = text.replace(f"{name}(", f"{name}f(")
        return self._assign(text, arguments, arguments[0].type)

    def _operate(self, operation: str, a: Any, b: Any) -> CValue:
        return self._assign(f"{self._name(a)} {OPERATORS[operation]} {self._name(b)}", (a, b), a.type)

    def _name(self, value: Any) -> str:
        """Return how a value is written: by its name, or as a constant."""
        if isinstance(value, CValue):
            return f"({value.name})" if value.name.startswith("-") else value.name
        text = self.literal(float(value.constant), value.type)
        return f"({text})" if text.startswith("-") else text

    def _assign(self, text: str, needs: Sequence[Any], kind: Any, pure: bool = True) -> CValue:
        if pure and text in self._known:
            return CValue(self._known[text], kind)
        flag = kind is self._flag
        target = f"{'b' if flag else 't'}{len(self._statements)}"
        needed = tuple(self._name(x) for x in needs)
        self._statements.append(_Statement(target, self.definition(target, text, kind), needed))
        if pure:
            self._known[text] = target
        return CValue(target, kind)


class CRows:
    """An array as traced arithmetic reads and stores it: each row is read once, and `flush` writes what changed.

    Its numbers are of the builder's kind, or doubles if it is `wide`.
    """

    def __init__(self, builder: CBuilder, name: str, places: dict[int, str] | None = None, wide: bool = False) -> None:
        self.builder, self._name, self._places = builder, name, places
        self._kind = builder.double if wide else builder.kind
        self._values: dict[int, Float] = {}
        self._written: set[int] = set()

    def __getitem__(self, row: int) -> Float:
        if row not in self._values:
            self._values[row] = self.builder.read(self._place(row), self._kind)
        return self._values[row]

    def __setitem__(self, row: int, number: Any) -> None:
        self._values[row] = Float(self.builder, Float(self.builder, CValue("", self._kind)).to_operand(number))
        self._written.add(row)

    def flush(self) -> None:
        """Write the rows that were stored."""
        for row in sorted(self._written):
            self.builder.store(self._place(row), self._values[row])

    def _place(self, row: int) -> str:
        return f"{self._name}[{row}]" if self._places is None else self._places[row]
