"""Arithmetic on numbers or on symbols that write machine code, so that mathematics is written once, in plain Python.

A function written with these computes when it is given floats and lists. Given symbols, it records every operation,
loops and all, as straight-line code, which `core.jit.trace_function` makes a part of a kernel. Such code has no
branches: both values are computed, and `where` selects one.

The fused multiply-add is explicit, not left to the compiler's choice. So one sample, a log and a fleet round alike, to
the last bit, however the code around them was vectorised, and so does plain Python.
"""

from __future__ import annotations

import ctypes
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

FASTMATH_FLAGS = ("nnan", "nsz")  # no NaN comes this far; without these flags no maximum could be vectorised


@dataclass(frozen=True, eq=False)
class Bool:
    """A condition: builder of the code, and its value."""

    builder: Any
    value: Any

    def __and__(self, other: Bool) -> Bool:
        return Bool(self.builder, self.builder.and_(self.value, other.value))

    def __or__(self, other: Bool) -> Bool:
        return Bool(self.builder, self.builder.or_(self.value, other.value))

    @property
    def all_lanes(self) -> Any:
        """Whether it holds in all lanes, as one value."""
        from llvmlite import ir

        kind = self.value.type
        if not hasattr(kind, "count"):
            return self.value
        name, module = f"llvm.vector.reduce.and.v{kind.count}i1", self.builder.module
        signature = ir.FunctionType(ir.IntType(1), [kind])
        return self.builder.call(module.globals.get(name) or ir.Function(module, signature, name), [self.value])


def _binary(name: str, *, reflected: bool = False) -> Callable[[Float, Any], Float]:
    def operate(self: Float, other: Any) -> Float:
        operands = self.value, self.to_operand(other)
        return Float(self.builder, getattr(self.builder, name)(*(reversed(operands) if reflected else operands)))

    return operate


def _comparison(sign: str) -> Callable[[Float, Any], Bool]:
    return lambda self, other: Bool(self.builder, self.builder.fcmp_ordered(sign, self.value, self.to_operand(other)))


@dataclass(frozen=True, eq=False)
class Float:
    """A number that code computes, or one number per lane: builder of the code, and its value."""

    builder: Any
    value: Any

    __add__ = _binary("fadd")
    __radd__ = _binary("fadd")
    __sub__ = _binary("fsub")
    __rsub__ = _binary("fsub", reflected=True)
    __mul__ = _binary("fmul")
    __rmul__ = _binary("fmul")
    __truediv__ = _binary("fdiv")
    __rtruediv__ = _binary("fdiv", reflected=True)
    __lt__ = _comparison("<")
    __le__ = _comparison("<=")
    __gt__ = _comparison(">")
    __ge__ = _comparison(">=")

    def __neg__(self) -> Float:
        return Float(self.builder, self.builder.fneg(self.value))

    def __abs__(self) -> Float:
        return self.call("fabs", self)

    def to_operand(self, other: Any) -> Any:
        """Return another number, or a constant, as a value of the same precision."""
        from llvmlite import ir

        kind = self.value.type
        element = getattr(kind, "element", kind)
        if not isinstance(other, Float):
            one = ir.Constant(element, float(other))
            return one if element is kind else ir.Constant(kind, [one] * kind.count)
        if other.value.type == kind:
            return other.value
        wider = isinstance(element, ir.DoubleType)
        return (self.builder.fpext if wider else self.builder.fptrunc)(other.value, kind)

    def call(self, name: str, *numbers: Any, flags: tuple[str, ...] = ()) -> Float:
        """Return the result of one of LLVM's own functions."""
        from llvmlite import ir

        kind = self.value.type
        width = f"v{kind.count}" if hasattr(kind, "count") else ""
        signature = ir.FunctionType(kind, [kind] * len(numbers))
        full = f"llvm.{name}.{width}{getattr(kind, 'element', kind).intrinsic_name}"
        module = self.builder.module
        function = module.globals.get(full) or ir.Function(module, signature, full)
        return Float(self.builder, self.builder.call(function, [self.to_operand(x) for x in numbers], fastmath=flags))


@dataclass(frozen=True, eq=False)
class Int:
    """The number of a row that code computes."""

    builder: Any
    value: Any

    def _operand(self, other: Int | int) -> Any:
        return other.value if isinstance(other, Int) else self.value.type(other)

    def __add__(self, other: Int | int) -> Int:
        return Int(self.builder, self.builder.add(self.value, self._operand(other)))

    def __mul__(self, other: Int | int) -> Int:
        return Int(self.builder, self.builder.mul(self.value, self._operand(other)))

    __radd__, __rmul__ = __add__, __mul__


def _symbol(*numbers: Any) -> Float | None:
    return next((x for x in numbers if isinstance(x, Float)), None)


def _load_fma(name: str, kind: Any) -> Callable[[float, float, float], float]:
    try:  # of the C library, which every Python is linked with
        function = getattr(ctypes.CDLL("ucrtbase" if sys.platform == "win32" else None), name)
    except (AttributeError, OSError):
        return _exact_fma
    function.argtypes, function.restype = [kind] * 3, kind
    return function  # type: ignore[no-any-return]


def _exact_fma(a: float, b: float, c: float) -> float:
    if not all(map(math.isfinite, (a, b, c))):
        return a * b + c
    return float(Fraction(a) * Fraction(b) + Fraction(c)) or a * b + c  # the latter for the sign of zero


_fma_double, _fma_single = _load_fma("fma", ctypes.c_double), _load_fma("fmaf", ctypes.c_float)


def fma(a: Any, b: Any, c: Any) -> Any:
    """Return a b + c, rounded once."""
    symbol = _symbol(a, b, c)
    if symbol is not None:
        return symbol.call("fma", a, b, c)
    if isinstance(a, np.float32) or (isinstance(b, np.float32) and not isinstance(a, np.float64)):
        return np.float32(_fma_single(float(a), float(b), float(c)))
    return _fma_double(a, b, c)


def maximum(a: Any, b: Any) -> Any:
    """Return the larger of two numbers."""
    symbol = _symbol(a, b)
    return max(a, b) if symbol is None else symbol.call("maxnum", a, b, flags=FASTMATH_FLAGS)


def minimum(a: Any, b: Any) -> Any:
    """Return the smaller of two numbers."""
    symbol = _symbol(a, b)
    return min(a, b) if symbol is None else symbol.call("minnum", a, b, flags=FASTMATH_FLAGS)


def sqrt(x: Any) -> Any:
    """Return the square root."""
    return x.call("sqrt", x) if isinstance(x, Float) else np.sqrt(x)


MAX_SINE_ANGLE = 2000.0  # angle of `sine`; larger ones count as this
HALVINGS = 12
SINE = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in (5, 4, 3, 2, 1, 0))
COSINE = tuple((-1.0) ** k / math.factorial(2 * k) for k in (5, 4, 3, 2, 1, 0))


def sine(x: Any) -> Any:
    """Return sin(x) to 1e-8 for angles up to `MAX_SINE_ANGLE`, by sums and products alone, the same everywhere.

    Taylor's polynomials of x/2^12, then ``sin 2a = 2 sin a cos a``, ``cos 2a = 1 - 2 sin^2 a``: no function of a C
    library is called, no two of which agree to the last bit.
    """
    a = minimum(maximum(x, -MAX_SINE_ANGLE), MAX_SINE_ANGLE) * 0.5**HALVINGS
    square = a * a
    s, c = SINE[0], COSINE[0]
    for of_sine, of_cosine in zip(SINE[1:], COSINE[1:], strict=True):
        s, c = fma(square, s, of_sine), fma(square, c, of_cosine)
    s = a * s
    for _ in range(HALVINGS):
        s, c = (s + s) * c, 1.0 - (s + s) * s
    return s


def where(condition: Any, a: Any, b: Any) -> Any:
    """Return a where the condition holds, and b where not."""
    if not isinstance(condition, Bool):
        return a if condition else b
    from llvmlite import ir

    symbol = _symbol(a, b)
    if symbol is None:
        lanes, double = getattr(condition.value.type, "count", 0), ir.DoubleType()
        kind = ir.VectorType(double, lanes) if lanes else double
        symbol = Float(condition.builder, ir.Constant(kind, ir.Undefined))
    return Float(symbol.builder, symbol.builder.select(condition.value, symbol.to_operand(a), symbol.to_operand(b)))


def dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    """Return the scalar product of two sequences of one length, not zero."""
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = fma(x, y, total)
    return total


def tril_index(i: int, j: int) -> int:
    """Return the place of element (i, j) of a symmetric matrix in its lower triangle, row by row."""
    i, j = max(i, j), min(i, j)
    return i * (i + 1) // 2 + j
