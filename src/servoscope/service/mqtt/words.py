"""Words of 64 bits within loops that Numba compiles: what processors have an instruction for, and Python has not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from servoscope.core.jit import inline

BITS, BYTES = 8, 8


@inline
def load_word(data: Any, i: int) -> Any:
    """Return bytes i to i + 7 of an array of bytes as a word, the first of them lowest."""
    word = np.uint64(0)
    for k in range(BYTES):
        word |= np.uint64(data[i + k]) << np.uint64(BITS * k)
    return word


@intrinsic
def as_float(typing: Any, word: Any) -> Any:
    """Return the binary64 whose bits a word is."""
    return types.float64(word), lambda context, builder, signature, values: builder.bitcast(
        values[0], context.get_value_type(types.float64)
    )


@intrinsic
def multiply_high(typing: Any, a: Any, b: Any) -> Any:
    """Return the upper 64 bits of the product of two words."""

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        wide = ir.IntType(128)
        product = builder.mul(*(builder.zext(value, wide) for value in values))
        return builder.trunc(builder.lshr(product, wide(64)), ir.IntType(64))

    return types.uint64(types.uint64, types.uint64), code


def _count_zeros(instruction: str) -> Callable[..., Any]:
    def count(typing: Any, word: Any) -> Any:
        return types.uint64(types.uint64), lambda context, builder, signature, values: getattr(builder, instruction)(
            values[0], ir.IntType(1)(0)
        )

    made: Callable[..., Any] = intrinsic(count)
    return made


leading_zeros, trailing_zeros = _count_zeros("ctlz"), _count_zeros("cttz")  # of a word; 64: all its bits
