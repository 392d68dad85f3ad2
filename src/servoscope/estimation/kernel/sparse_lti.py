"""Linear systems as straight-line code without products with zeros, and without loops."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.jit import dot
from servoscope.models.lti import LinearSystem

SparsityPattern = tuple[tuple[tuple[int, ...], ...], ...]


def sparsity_pattern(systems: Sequence[LinearSystem]) -> SparsityPattern:
    """Return which inputs and states each row of ``[C D; A B]`` takes, where any of the systems has an entry.

    Rows are outputs, then states; columns are states, then inputs.
    """
    whole = [np.block([[s.C, s.D], [s.A, s.B]]) != 0.0 for s in systems]
    together = np.logical_or.reduce(whole)
    states = len(systems[0].A)
    rows = tuple(tuple(int(j) for j in np.flatnonzero(row)) for row in together)
    return rows[: len(rows) - states], rows[len(rows) - states :]


def pack_coefficients(pattern: SparsityPattern, system: LinearSystem) -> FloatArray:
    """Return the entries of a system in the order in which its code takes them."""
    whole = np.block([[system.C, system.D], [system.A, system.B]])
    rows = [*pattern[0], *pattern[1]]
    return np.array([whole[i, j] for i, row in enumerate(rows) for j in row], dtype=np.float64)


def advance_system(pattern: SparsityPattern, c: Any, at: int, s: Any, to: int, w: Sequence[Any]) -> list[Any]:
    """Take one step of x = A x + B w in traced arithmetic; return v = C x + D w.

    The packed coefficients begin at c[at], x at s[to].
    """
    outputs, states = pattern
    n = len(states)
    rows = (*outputs, *states)
    factors = {j: s[to + j] if j < n else w[j - n] for j in sorted({j for row in rows for j in row})}
    begins = at + np.cumsum([0, *map(len, rows)])
    totals = [
        dot([c[int(begin) + k] for k in range(len(row))], [factors[j] for j in row]) if row else 0.0
        for begin, row in zip(begins, rows, strict=False)
    ]
    for i, total in enumerate(totals[len(outputs) :]):
        s[to + i] = total
    return totals[: len(outputs)]
