"""Runs the chain over states: a block of many assets, one sample, a look at a state, the regressors of a log.

Templates, filled by `servoscope.machine`; arrays are (rows, lanes), one lane per asset.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.chain import HEAD, MISSING, SAMPLE, TILE
from servoscope.compiled import laid, local
from servoscope.plants import FloatArray

BoolArray = npt.NDArray[np.bool_]

# what the templates are filled with
_columns: Any = None
_enter: Any = None
_extra: Any = None
_fetch: Any = None
_floats: Any = None
_lanes: Any = None
_own: Any = None
_pack: Any = None
_put: Any = None
_row: Any = None
_rows: Any = None
_size: Any = None
_stretch: Any = None
_tile: Any = None
_unpack: Any = None
_watched: Any = None
_write: Any = None


def block(
    constants: FloatArray,
    state: FloatArray,
    new: FloatArray,
    r: FloatArray,
    u: FloatArray,
    y: FloatArray,
    restart: BoolArray,
    every: int,
    stride: int,
    out: FloatArray,
    begin: int,
    end: int,
) -> None:
    """Run the blocks of lanes from `begin` to `end`: r, u, y (assets, N) lead from `state` to `new` and `out`.

    `constants` (blocks, rows times lanes) has one row if all share it, `restart` none where no sample restarts.
    """
    assets, samples = r.shape
    private = HEAD + _floats + _watched
    s = local(constants, _floats, _lanes)
    h = local(state, HEAD, _lanes)
    g = local(constants, _watched, _lanes)
    tile = local(constants, _tile, _lanes)
    v = local(constants, _rows, _lanes)
    shadow = local(constants, _columns, _lanes)
    e = local(constants, 2, _lanes)
    said = local(state, 1, _lanes)
    q = local(constants, _row, _lanes)
    for b in range(begin, end):
        c = laid(constants[b if _own else 0], _lanes, _own)
        _unpack(state, b * _lanes, s, h, g)
        for a in range(_lanes):
            for i in range(3 * TILE, _tile):
                tile[i, a] = 0.0
        for i in range(_extra):
            new[b, private + i] = state[b, private + i]
        extra = new[b * _lanes, private : private + _extra]
        number = int(state[0, SAMPLE])
        since, turn, row, k, window = number % every, number % stride, 0, 0, -TILE
        while k < samples:
            count = min(TILE, samples - k, every - since)
            if k + count > window + TILE:
                window = max(0, min(k, samples - TILE))
                _fetch(r, u, y, b * _lanes, window, tile)
                if restart.shape[0]:
                    for a in range(_lanes):
                        for j in range(min(TILE, samples)):
                            tile[3 * TILE + j, a] = restart[min(b * _lanes + a, assets - 1), window + j]
            i = k - window
            _stretch(c, s, h, g, tile, i, i + count, turn, stride, since == 0, v, shadow, e, said, extra)
            k, since, turn = k + count, since + count, (turn + count) % stride
            if since == every:
                since = 0
                _write(c, s, h, q)
                _put(q, out, b * _lanes, row * _row)
                row += 1
        _pack(s, h, g, new, b * _lanes)


def step(constants: FloatArray, state: FloatArray, r: float, u: float, y: float) -> bool:
    """Take one sample of one asset, in place; return whether an evaluation is due."""
    every, stride = int(constants[0]), int(constants[1])
    c = laid(constants, 1, 1)
    s = local(state, _floats, 1)
    h = local(state, HEAD, 1)
    g = local(state, _watched, 1)
    tile = local(state, _tile, 1)
    v = local(state, _rows, 1)
    shadow = local(state, _columns, 1)
    e = local(state, 2, 1)
    said = local(state, 1, 1)
    private = HEAD + _floats + _watched
    row = laid(state, _size, 1)
    _unpack(row, 0, s, h, g)
    tile[0, 0], tile[TILE, 0], tile[2 * TILE, 0], tile[3 * TILE, 0] = r, u, y, 0.0
    number = int(state[SAMPLE])
    extra = state[private : private + _extra]
    _stretch(c, s, h, g, tile, 0, 1, number % stride, stride, number % every == 0, v, shadow, e, said, extra)
    _pack(s, h, g, row, 0)
    return (number + 1) % every == 0


def look(constants: FloatArray, state: FloatArray, out: FloatArray) -> None:
    """Evaluate states (assets, size) as they are, one asset after the other, to out (assets, row)."""
    for asset in range(len(state)):
        c = laid(constants[asset if _own else 0], 1, 1)
        s = local(state, _floats, 1)
        h = local(state, HEAD, 1)
        g = local(state, _watched, 1)
        q = local(state, _row, 1)
        _unpack(state, asset, s, h, g)
        _write(c, s, h, q)
        for i in range(_row):
            out[asset, i] = q[i, 0]


def regress(
    constants: FloatArray,
    state: FloatArray,
    r: FloatArray,
    u: FloatArray,
    y: FloatArray,
    restart: BoolArray,
    stride: int,
    out: FloatArray,
    ok: Any,
) -> None:
    """Write [eta, phi, z] of every sample of one asset to out (N, rows), and what is said of it to ok (N,).

    The state is carried on in place.
    """
    c = laid(constants, 1, 1)
    s = local(constants, _floats, 1)
    h = local(constants, HEAD, 1)
    g = local(constants, _watched, 1)
    v = local(constants, _rows, 1)
    tile = local(constants, _tile, 1)
    shadow = local(constants, _columns, 1)
    said = local(constants, 1, 1)
    row = laid(state, _size, 1)
    _unpack(row, 0, s, h, g)
    number = int(state[SAMPLE])
    for k in range(len(r)):
        tile[0, 0], tile[TILE, 0], tile[2 * TILE, 0], tile[3 * TILE, 0] = r[k], u[k], y[k], restart[k]
        _enter(c, s, h, said, 0, tile, 0, (number + k + 1) % stride == 0, v, shadow)
        ok[k] = said[0, 0]
        if ok[k] != MISSING:
            for i in range(_rows):
                out[k, i] = v[i, 0]
    h[SAMPLE, 0] = number + len(r)
    _pack(s, h, g, row, 0)


DRIVERS = (block, step, look, regress)
