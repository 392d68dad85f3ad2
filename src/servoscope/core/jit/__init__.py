"""The door to machine code: arithmetic written once for every language, and loops over arrays.

*Traced* functions are straight-line arithmetic (`core.jit.symbolic`), run once with symbols. They become vector
instructions (`core.jit.llvm_text`, `core.jit.native`), C (`core.jit.c_source`) or Structured Text
(`core.jit.st_source`). Loops over arrays are traced in the same way (`core.jit.array_function`, `core.jit.arrays`).
"""

from __future__ import annotations

from servoscope.core.jit.symbolic import (
    Bool,
    Float,
    Int,
    dot,
    fma,
    maximum,
    minimum,
    sine,
    sqrt,
    sum_products,
    tril_index,
    where,
)

__all__ = [
    "Bool",
    "Float",
    "Int",
    "dot",
    "fma",
    "maximum",
    "minimum",
    "sine",
    "sqrt",
    "sum_products",
    "tril_index",
    "where",
]
