"""Copies states, samples and evaluations between the arrays of a fleet and the lanes of a block.

Templates, filled by `kernel.build`. Whole blocks of lanes are transposed in registers, a square at a time.
"""

from __future__ import annotations

from typing import Any

from servoscope.core.arrays import FloatArray as Rows
from servoscope.core.jit import prefetch
from servoscope.estimation.kernel.sample_steps import HEADER_SIZE, TILE

CACHE_LINE = 8  # numbers in a cache line

# what the templates are filled with
_UNFILLED: Any = None
_fetch_tile_each = _floats = _lanes = _pack_states_each = _write_results_each = _row = _transpose_header = _UNFILLED
_transpose = _unpack_states_each = _watched = _width = _UNFILLED


def unpack_states(state: Rows, first: int, s: Rows, h: Rows, g: Rows) -> None:
    """Copy the states of assets, from `first` on, to the lanes; the last asset fills the lanes that are left."""
    for a in range(_lanes):
        row = state[min(first + a, len(state) - 1)]
        for i in range(HEADER_SIZE):
            h[i, a] = row[i]
        for i in range(_floats):
            s[i, a] = row[HEADER_SIZE + i]
        for i in range(_watched):
            g[i, a] = row[HEADER_SIZE + _floats + i]


def pack_states(s: Rows, h: Rows, g: Rows, state: Rows, first: int) -> None:
    """Copy the lanes to the states of assets, from `first` on."""
    for a in range(min(_lanes, len(state) - first)):
        row = state[first + a]
        for i in range(HEADER_SIZE):
            row[i] = h[i, a]
        for i in range(_floats):
            row[HEADER_SIZE + i] = s[i, a]
        for i in range(_watched):
            row[HEADER_SIZE + _floats + i] = g[i, a]


def fetch_tile(r: Rows, u: Rows, y: Rows, first: int, k: int, tile: Rows) -> None:
    """Copy the samples from k on, as many as it holds, of the assets from `first` on to the tile."""
    for a in range(_lanes):
        asset = min(first + a, len(r) - 1)
        for i in range(min(TILE, r.shape[1] - k)):
            tile[i, a], tile[TILE + i, a], tile[2 * TILE + i, a] = r[asset, k + i], u[asset, k + i], y[asset, k + i]


def write_results(q: Rows, out: Rows, first: int, column: int) -> None:
    """Copy the evaluations of the lanes to out (assets, ...), from asset `first` and a column on."""
    for a in range(min(_lanes, len(out) - first)):
        for i in range(_row):
            out[first + a, column + i] = q[i, a]


def unpack_states_transposed(state: Rows, first: int, s: Rows, h: Rows, g: Rows) -> None:
    """Do as `unpack_states`, by squares where all lanes are taken."""
    if first + _lanes > len(state):
        _unpack_states_each(state, first, s, h, g)
        return
    for a in range(0, _lanes, HEADER_SIZE):
        _transpose_header(state, first + a, 0, h, 0, a)
        for i in range(0, _floats, HEADER_SIZE):
            j = min(i, _floats - HEADER_SIZE)
            _transpose_header(state, first + a, HEADER_SIZE + j, s, j, a)
        for i in range(0, _watched, HEADER_SIZE):
            _transpose_header(state, first + a, HEADER_SIZE + _floats + i, g, i, a)


def pack_states_transposed(s: Rows, h: Rows, g: Rows, state: Rows, first: int) -> None:
    """Do as `pack_states`, by squares where all lanes are taken."""
    if first + _lanes > len(state):
        _pack_states_each(s, h, g, state, first)
        return
    for a in range(0, _lanes, HEADER_SIZE):
        _transpose_header(h, 0, a, state, first + a, 0)
        for i in range(0, _floats, HEADER_SIZE):
            j = min(i, _floats - HEADER_SIZE)
            _transpose_header(s, j, a, state, first + a, HEADER_SIZE + j)
        for i in range(0, _watched, HEADER_SIZE):
            _transpose_header(g, i, a, state, first + a, HEADER_SIZE + _floats + i)


def fetch_tile_transposed(r: Rows, u: Rows, y: Rows, first: int, k: int, tile: Rows) -> None:
    """Do as `fetch_tile`, by squares where all lanes and the whole tile are taken; prefetch the next tile."""
    if first + _lanes > len(r) or k + TILE > r.shape[1]:
        _fetch_tile_each(r, u, y, first, k, tile)
        return
    for j in range(0, TILE, _width):
        for a in range(0, _lanes, _width):
            _transpose(r, first + a, k + j, tile, j, a)
            _transpose(u, first + a, k + j, tile, TILE + j, a)
            _transpose(y, first + a, k + j, tile, 2 * TILE + j, a)
    for a in range(first, first + _lanes):
        for j in range(k + TILE, k + 2 * TILE, CACHE_LINE):
            prefetch(r, a, j)
            prefetch(u, a, j)
            prefetch(y, a, j)


def write_results_transposed(q: Rows, out: Rows, first: int, column: int) -> None:
    """Do as `write_results`, by squares where all lanes are taken."""
    if first + _lanes > len(out):
        _write_results_each(q, out, first, column)
        return
    for a in range(0, _lanes, _width):
        for i in range(0, _row, _width):
            _transpose(q, min(i, _row - _width), a, out, first + a, column + min(i, _row - _width))


COPIES = unpack_states, pack_states, fetch_tile, write_results
TRANSPOSES = unpack_states_transposed, pack_states_transposed, fetch_tile_transposed, write_results_transposed
