"""Traced arithmetic as Structured Text of IEC 61131-3: `core.jit.c_source` with another grammar.

That language has no fused multiply-add: it becomes a product and a sum, each rounded. It has neither NaN nor infinity;
they become numbers that no physical signal reaches.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from typing import ClassVar

from servoscope.core.jit.c_source import CPrinter

__all__ = ["STPrinter", "st_literal"]

UNKNOWN = -1.0  # in the place of NaN


def st_literal(number: float) -> str:
    """Return a constant of type LREAL; 17 digits tell one double from every other."""
    if math.isnan(number):
        return repr(UNKNOWN)
    if math.isinf(number):
        return st_literal(math.copysign(sys.float_info.max, number))
    mantissa, _, exponent = repr(float(number)).partition("e")
    if not exponent:
        return mantissa
    return f"{mantissa if '.' in mantissa else mantissa + '.0'}E{int(exponent)}"


class STPrinter(CPrinter):
    """Writes operations down as statements of Structured Text."""

    OPERATORS: ClassVar[dict[str, str]] = CPrinter.OPERATORS | {"and": "AND", "or": "OR", "urem": "MOD", "==": "="}
    CALLS: ClassVar[dict[str, str]] = {
        "fabs": "ABS({})",
        "sqrt": "SQRT({})",
        "maxnum": "SEL({0} > {1}, {1}, {0})",
        "minnum": "SEL({0} < {1}, {1}, {0})",
    }
    FORMS: ClassVar[dict[str, str]] = {
        # a function block declares the variables of all its statements together
        **{"declare": "", "define": "{0} := {1};", "store": "{0} := {1};"},
        **{"select": "SEL({0}, {2}, {1})", "number": "DINT_TO_LREAL({0})", "truncate": "TRUNC({0})"},
        **{"loop": "FOR {0} := {1} TO {2} - 1 DO", "end loop": "END_FOR;"},
        **{"branch": "IF {0} THEN", "end branch": "END_IF;"},
    }

    def literal(self, number: float, kind: str) -> str:
        """Return how a number is written."""
        return st_literal(number)

    def convert(self, kind: str, a: str, target: str) -> str:
        """Return a number as it is: there is one precision."""
        return a

    def call(self, name: str, kind: str, arguments: Sequence[str]) -> str:
        """Write a call of a function; a fused multiply-add as two operations."""
        if name == "fma":
            a, b, c = arguments
            return self.operate("fadd", kind, self.operate("fmul", kind, a, b), c)
        return super().call(name, kind, arguments)
