"""Arrays and records as traced arithmetic reads and stores them in LLVM's assembly, at once."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from servoscope.core.jit.llvm_text import LlvmPrinter
from servoscope.core.jit.symbolic import Complex, Float, Int

WIDENING_WORDS = {"i8": "zext", "i32": "sext", "i64": ""}  # whole numbers and flags, and how they become 64 bits wide


@dataclass(frozen=True, eq=False, slots=True)
class Array:
    """An array in C order: all indices name a number, fewer a part of it. Each is read and stored where it is named."""

    printer: LlvmPrinter
    base: str
    kind: str  # of LLVM, or "complex"
    shape: tuple[Any, ...]

    @classmethod
    def scratch(cls, printer: LlvmPrinter, kind: str, *shape: int) -> Array:
        """Return an array of one call, not filled."""
        numbers = math.prod(shape) * (2 if kind == "complex" else 1)
        return cls(printer, printer.stack("double" if kind == "complex" else kind, numbers), kind, shape)

    def __getitem__(self, index: Any) -> Any:
        place, left = self._locate(index)
        if left:
            return Array(self.printer, place, self.kind, left)
        if self.kind == "complex":
            both = (place, self.printer.place("double", place, 1))
            return Complex(*(Float(self.printer, self.printer.load("double", part), "double") for part in both))
        text = self.printer.load(self.kind, place)
        if self.kind not in WIDENING_WORDS:
            return Float(self.printer, text, self.kind)
        word = WIDENING_WORDS[self.kind]
        return Int(self.printer, self.printer.assign(f"{word} {self.kind} {text} to i64") if word else text)

    def __setitem__(self, index: Any, number: Any) -> None:
        place, _ = self._locate(index)
        if self.kind in WIDENING_WORDS:
            narrow = WIDENING_WORDS[self.kind] and not isinstance(number, int)
            text = self.printer.assign(f"trunc i64 {number} to {self.kind}") if narrow else str(number)
            self.printer.store(self.kind, text, place)
            return
        parts = [(place, number)]
        if self.kind == "complex":
            number = Complex.of(number)
            parts = [(place, number.real), (self.printer.place("double", place, 1), number.imag)]
        kind = "double" if self.kind == "complex" else self.kind
        for part, value in parts:
            self.printer.store(kind, Float(self.printer, "", kind).to_operand(value), part)

    def _locate(self, index: Any) -> tuple[str, tuple[Any, ...]]:
        """Return the place of an element, or of a part, and what is left of the shape."""
        indices = index if isinstance(index, tuple) else (index,)
        number: Any = 0
        for i, size in zip(indices, self.shape, strict=False):
            number = number * size + i
        left = self.shape[len(indices) :]
        number = number * (math.prod(left) * (2 if self.kind == "complex" else 1))
        return self.printer.place("double" if self.kind == "complex" else self.kind, self.base, number), left


class Record:
    """A record of numbers in double precision and arrays of them, whose names are those of a NumPy type."""

    def __init__(self, printer: LlvmPrinter, base: str, dtype: np.dtype[Any]) -> None:
        self.__dict__.update(_printer=printer, _base=base, _fields=dtype.fields)

    def __getattr__(self, name: str) -> Any:
        array = self._array(name)
        return array if array.shape else array[()]

    def __setattr__(self, name: str, number: Any) -> None:
        self._array(name)[()] = number

    def _array(self, name: str) -> Array:
        kind, offset, *_ = self._fields[name]
        return Array(self._printer, self._printer.place("double", self._base, offset // 8), "double", kind.shape)


@dataclass(frozen=True, eq=False, slots=True)
class Records:
    """Records (N,) side by side."""

    printer: LlvmPrinter
    base: str
    dtype: np.dtype[Any]
    shape: tuple[Any, ...]

    def __getitem__(self, index: Int | int) -> Record:
        place = self.printer.place("double", self.base, index * (self.dtype.itemsize // 8))
        return Record(self.printer, place, self.dtype)


class Variable:
    """A number that changes."""

    def __init__(self, printer: LlvmPrinter, number: Any) -> None:
        kind = "complex" if isinstance(number, Complex) else "i64" if isinstance(number, Int | int) else "double"
        self._array = Array.scratch(printer, kind)
        self.value = number

    @property
    def value(self) -> Any:
        """The number as it is now."""
        return self._array[()]

    @value.setter
    def value(self, number: Any) -> None:
        self._array[()] = number


def add_terms(printer: LlvmPrinter, start: Any, count: Int | int, term: Callable[[Int], Any]) -> Any:
    """Return a number plus terms, which are added by a loop, one after the other."""
    total = Variable(printer, start)
    for i in printer.loop(0, count):
        total.value = total.value + term(i)
    return total.value
