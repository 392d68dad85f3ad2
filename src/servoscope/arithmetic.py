"""Arithmetic that runs on numbers, or writes machine code: the recursion's mathematics is said once, in plain Python.

A function written with these does what it says when it is given floats and lists. Given symbols, it does the same to
them and so writes down every operation, loops and all, as straight-line code; `servoscope.compiled.traced` makes a part
of a kernel of that. Such code has no branches: both values are there, and `where` takes one.

The fused multiply-add is written out, not left to the compiler's liking. So one sample, a log and a fleet round alike,
to the last bit, however the code around them was vectorised.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

__all__ = ["Index", "Number", "Truth", "dot", "fma", "larger", "lower", "root", "smaller", "where"]

QUIET = ("nnan", "nsz")  # no NaN comes this far; without that no maximum could be vectorised


@dataclass(frozen=True, eq=False)
class Truth:
    """A condition: builder of the code, and its value."""

    builder: Any
    value: Any

    def __and__(self, other: Truth) -> Truth:
        return Truth(self.builder, self.builder.and_(self.value, other.value))

    def __or__(self, other: Truth) -> Truth:
        return Truth(self.builder, self.builder.or_(self.value, other.value))

    @property
    def everywhere(self) -> Any:
        """Whether it holds in all lanes, as one value."""
        from llvmlite import ir

        kind = self.value.type
        if not hasattr(kind, "count"):
            return self.value
        full, module = f"llvm.vector.reduce.and.v{kind.count}i1", self.builder.module
        signature = ir.FunctionType(ir.IntType(1), [kind])
        return self.builder.call(module.globals.get(full) or ir.Function(module, signature, full), [self.value])


@dataclass(frozen=True, eq=False)
class Number:
    """A number that code computes, or one number per lane: builder of the code, and its value."""

    builder: Any
    value: Any

    def like(self, other: Any) -> Any:
        """Return another number, or a constant, as a value of the same precision."""
        from llvmlite import ir

        kind = self.value.type
        element = getattr(kind, "element", kind)
        if not isinstance(other, Number):
            one = ir.Constant(element, float(other))
            return one if element is kind else ir.Constant(kind, [one] * kind.count)
        if other.value.type == kind:
            return other.value
        wider = isinstance(element, ir.DoubleType)
        return (self.builder.fpext if wider else self.builder.fptrunc)(other.value, kind)

    def _made(self, value: Any) -> Number:
        return Number(self.builder, value)

    def __add__(self, other: Any) -> Number:
        return self._made(self.builder.fadd(self.value, self.like(other)))

    __radd__ = __add__

    def __sub__(self, other: Any) -> Number:
        return self._made(self.builder.fsub(self.value, self.like(other)))

    def __rsub__(self, other: Any) -> Number:
        return self._made(self.builder.fsub(self.like(other), self.value))

    def __mul__(self, other: Any) -> Number:
        return self._made(self.builder.fmul(self.value, self.like(other)))

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Number:
        return self._made(self.builder.fdiv(self.value, self.like(other)))

    def __rtruediv__(self, other: Any) -> Number:
        return self._made(self.builder.fdiv(self.like(other), self.value))

    def __neg__(self) -> Number:
        return self._made(self.builder.fneg(self.value))

    def __abs__(self) -> Number:
        return self._made(self.call("fabs", self))

    def _compared(self, sign: str, other: Any) -> Truth:
        return Truth(self.builder, self.builder.fcmp_ordered(sign, self.value, self.like(other)))

    def __lt__(self, other: Any) -> Truth:
        return self._compared("<", other)

    def __le__(self, other: Any) -> Truth:
        return self._compared("<=", other)

    def __gt__(self, other: Any) -> Truth:
        return self._compared(">", other)

    def __ge__(self, other: Any) -> Truth:
        return self._compared(">=", other)

    def call(self, name: str, *numbers: Any, flags: tuple[str, ...] = ()) -> Any:
        """Return what one of LLVM's own functions makes of numbers."""
        from llvmlite import ir

        kind = self.value.type
        width = f"v{kind.count}" if hasattr(kind, "count") else ""
        signature = ir.FunctionType(kind, [kind] * len(numbers))
        full = f"llvm.{name}.{width}{getattr(kind, 'element', kind).intrinsic_name}"
        module = self.builder.module
        function = module.globals.get(full) or ir.Function(module, signature, full)
        return self.builder.call(function, [self.like(x) for x in numbers], fastmath=flags)


@dataclass(frozen=True, eq=False)
class Index:
    """A row that code computes."""

    builder: Any
    value: Any

    def _of(self, other: Index | int) -> Any:
        return other.value if isinstance(other, Index) else self.value.type(other)

    def __add__(self, other: Index | int) -> Index:
        return Index(self.builder, self.builder.add(self.value, self._of(other)))

    __radd__ = __add__

    def __mul__(self, other: Index | int) -> Index:
        return Index(self.builder, self.builder.mul(self.value, self._of(other)))

    __rmul__ = __mul__


def _symbol(*numbers: Any) -> Number | None:
    return next((x for x in numbers if isinstance(x, Number)), None)


def fma(a: Any, b: Any, c: Any) -> Any:
    """Return a b + c, as code rounded once."""
    symbol = _symbol(a, b, c)
    if symbol is None:
        return a * b + c
    return Number(symbol.builder, symbol.call("fma", a, b, c))


def larger(a: Any, b: Any) -> Any:
    """Return the larger of two numbers."""
    symbol = _symbol(a, b)
    return max(a, b) if symbol is None else Number(symbol.builder, symbol.call("maxnum", a, b, flags=QUIET))


def smaller(a: Any, b: Any) -> Any:
    """Return the smaller of two numbers."""
    symbol = _symbol(a, b)
    return min(a, b) if symbol is None else Number(symbol.builder, symbol.call("minnum", a, b, flags=QUIET))


def root(x: Any) -> Any:
    """Return the square root."""
    return Number(x.builder, x.call("sqrt", x)) if isinstance(x, Number) else math.sqrt(x)


def where(condition: Any, a: Any, b: Any) -> Any:
    """Return a where the condition holds, and b where not."""
    if not isinstance(condition, Truth):
        return a if condition else b
    from llvmlite import ir

    symbol = _symbol(a, b)
    if symbol is None:
        lanes, double = getattr(condition.value.type, "count", 0), ir.DoubleType()
        kind = ir.VectorType(double, lanes) if lanes else double
        symbol = Number(condition.builder, ir.Constant(kind, ir.Undefined))
    return Number(symbol.builder, symbol.builder.select(condition.value, symbol.like(a), symbol.like(b)))


def dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    """Return the scalar product of two sequences of one length, not zero."""
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = fma(x, y, total)
    return total


def lower(i: int, j: int) -> int:
    """Return where element (i, j) of a symmetric matrix stands in its lower triangle, row by row."""
    i, j = max(i, j), min(i, j)
    return i * (i + 1) // 2 + j
