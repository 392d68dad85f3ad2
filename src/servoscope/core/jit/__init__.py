"""The compiler of kernels: plain Python functions, and traced arithmetic, to machine code; the one door to it.

A *kernel* is a function over arrays that Python calls and that is compiled on its first call. A *subroutine* is a part
of kernels. A *template* is a plain function in which `specialise` replaces names by sizes and by other parts. *Traced*
functions are straight-line arithmetic, run once with symbols (`trace_function`); they become vector instructions.

Two backends offer the same names: `compile` (Numba) and `plain`, the same arithmetic interpreted; see `backend`. Those
of the backend are loaded when they are first used (PEP 562), for importing Numba takes longer than all else.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from servoscope.core.jit.symbolic import Bool, dot, fma, maximum, minimum, sine, sqrt, tril_index, where
from servoscope.core.jit.template import specialise

__all__ = [
    "Bool",
    "as_float",
    "dot",
    "fma",
    "inline",
    "kernel",
    "lane_view",
    "leading_zeros",
    "load_word",
    "make_transpose",
    "maximum",
    "minimum",
    "multiply_high",
    "on_compilation",
    "prefetch",
    "sine",
    "specialise",
    "sqrt",
    "stack_array",
    "subroutine",
    "trace_function",
    "trailing_zeros",
    "tril_index",
    "where",
]

if TYPE_CHECKING:
    from servoscope.core.jit.compile import (
        as_float,
        inline,
        kernel,
        lane_view,
        leading_zeros,
        load_word,
        make_transpose,
        multiply_high,
        on_compilation,
        prefetch,
        stack_array,
        subroutine,
        trace_function,
        trailing_zeros,
    )
else:  # hidden from type checkers, which would otherwise accept any name

    def __getattr__(name: str) -> object:
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from servoscope.core.jit.backend import load_backend

        return getattr(load_backend(), name)
