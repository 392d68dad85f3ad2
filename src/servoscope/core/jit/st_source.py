"""Traced arithmetic as Structured Text of IEC 61131-3: `core.jit.c_source` with another grammar.

That language has no fused multiply-add: it becomes a product and a sum, each rounded. It has neither NaN nor infinity;
they become numbers that no physical signal reaches.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Sequence
from typing import Any, ClassVar

from servoscope.core.jit.c_source import CBuilder, CValue

__all__ = ["STBuilder", "st_literal"]

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


class STBuilder(CBuilder):
    """Writes operations down as statements of Structured Text; `numbers` and `flags` are the variables they need."""

    AND, OR = "AND", "OR"
    SELECT = "SEL({0}, {2}, {1})"
    CALLS: ClassVar[dict[str, str]] = {
        "fabs": "ABS({})",
        "sqrt": "SQRT({})",
        "maxnum": "SEL({0} > {1}, {1}, {0})",
        "minnum": "SEL({0} < {1}, {1}, {0})",
    }

    def literal(self, number: float, kind: Any) -> str:
        """Return how a number is written."""
        return st_literal(number)

    def assignment(self, place: str, text: str) -> str:
        """Return the statement that writes a value to a place."""
        return f"{place} := {text};"

    def definition(self, name: str, text: str, kind: Any) -> str:
        """Return the statement that makes a number or a condition; its variable is declared elsewhere."""
        return self.assignment(name, text)

    def call(self, function: Any, arguments: Sequence[Any], fastmath: Iterable[str] = ()) -> CValue:
        """Write a call of one of LLVM's own functions; a fused multiply-add as two operations."""
        if function.name.startswith("llvm.fma."):
            a, b, c = arguments
            return self.fadd(self.fmul(a, b), c)
        return super().call(function, arguments, fastmath)
