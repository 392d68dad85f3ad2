"""Traced arithmetic as C: a printer that writes statements of C99.

The text is in static single assignment: one operation, one constant of type `double`. So no compiler may fuse a product
with a sum (C99 6.5p8 lets it do so within an expression only); where the arithmetic has a fused multiply-add, the text
says ``fma``. Constants are hexadecimal, exact to the last bit.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from servoscope.core.jit.symbolic import Bool, Float, Int, SymbolRows

__all__ = ["CPrinter", "CRows", "c_literal"]

NAME = re.compile(r"\b[tbkx]\d+\b")


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


class _Statement(NamedTuple):
    target: str  # empty: it stores, or begins or ends a block
    text: str


class CPrinter:
    """Writes each operation down as a statement; with `single`, numbers are floats where nothing else is said.

    Another language is a subclass with its own literals, operators, calls and `FORMS` of statements. `variables` are
    those that it needs beside the constants: their names and kinds.
    """

    OPERATORS: ClassVar[dict[str, str]] = {
        **{"fadd": "+", "fsub": "-", "fmul": "*", "fdiv": "/", "and": "&", "or": "|"},
        **{"add": "+", "sub": "-", "mul": "*", "urem": "%", "==": "=="},
    }
    # The larger and smaller of two numbers as comparisons: that is one instruction of a processor, which ISO C's fmax,
    # with its rule for NaN, is not.
    CALLS: ClassVar[dict[str, str]] = {
        "fma": "fma({}, {}, {})",
        "fabs": "fabs({})",
        "sqrt": "sqrt({})",
        "maxnum": "({0} > {1}) ? {0} : {1}",
        "minnum": "({0} < {1}) ? {0} : {1}",
    }
    WORDS: ClassVar[dict[str, str]] = {"i1": "int", "i64": "int", "double": "double", "float": "float"}
    FORMS: ClassVar[dict[str, str]] = {
        **{"declare": "{1} {0} = 0;", "define": "const {2} {0} = {1};", "store": "{0} = {1};"},
        **{"select": "({0} != 0) ? {1} : {2}", "number": "(double){0}", "truncate": "(int){0}"},
        **{"loop": "for ({0} = {1}; {0} < {2}; {0}++) {{", "end loop": "}"},
        **{"branch": "if ({0} != 0) {{", "end branch": "}"},
    }

    def __init__(self, single: bool = False) -> None:
        self.kind = "float" if single else "double"
        self.variables: dict[str, str] = {}
        self._statements: list[_Statement] = []
        self._known: dict[str, str] = {}

    def read(self, place: str, kind: str = "") -> Float:
        """Return what stands at a place, as a number of the printer's kind or another; it is read now."""
        return Float(self, self.load(kind or self.kind, place), kind or self.kind)

    def condition(self, text: str) -> Bool:
        """Return an expression of C of type int, 0 or 1, as a condition."""
        return Bool(self, text, "i1")

    def lines(self) -> list[str]:
        """Return the statements that lead to a store."""
        needed: set[str] = set()
        lines = []
        for statement in reversed(self._statements):
            if not statement.target or statement.target in needed:
                needed.update(NAME.findall(statement.text))
                lines.append(statement.text)
        return lines[::-1]

    def declarations(self) -> list[str]:
        """Return the declarations of the variables."""
        form = self.FORMS["declare"]
        return [form.format(name, self.WORDS[kind]) for name, kind in self.variables.items() if form]

    # operations

    def literal(self, number: float, kind: str) -> str:
        """Return how a number is written."""
        return c_literal(number, kind == "float")

    def constant(self, number: float, kind: str) -> str:
        """Return a constant."""
        text = self.literal(number, kind)
        return f"({text})" if text.startswith("-") else text

    def operate(self, name: str, kind: str, a: str, b: str) -> str:
        """Write an operation on two numbers; those on whole numbers stand within an expression."""
        text = f"{a} {self.OPERATORS[name]} {b}"
        return f"({text})" if kind == "i64" else self._assign(text, kind)

    def negate(self, kind: str, a: str) -> str:
        """Write -a."""
        return self._assign(f"-{a}", kind)

    def convert(self, kind: str, a: str, target: str) -> str:
        """Write a number in another precision."""
        return self._assign(f"({target}){a}", target)

    def compare(self, sign: str, kind: str, a: str, b: str) -> str:
        """Write a comparison, which does not hold where one of the two is NaN."""
        return self._assign(f"{a} {sign} {b}", "i1")

    def compare_whole(self, sign: str, a: str, b: str) -> str:
        """Write a comparison of whole numbers."""
        return self._assign(f"{a} {self.OPERATORS.get(sign, sign)} {b}", "i1")

    def select(self, condition_kind: str, condition: str, kind: str, a: str, b: str) -> str:
        """Write a where the condition holds, b where not."""
        return self._assign(self.FORMS["select"].format(condition, a, b), kind)

    def call(self, name: str, kind: str, arguments: Sequence[str]) -> str:
        """Write a call of a function."""
        text = self.CALLS[name].format(*arguments)
        return self._assign(text.replace(f"{name}(", f"{name}f(") if kind == "float" else text, kind)

    def truncate(self, number: Float) -> Int:
        """Return a number without what follows its point."""
        return Int(self, self._assign(self.FORMS["truncate"].format(number.text), "i64"))

    def number(self, whole: Int) -> Float:
        """Return a whole number as a number."""
        return Float(self, self._assign(self.FORMS["number"].format(whole), "double"), "double")

    # places, loops and branches

    def load(self, kind: str, place: str) -> str:
        """Read a place, now."""
        return self._assign(place, kind, pure=False)

    def store(self, kind: str, text: str, place: str) -> None:
        """Write a number to a place."""
        self._statements.append(_Statement("", self.FORMS["store"].format(place, text)))

    def variable(self, kind: str) -> str:
        """Return the place of a number that changes."""
        name = f"x{len(self.variables)}"
        self.variables[name] = kind
        return name

    def loop(self, begin: Int | int, end: Int | int, step: int = 1) -> Iterator[Int]:
        """Write a loop over whole numbers."""
        name = self.variable("i64")
        with self._block("loop", name, begin, end):
            yield Int(self, name)

    def when(self, condition: Bool) -> contextlib.AbstractContextManager[None]:
        """Write what happens only where a condition holds."""
        return self._block("branch", condition.text)

    @contextlib.contextmanager
    def _block(self, kind: str, *names: Any) -> Iterator[None]:
        known = dict(self._known)
        self._statements.append(_Statement("", self.FORMS[kind].format(*names)))
        yield
        self._statements.append(_Statement("", self.FORMS[f"end {kind}"]))
        self._known = known  # what was computed inside is not known outside

    def _assign(self, text: str, kind: str, pure: bool = True) -> str:
        if pure and text in self._known:
            return self._known[text]
        target = f"{'b' if kind == 'i1' else 'k' if kind == 'i64' else 't'}{len(self._statements)}"
        self._statements.append(_Statement(target, self.FORMS["define"].format(target, text, self.WORDS[kind])))
        if pure:
            self._known[text] = target
        return target


class CRows(SymbolRows):
    """An array as traced arithmetic reads and stores it; its numbers are of the printer's kind, or `wide` doubles."""

    def __init__(self, printer: CPrinter, name: str, places: dict[int, str] | None = None, wide: bool = False) -> None:
        self.printer, self.kind = printer, "double" if wide else printer.kind
        self._name, self._places = name, places
        super().__init__(self)

    def load(self, row: int | Int) -> str:
        """Read a row."""
        return str(self.printer.load(self.kind, self._place(row)))

    def store(self, row: int | Int, text: str) -> None:
        """Write a row."""
        self.printer.store(self.kind, text, self._place(row))

    def _place(self, row: int | Int) -> str:
        return self._places[row] if self._places is not None and isinstance(row, int) else f"{self._name}[{row}]"
