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


def pad_system(system: LinearSystem, states: int, rows: int) -> LinearSystem:
    """Return a system with as many states and outputs, those that are added zero."""
    padding, silent = (0, states - len(system.A)), (0, rows - len(system.C))
    return LinearSystem(
        np.pad(system.A, (padding, padding)),
        np.pad(system.B, (padding, (0, 0))),
        np.pad(system.C, (silent, padding)),
        np.pad(system.D, (silent, (0, 0))),
    )


def pairs_structure(states: int, rows: int) -> LinearSystem:
    """Return ones where a system in `models.lti.companion_pairs` with one input may have numbers."""
    A = np.asarray(np.kron(np.eye(states // 2), [[1.0, 1.0], [1.0, 0.0]]), dtype=np.float64)
    return LinearSystem(A, np.tile([[1.0], [0.0]], (states // 2, 1)), np.ones((rows, states)), np.ones((rows, 1)))


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
