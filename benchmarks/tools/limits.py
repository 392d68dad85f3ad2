"""What the machine itself can do: multiply-adds per second on one core, and bytes per second through memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

CHAINS, WIDTH = 16, 8  # independent sums, numbers in a vector
BYTES = 1 << 27


def multiply_add_job(rounds: int) -> tuple[Callable[[], object], int]:
    """Return a job that does nothing but fused multiply-adds in double precision, and how many it does."""
    from servoscope.core.jit import fma
    from servoscope.core.jit.llvm_text import LlvmPrinter
    from servoscope.core.jit.memory import Memory, repeat
    from servoscope.core.jit.native import address, native_function

    def once(x: Any, i: Any) -> None:
        for chain in range(CHAINS):
            x[chain] = fma(x[chain], 0.999, 0.001)

    arguments = ("x", "ptr"), ("rounds", "i64")
    printer = LlvmPrinter(arguments)
    memory = Memory(printer, "%x", "double", WIDTH)
    repeat(once, 0, printer.argument("rounds"), memory, kept=(memory,))
    printer.write("ret void")
    run, x = native_function(printer.text(), arguments), np.ones((CHAINS, WIDTH))
    return lambda: run(address(x), rounds), rounds * CHAINS * WIDTH


def copy_job() -> tuple[Callable[[], object], int]:
    """Return a job that copies memory, and how many bytes it moves, reading and writing."""
    source, target = np.ones(BYTES // 8), np.ones(BYTES // 8)
    return lambda: np.copyto(target, source), 2 * BYTES
