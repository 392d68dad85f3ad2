"""What the machine itself can do: multiply-adds per second on one core, and bytes per second through memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

CHAINS, WIDTH = 16, 8  # independent sums, numbers in a vector
BYTES = 1 << 27

_burn: Any = None
_local: Any = None


def run_multiply_adds(x: Any, rounds: int) -> None:
    """Multiply and add `rounds` times in all chains."""
    here = _local(x, CHAINS, WIDTH)
    for i in range(CHAINS):
        for a in range(WIDTH):
            here[i, a] = x[i, a]
    for _ in range(rounds):
        _burn(0, here)
    for i in range(CHAINS):
        for a in range(WIDTH):
            x[i, a] = here[i, a]


def multiply_add_job(rounds: int) -> tuple[Callable[[], object], int]:
    """Return a job that does nothing but fused multiply-adds in double precision, and how many it does."""
    from servoscope.core.jit import fma, kernel, specialise, stack_array, trace_function

    def once(x: Any) -> None:
        for i in range(CHAINS):
            x[i] = fma(x[i], 0.999, 0.001)

    run = kernel(
        specialise(run_multiply_adds, {"_burn": trace_function(once, WIDTH), "_local": stack_array}, "burn"), heap=False
    )
    x = np.ones((CHAINS, WIDTH))
    return lambda: run(x, rounds), rounds * CHAINS * WIDTH


def copy_job() -> tuple[Callable[[], object], int]:
    """Return a job that copies memory, and how many bytes it moves, reading and writing."""
    source, target = np.ones(BYTES // 8), np.ones(BYTES // 8)
    return lambda: np.copyto(target, source), 2 * BYTES
