"""Kernels as plain Python, interpreted: the same arithmetic to the same bits, without any compiler.

It replaces `core.jit.compile` where Numba is missing or has changed, and checks it in tests. Elementary functions
(log, exp, sin) are NumPy's here and the C library's there; they may differ in the last bit.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import numpy as np

F = TypeVar("F", bound="Callable[..., object]")


def kernel(function: F, heap: bool = True) -> F:
    """Return the function itself, but dividing by zero gives an infinity, as machine code does."""

    @functools.wraps(function)
    def run(*arguments: Any) -> Any:
        # numbers of Python raise when they are divided by zero, those of NumPy do not
        with np.errstate(all="ignore"):
            return function(*(np.float64(x) if type(x) is float else x for x in arguments))

    return run  # type: ignore[return-value]


def subroutine(function: F, heap: bool = False, always: bool = False) -> F:
    """Return the function itself."""
    return function


inline = subroutine


def trace_function(
    function: Callable[..., Any], width: int = 1, shared: str = "", kept: Sequence[str] = ()
) -> Callable[..., bool]:
    """Return ``part(lane, ...)``, which calls the function lane by lane; see `core.jit.compile.trace_function`."""
    arguments = tuple(inspect.signature(function).parameters)

    def part(first: int, *values: Any) -> bool:
        holds = True
        for lane in range(first, first + width):
            given = [
                value[:, first if name == shared else lane] if isinstance(value, np.ndarray) else value
                for name, value in zip(arguments, values, strict=False)
            ]
            if not kept:
                result = function(*given)
                holds &= result is None or bool(result)
                continue
            for i in range(*values[-2:]):
                function(*given[:-1], i)
        return holds

    return part


def stack_array(like: Any, rows: int, columns: int) -> Any:
    """Return an array (rows, columns) of the precision of another."""
    return np.zeros((rows, columns), like.dtype)


def lane_view(flat: Any, lanes: int, own: int) -> Any:
    """Return a view (rows, lanes) of a contiguous array; with own = 0 all lanes share one column."""
    columns = lanes if own else 1
    rows = flat.reshape(-1)[: flat.size // columns * columns].reshape(-1, columns)
    return rows if own else np.lib.stride_tricks.as_strided(rows, (len(rows), lanes), (rows.strides[0], 0))


def make_transpose(width: int) -> Callable[..., None]:
    """Return ``transpose(x, i, j, y, k, l)``; see `core.jit.compile.make_transpose`."""

    def transpose(x: Any, i: int, j: int, y: Any, k: int, l: int) -> None:
        y[k : k + width, l : l + width] = x[i : i + width, j : j + width].T

    return transpose


def prefetch(x: Any, i: int, j: int) -> None:
    """Do nothing: there is no code that could wait for memory."""


def load_word(data: Any, i: int) -> Any:
    """Return bytes i to i + 7 of an array of bytes as a word, the first of them lowest."""
    return np.uint64(int.from_bytes(data[i : i + 8].tobytes(), "little"))


def as_float(word: Any) -> Any:
    """Return the number whose bits a word is: binary64, or binary32 of one of 32 bits."""
    return word.view(np.float64 if word.itemsize == 8 else np.float32)


def multiply_high(a: Any, b: Any) -> Any:
    """Return the upper 64 bits of the product of two words."""
    return np.uint64(int(a) * int(b) >> 64)


def leading_zeros(word: Any) -> Any:
    """Return how many bits of a word are zero above its highest one; 64: all."""
    return np.uint64(64 - int(word).bit_length())


def trailing_zeros(word: Any) -> Any:
    """Return how many bits of a word are zero below its lowest one; 64: all."""
    return np.uint64((int(word) & -int(word)).bit_length() - 1 if word else 64)


@contextlib.contextmanager
def on_compilation(call: Callable[[], None]) -> Iterator[None]:
    """Never call it: nothing is compiled."""
    yield
