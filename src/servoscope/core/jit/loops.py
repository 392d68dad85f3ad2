"""Loops over arrays that Numba compiles on their first call, and keeps on disk where a folder can be written."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import numba

from servoscope.core.cache_folders import warn_of_missing_cache

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile a function on its first call; without a folder for the cache, for this process only."""
    compile_function = functools.partial(numba.njit, error_model="numpy", nogil=True)
    try:
        return compile_function(cache=True)(function)  # type: ignore[no-any-return]
    except RuntimeError:  # Numba found no folder that it can write
        warn_of_missing_cache()
        return compile_function()(function)  # type: ignore[no-any-return]
