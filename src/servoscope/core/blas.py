"""Linear algebra on one thread: matrices of a few rows cost more in waking threads than in arithmetic."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from typing import ParamSpec, TypeVar

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def with_one_blas_thread(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return a function that runs with one thread of BLAS; a diagnosis took eight times its processor time with two."""

    @functools.wraps(function)
    def limited(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        if os.environ.get("OPENBLAS_NUM_THREADS") == "1":  # then nothing looks in /proc, which a sandbox closes
            return function(*args, **kwargs)
        from threadpoolctl import threadpool_limits

        with threadpool_limits(1, "blas"):
            return function(*args, **kwargs)

    return limited
