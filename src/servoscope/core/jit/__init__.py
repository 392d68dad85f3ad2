"""The door to machine code: arithmetic written once for every language, and loops that Numba compiles.

*Traced* functions are straight-line arithmetic (`core.jit.symbolic`), run once with symbols. They become vector
instructions (`core.jit.llvm_text`, `core.jit.native`), C (`core.jit.c_source`) or Structured Text
(`core.jit.st_source`). Loops over arrays are traced in the same way (`core.jit.array_function`, `core.jit.arrays`).
A *kernel* is a plain loop that Numba compiles on its first call (`core.jit.loops`): readers of messages and windows of
features. Those are loaded when they are first used (PEP 562), for importing Numba takes longer than all else.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from servoscope.core.jit.symbolic import (
    Bool,
    Float,
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
    "dot",
    "fma",
    "inline",
    "kernel",
    "maximum",
    "minimum",
    "sine",
    "sqrt",
    "subroutine",
    "sum_products",
    "tril_index",
    "where",
]

if TYPE_CHECKING:
    from servoscope.core.jit.loops import inline, kernel, subroutine
else:  # hidden from type checkers, which would otherwise accept any name

    def __getattr__(name: str) -> object:
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from servoscope.core.jit import loops

        return getattr(loops, name)
