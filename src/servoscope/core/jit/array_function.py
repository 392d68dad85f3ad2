"""Functions of arrays and numbers that are traced, compiled for the kinds of their arguments and called from Python."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from servoscope.core.jit.arrays import Array, Records
from servoscope.core.jit.llvm_text import LlvmPrinter
from servoscope.core.jit.native import native_function
from servoscope.core.jit.symbolic import Float, Int

KINDS = {"<f8": "double", "<c16": "complex", "<i8": "i64", "<i4": "i32", "|b1": "i8", "|u1": "i8"}


class ArrayFunction:
    """A function whose first argument is a printer (`core.jit.llvm_text`), for which a call gives no value.

    Arrays arrive as `Array`, in C order, those of structured types as `Records`, numbers as symbols, and named tuples
    with symbols in them. Flags, and what is given by name, are constants of the machine code. It returns a number or
    nothing. An array that it writes to must not overlap with another one.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        functools.update_wrapper(self, function)
        self.trace = function
        self._compiled: dict[Any, Callable[..., Any]] = {}

    def __call__(self, *arguments: Any, **constants: Any) -> Any:
        """Run it; it is compiled when arguments of these kinds are met first."""
        values: list[Any] = []
        copies: list[tuple[Any, Any]] = []
        kinds = tuple([_flatten(argument, values, copies) for argument in arguments])
        key = kinds, tuple(constants.items())
        if key not in self._compiled:
            self._compiled[key] = self._compile(kinds, constants)
        result = self._compiled[key](*values)
        for array, copy in copies:
            if array.flags.writeable:
                array[...] = copy
        return result

    def _compile(self, kinds: tuple[Any, ...], constants: dict[str, Any]) -> Callable[..., Any]:
        names: list[tuple[str, str]] = []
        plans = [_plan(kind, names) for kind in kinds]
        printer = LlvmPrinter(names)
        value = self.trace(printer, *(make(printer) for make in plans), **constants)
        if value is not None:
            printer.result = value.kind if isinstance(value, Float) else "i64"
        printer.write(f"ret {printer.result} {'' if value is None else getattr(value, 'text', value)}")
        return native_function(printer.text(), names, printer.result)


def _flatten(argument: Any, values: list[Any], copies: list[tuple[Any, Any]]) -> Any:
    """Return the kind of an argument; append the numbers and addresses that stand for it, and copies of arrays."""
    if isinstance(argument, np.ndarray):
        form = argument.__array_interface__
        if form["strides"] is not None:
            copies.append((argument, np.ascontiguousarray(argument)))
            form = copies[-1][1].__array_interface__
        values += (form["data"][0], *form["shape"])
        return KINDS.get(form["typestr"]) or argument.dtype, argument.ndim
    if isinstance(argument, tuple):
        return type(argument), tuple([_flatten(part, values, copies) for part in argument])
    if isinstance(argument, bool | np.bool_):
        return bool(argument)
    values.append(argument)
    return "i64" if isinstance(argument, int | np.integer) else "double"


def _plan(kind: Any, names: list[tuple[str, str]]) -> Callable[[LlvmPrinter], Any]:
    """Return the function that makes the symbols of an argument of a kind; append what they are called."""

    def name(of: str) -> str:
        names.append((f"a{len(names)}", of))
        return f"%a{len(names) - 1}"

    if isinstance(kind, bool):
        return lambda printer: kind
    if isinstance(kind, str):
        place = name(kind)
        return lambda printer: Int(printer, place) if kind == "i64" else Float(printer, place, "double")
    if isinstance(kind[0], type):
        parts = [_plan(part, names) for part in kind[1]]
        make = getattr(kind[0], "_make", tuple)
        return lambda printer: make([part(printer) for part in parts])
    form, base, sizes = kind[0], name("ptr"), [name("i64") for _ in range(kind[1])]
    of_arrays = Array if isinstance(form, str) else Records
    return lambda printer: of_arrays(printer, base, form, tuple(Int(printer, size) for size in sizes))
