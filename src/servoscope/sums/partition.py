"""Optimal partitioning of a recording into stretches with constant coefficients, healthy or changed (Jackson, 2005)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray, IntArray
from servoscope.sums.evidence import ChangePrior

GRID = 100  # stretches between the times that are tried first; around the changes found, finer ones are
CONSPICUOUS = 30  # short windows, at most, whose ends are tried as well
FINER = 4  # times
CHANGE_BLOCKS = 2  # within which a change comes, and passes the filters: each may have coefficients of its own


class Stretch(NamedTuple):
    """Blocks `begin` to `end` of a recording."""

    begin: int
    end: int
    changed: bool

    @property
    def inside(self) -> int:
        """The first block after those within which the change before came; `end` where there is none."""
        return min(self.begin + CHANGE_BLOCKS, self.end) if self.begin else 0


class Partition(NamedTuple):
    """The likeliest stretches of a recording, and their evidence less what their number costs [nats]."""

    evidence: float
    stretches: tuple[Stretch, ...]


def partition(
    M: FloatArray, w: FloatArray, prior: ChangePrior, cut: float, shortest: int, *, changes: bool = True
) -> Partition:
    """Cut a recording where that explains it best; a cut costs `cut` nats, a stretch has `shortest` blocks or more.

    The last one may be shorter, for the recording may end at once after a change; then it is rather changed than
    healthy, which so few blocks do not show. M (K + 1, p, p) and w (K + 1, p) are running sums. Times of change are
    sought on a grid that is as fine as blocks only around those found, and around short windows that look changed by
    themselves: hours cost what minutes do. Without `changes`, all stretches are healthy.
    """
    K = len(w) - 1
    step = max(1, -(-K // GRID))
    last = np.arange(max(K - shortest, 0), K + 1)
    grid = np.unique(np.concatenate([np.arange(0, K, step), _conspicuous_ends(M, w, prior, shortest), last]))
    while True:
        best = _best_on_grid(M, w, prior, cut, shortest, grid, changes=changes)
        finer = _refined(grid, [s.begin for s in best.stretches[1:]])
        if len(finer) == len(grid):
            return best
        grid = finer


def _conspicuous_ends(M: FloatArray, w: FloatArray, prior: ChangePrior, length: int) -> IntArray:
    ends = np.arange(0, len(w), max(length, 1))
    healthy, changed = prior.evidence(M[ends[1:]] - M[ends[:-1]], w[ends[1:]] - w[ends[:-1]])
    order = np.argsort(healthy - changed)[:CONSPICUOUS]
    order = order[(changed > healthy)[order]]
    return np.concatenate([ends[order], ends[order + 1]])


def _refined(grid: IntArray, cuts: list[int]) -> IntArray:
    added = [grid]
    for cut in cuts:
        at = int(np.searchsorted(grid, cut))
        low, high = grid[max(at - 1, 0)], grid[min(at + 1, len(grid) - 1)]
        added.append(np.arange(low, high, max(int(high - low) // (2 * FINER), 1)))
    return np.unique(np.concatenate(added))


def _best_on_grid(
    M: FloatArray, w: FloatArray, prior: ChangePrior, cut: float, shortest: int, grid: IntArray, *, changes: bool
) -> Partition:
    length = grid[None, :] - grid[:, None]
    first, last = np.nonzero((length >= shortest) | ((length > 0) & (grid == grid[-1])))
    begin, end = grid[first], grid[last]
    healthy, changed = np.full((2, len(grid), len(grid)), -np.inf)
    healthy[first, last], changed[first, last] = prior.evidence(M[end] - M[begin], w[end] - w[begin])
    own = np.concatenate([prior.evidence(M[1:] - M[:-1], w[1:] - w[:-1])[1], np.zeros(1)])
    for blocks in range(1, CHANGE_BLOCKS + 1):
        inner = (begin > 0) & (end - begin > blocks)
        rows, columns, at = first[inner], last[inner], begin[inner] + blocks
        passed = np.sum([own[at - blocks + k] for k in range(blocks)], axis=0)
        parts = prior.evidence(M[end[inner]] - M[at], w[end[inner]] - w[at])
        for table, part in zip((healthy, changed), parts, strict=True):
            table[rows, columns] = np.maximum(table[rows, columns], part + passed)
    if changes:
        healthy[length < shortest] -= 2.0 * prior.cost
    else:
        changed[:] = -np.inf
    single = np.maximum(healthy, changed) - cut
    best, previous = np.full(len(grid), -np.inf), np.zeros(len(grid), dtype=np.int64)
    best[0] = cut  # the first stretch needs no cut
    for j in range(1, len(grid)):
        total = best + single[:, j]
        previous[j] = int(np.argmax(total))
        best[j] = total[previous[j]]
    stretches, j = list[Stretch](), len(grid) - 1
    while j > 0:
        i = int(previous[j])
        stretches.append(Stretch(int(grid[i]), int(grid[j]), bool(changed[i, j] > healthy[i, j])))
        j = i
    return Partition(float(best[-1]), tuple(stretches[::-1]))
