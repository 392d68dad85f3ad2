"""Carries states, samples and evaluations between the arrays of a fleet and the lanes of a block.

Templates, filled as those of `servoscope.drive` are. Where a whole block of lanes is taken, squares of numbers are
turned in registers.
"""

from __future__ import annotations

from typing import Any

from servoscope.chain import HEAD, TILE
from servoscope.compiled import LINE, ahead
from servoscope.plants import FloatArray

# what the templates are filled with
_fetch_each: Any = None
_floats: Any = None
_lanes: Any = None
_pack_each: Any = None
_put_each: Any = None
_row: Any = None
_square: Any = None
_turn: Any = None
_unpack_each: Any = None
_watched: Any = None
_width: Any = None


def unpack(state: FloatArray, first: int, s: FloatArray, h: FloatArray, g: FloatArray) -> None:
    """Put the states of assets, from `first` on, into the lanes; the last asset fills the lanes that are left."""
    for a in range(_lanes):
        row = state[min(first + a, len(state) - 1)]
        for i in range(HEAD):
            h[i, a] = row[i]
        for i in range(_floats):
            s[i, a] = row[HEAD + i]
        for i in range(_watched):
            g[i, a] = row[HEAD + _floats + i]


def pack(s: FloatArray, h: FloatArray, g: FloatArray, state: FloatArray, first: int) -> None:
    """Put the lanes into the states of assets, from `first` on."""
    for a in range(min(_lanes, len(state) - first)):
        row = state[first + a]
        for i in range(HEAD):
            row[i] = h[i, a]
        for i in range(_floats):
            row[HEAD + i] = s[i, a]
        for i in range(_watched):
            row[HEAD + _floats + i] = g[i, a]


def fetch(r: FloatArray, u: FloatArray, y: FloatArray, first: int, k: int, tile: FloatArray) -> None:
    """Put the samples from k on into the tile, as many as it holds, of the assets from `first` on."""
    for a in range(_lanes):
        asset = min(first + a, len(r) - 1)
        for i in range(min(TILE, r.shape[1] - k)):
            tile[i, a], tile[TILE + i, a], tile[2 * TILE + i, a] = r[asset, k + i], u[asset, k + i], y[asset, k + i]


def put(q: FloatArray, out: FloatArray, first: int, column: int) -> None:
    """Write the evaluations of the lanes to out (assets, ...), from asset `first` and a column on."""
    for a in range(min(_lanes, len(out) - first)):
        for i in range(_row):
            out[first + a, column + i] = q[i, a]


def unpack_squares(state: FloatArray, first: int, s: FloatArray, h: FloatArray, g: FloatArray) -> None:
    """Do as `unpack`, in squares where all lanes are taken."""
    if first + _lanes > len(state):
        _unpack_each(state, first, s, h, g)
        return
    for a in range(0, _lanes, HEAD):
        _square(state, first + a, 0, h, 0, a)
        for i in range(0, _floats, HEAD):
            j = min(i, _floats - HEAD)
            _square(state, first + a, HEAD + j, s, j, a)
        for i in range(0, _watched, HEAD):
            _square(state, first + a, HEAD + _floats + i, g, i, a)


def pack_squares(s: FloatArray, h: FloatArray, g: FloatArray, state: FloatArray, first: int) -> None:
    """Do as `pack`, in squares where all lanes are taken."""
    if first + _lanes > len(state):
        _pack_each(s, h, g, state, first)
        return
    for a in range(0, _lanes, HEAD):
        _square(h, 0, a, state, first + a, 0)
        for i in range(0, _floats, HEAD):
            j = min(i, _floats - HEAD)
            _square(s, j, a, state, first + a, HEAD + j)
        for i in range(0, _watched, HEAD):
            _square(g, i, a, state, first + a, HEAD + _floats + i)


def fetch_squares(r: FloatArray, u: FloatArray, y: FloatArray, first: int, k: int, tile: FloatArray) -> None:
    """Do as `fetch`, in squares where all lanes and the whole tile are taken; the next tile is fetched ahead."""
    if first + _lanes > len(r) or k + TILE > r.shape[1]:
        _fetch_each(r, u, y, first, k, tile)
        return
    for j in range(0, TILE, _width):
        for a in range(0, _lanes, _width):
            _turn(r, first + a, k + j, tile, j, a)
            _turn(u, first + a, k + j, tile, TILE + j, a)
            _turn(y, first + a, k + j, tile, 2 * TILE + j, a)
    for a in range(first, first + _lanes):
        for j in range(k + TILE, k + 2 * TILE, LINE // 8):
            ahead(r, a, j)
            ahead(u, a, j)
            ahead(y, a, j)


def put_squares(q: FloatArray, out: FloatArray, first: int, column: int) -> None:
    """Do as `put`, in squares where all lanes are taken."""
    if first + _lanes > len(out):
        _put_each(q, out, first, column)
        return
    for a in range(0, _lanes, _width):
        for i in range(0, _row, _width):
            _turn(q, min(i, _row - _width), a, out, first + a, column + min(i, _row - _width))


MOVES = (unpack, pack, fetch, put)
SQUARES = (unpack_squares, pack_squares, fetch_squares, put_squares)  # the same, for many lanes
