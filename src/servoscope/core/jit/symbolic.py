"""Arithmetic on symbols that write text, so that mathematics is written once, in plain Python, for every language.

A function that is called with symbols writes down every operation, loops and all, as straight-line text of a *printer*:
LLVM's assembly (`core.jit.llvm_text`), C (`core.jit.c_source`) or Structured Text (`core.jit.st_source`). Such text has
no branches: both values are computed, and `where` selects one.

The fused multiply-add is explicit, not left to the compiler's choice. So one sample, a log and a fleet round alike, to
the last bit, however the code around them was vectorised, and so does C on any processor.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, eq=False, slots=True)
class Bool:
    """A condition: its printer, its text, and its type there."""

    printer: Any
    text: str
    kind: str

    def __and__(self, other: Bool) -> Bool:
        return Bool(self.printer, self.printer.operate("and", self.kind, self.text, other.text), self.kind)

    def __or__(self, other: Bool) -> Bool:
        return Bool(self.printer, self.printer.operate("or", self.kind, self.text, other.text), self.kind)

    def __invert__(self) -> Bool:
        return Bool(self.printer, self.printer.opposite(self.kind, self.text), self.kind)


def _binary(name: str, *, reflected: bool = False) -> Callable[[Float, Any], Float]:
    def operate(self: Float, other: Any) -> Float:
        if isinstance(other, Complex):
            return NotImplemented  # type: ignore[no-any-return]
        a, b = self.text, self.to_operand(other)
        return Float(self.printer, self.printer.operate(name, self.kind, *((b, a) if reflected else (a, b))), self.kind)

    return operate


def _comparison(sign: str) -> Callable[[Float, Any], Bool]:
    def compare(self: Float, other: Any) -> Bool:
        kind = self.kind.replace("double", "i1").replace("float", "i1")
        return Bool(self.printer, self.printer.compare(sign, self.kind, self.text, self.to_operand(other)), kind)

    return compare


@dataclass(frozen=True, eq=False, slots=True)
class Float:
    """A number that the text computes, or one number per lane: its printer, its text, and its type there."""

    printer: Any
    text: str
    kind: str

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

    is_equal = _comparison("==")

    def __neg__(self) -> Float:
        return Float(self.printer, self.printer.negate(self.kind, self.text), self.kind)

    def __abs__(self) -> Float:
        return self.call("fabs")

    def to_operand(self, other: Any) -> str:
        """Return another number, or a constant, as text of the same type."""
        if not isinstance(other, Float):
            return str(self.printer.constant(float(other), self.kind))
        if other.kind == self.kind:
            return other.text
        return str(self.printer.convert(other.kind, other.text, self.kind))

    def cast(self, other: Any) -> Float:
        """Return another number, or a constant, as a number of the same type."""
        return Float(self.printer, self.to_operand(other), self.kind)

    def widen(self) -> Float:
        """Return the number in double precision."""
        kind = self.kind.replace("float", "double")
        return Float(self.printer, "", kind).cast(self)

    def call(self, name: str, *numbers: Any) -> Float:
        """Return the result of a function, of this number where no others are given."""
        arguments = [self.to_operand(x) for x in numbers or (self,)]
        return Float(self.printer, self.printer.call(name, self.kind, arguments), self.kind)


@dataclass(frozen=True, eq=False, slots=True)
class Complex:
    """A complex number that the text computes."""

    real: Any
    imag: Any

    @classmethod
    def of(cls, number: Any) -> Complex:
        """Return any number as a complex one."""
        return number if isinstance(number, Complex) else cls(number, 0.0)

    def __add__(self, other: Any) -> Complex:
        other = Complex.of(other)
        return Complex(self.real + other.real, self.imag + other.imag)

    def __sub__(self, other: Any) -> Complex:
        return self + -Complex.of(other)

    def __rsub__(self, other: Any) -> Complex:
        return Complex.of(other) + -self

    def __neg__(self) -> Complex:
        return Complex(-self.real, -self.imag)

    def __mul__(self, other: Any) -> Complex:
        if not isinstance(other, Complex):
            return Complex(self.real * other, self.imag * other)
        a, b, c, d = self.real, self.imag, other.real, other.imag
        return Complex(a * c - b * d, a * d + b * c)

    def __truediv__(self, other: Any) -> Complex:
        if not isinstance(other, Complex):
            return Complex(self.real / other, self.imag / other)
        size = other.real * other.real + other.imag * other.imag
        product = self * Complex(other.real, -other.imag)
        return Complex(product.real / size, product.imag / size)

    def __rtruediv__(self, other: Any) -> Complex:
        return Complex.of(other).__truediv__(self)

    __radd__, __rmul__ = __add__, __mul__


def _whole(name: str, *, reflected: bool = False) -> Callable[[Int, Int | int], Int]:
    def operate(self: Int, other: Int | int) -> Int:
        a, b = (other, self) if reflected else (self, other)
        return Int(self.printer, self.printer.operate(name, "i64", str(a), str(b)))

    return operate


def _whole_comparison(sign: str) -> Callable[[Int, Int | int], Bool]:
    return lambda self, other: Bool(self.printer, self.printer.compare_whole(sign, self.text, str(other)), "i1")


@dataclass(frozen=True, eq=False, slots=True)
class Int:
    """A whole number that the text computes, not negative where it is divided."""

    printer: Any
    text: str

    __add__ = _whole("add")
    __radd__ = _whole("add")
    __sub__ = _whole("sub")
    __rsub__ = _whole("sub", reflected=True)
    __mul__ = _whole("mul")
    __rmul__ = _whole("mul")
    __mod__ = _whole("urem")
    __floordiv__ = _whole("udiv")
    __lt__ = _whole_comparison("<")
    __le__ = _whole_comparison("<=")
    __gt__ = _whole_comparison(">")
    __ge__ = _whole_comparison(">=")

    def __str__(self) -> str:
        return self.text

    def is_equal(self, other: Int | int) -> Bool:
        """Return whether it equals another one."""
        return Bool(self.printer, self.printer.compare_whole("==", self.text, str(other)), "i1")


class SymbolRows:
    """The rows of a memory as traced arithmetic reads and stores them: each once, and `flush` stores what changed.

    A memory has a `printer`, a `kind`, and `load` and `store` of a row. Those whose number is itself computed are read
    and stored at once; they must not be among the others.
    """

    def __init__(self, memory: Any) -> None:
        self.memory, self.printer, self.kind = memory, memory.printer, memory.kind
        self.values: dict[int, Float] = {}
        self.written: set[int] = set()

    def __getitem__(self, row: int | Int) -> Float:
        if isinstance(row, Int):
            return self._load(row)
        if row not in self.values:
            self.values[row] = self._load(row)
        return self.values[row]

    def __setitem__(self, row: int | Int, number: Any) -> None:
        value = Float(self.printer, "", self.kind).cast(number)
        if isinstance(row, Int):
            self.memory.store(row, value.text)
            return
        self.values[row] = value
        self.written.add(row)

    def flush(self, mask: Bool | None = None) -> None:
        """Store what was written, where a condition holds."""
        for row in sorted(self.written):
            value = self.values[row]
            self.memory.store(row, (value if mask is None else where(mask, value, self._load(row))).text)

    def _load(self, row: int | Int) -> Float:
        return Float(self.printer, self.memory.load(row), self.kind)


def _symbol(*numbers: Any) -> Any:
    return next((x for x in numbers if isinstance(x, Float | Int)), None)


def fma(a: Any, b: Any, c: Any) -> Any:
    """Return a b + c, rounded once; of plain numbers, which only tests compute with, rounded twice."""
    symbol = _symbol(a, b, c)
    return a * b + c if symbol is None else symbol.call("fma", a, b, c)


def maximum(a: Any, b: Any) -> Any:
    """Return the larger of two numbers, neither of which is NaN."""
    symbol = _symbol(a, b)
    if isinstance(symbol, Int):
        return where(symbol > (b if symbol is a else a), symbol, b if symbol is a else a)
    return max(a, b) if symbol is None else symbol.call("maxnum", a, b)


def minimum(a: Any, b: Any) -> Any:
    """Return the smaller of two numbers, neither of which is NaN."""
    symbol = _symbol(a, b)
    if isinstance(symbol, Int):
        return where(symbol < (b if symbol is a else a), symbol, b if symbol is a else a)
    return min(a, b) if symbol is None else symbol.call("minnum", a, b)


def sqrt(x: Any) -> Any:
    """Return the square root."""
    return x.call("sqrt") if isinstance(x, Float) else math.sqrt(x)


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
    printer, symbol = condition.printer, _symbol(a, b)
    if isinstance(symbol, Int):
        return Int(printer, printer.select(condition.kind, condition.text, "i64", str(a), str(b)))
    if symbol is None:
        symbol = Float(printer, "", condition.kind.replace("i1", "double"))
    operands = symbol.to_operand(a), symbol.to_operand(b)
    return Float(printer, printer.select(condition.kind, condition.text, symbol.kind, *operands), symbol.kind)


def dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    """Return the scalar product of two sequences of one length, not zero."""
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = fma(x, y, total)
    return total


def sum_products(a: Sequence[Any], b: Sequence[Any], start: Any = 0.0) -> Any:
    """Return a number plus the products of two sequences, one after the other, each operation rounded."""
    for x, y in zip(a, b, strict=True):
        start = start + x * y
    return start


def tril_index(i: int, j: int) -> int:
    """Return the place of element (i, j) of a symmetric matrix in its lower triangle, row by row."""
    i, j = max(i, j), min(i, j)
    return i * (i + 1) // 2 + j
