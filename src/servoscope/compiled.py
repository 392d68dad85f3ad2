"""How kernels are compiled: strict arithmetic, cached on disk where a folder can be written."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import numba

if TYPE_CHECKING:
    from collections.abc import Callable

F = TypeVar("F", bound="Callable[..., object]")


def kernel(function: F) -> F:
    """Compile a function on its first call; without a folder for the cache, for this process only."""
    try:
        compiled = numba.njit(cache=True, error_model="numpy")(function)
    except RuntimeError:  # Numba found no folder that it can write
        compiled = numba.njit(error_model="numpy")(function)
    return compiled  # type: ignore[no-any-return]
