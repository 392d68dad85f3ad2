"""The kernels of a recursion: a block of many assets, one sample, evaluations of states, regressors of a log.

Templates, filled by `kernel.build`; arrays are (rows, lanes), one lane per asset.
"""

from __future__ import annotations

from typing import Any

from servoscope.core.arrays import BoolArray
from servoscope.core.arrays import FloatArray as Rows
from servoscope.core.jit import lane_view, stack_array
from servoscope.estimation.kernel.sample_steps import HEADER_SIZE, MISSING, SAMPLE, TILE

# what the templates are filled with
_UNFILLED: Any = None
_columns = _filter_sample = _extra = _fetch_tile = _floats = _lanes = _own = _pack_states = _UNFILLED
_write_results = _row = _rows = _size = _process_samples = _tile = _unpack_states = _watched = _evaluate = _UNFILLED


def run_blocks(
    constants: Rows, state: Rows, new: Rows, r: Rows, u: Rows, y: Rows, restart: BoolArray, every: int,
    stride: int, out: Rows, begin: int, end: int,
) -> None:  # fmt: skip
    """Run the blocks of lanes from `begin` to `end`: r, u, y (assets, N) lead from `state` to `new` and `out`.

    `constants` (blocks, rows times lanes) has one row if all share it, `restart` none where no sample restarts.
    """
    assets, samples = r.shape
    private = HEADER_SIZE + _floats + _watched
    s = stack_array(constants, _floats, _lanes)
    h = stack_array(state, HEADER_SIZE, _lanes)
    g = stack_array(constants, _watched, _lanes)
    tile = stack_array(constants, _tile, _lanes)
    v = stack_array(constants, _rows, _lanes)
    shadow = stack_array(constants, _columns, _lanes)
    e = stack_array(constants, 2, _lanes)
    status = stack_array(state, 1, _lanes)
    q = stack_array(constants, _row, _lanes)
    for b in range(begin, end):
        c = lane_view(constants[b if _own else 0], _lanes, _own)
        _unpack_states(state, b * _lanes, s, h, g)
        for a in range(_lanes):
            for i in range(3 * TILE, _tile):
                tile[i, a] = 0.0
        for i in range(_extra):
            new[b, private + i] = state[b, private + i]
        extra = new[b * _lanes, private : private + _extra]
        number = int(state[0, SAMPLE])
        since, phase, row, k, window = number % every, number % stride, 0, 0, -TILE
        while k < samples:
            count = min(TILE, samples - k, every - since)
            if k + count > window + TILE:
                window = max(0, min(k, samples - TILE))
                _fetch_tile(r, u, y, b * _lanes, window, tile)
                if restart.shape[0]:
                    for a in range(_lanes):
                        for j in range(min(TILE, samples)):
                            tile[3 * TILE + j, a] = restart[min(b * _lanes + a, assets - 1), window + j]
            i = k - window
            first, last = since == 0, since + count == every
            _process_samples(c, s, h, g, tile, i, i + count, phase, stride, first, last, v, shadow, e, status, extra)
            k, since, phase = k + count, since + count, (phase + count) % stride
            if since == every:
                since = 0
                _evaluate(c, s, h, q)
                _write_results(q, out, b * _lanes, row * _row)
                row += 1
        _pack_states(s, h, g, new, b * _lanes)


def run_sample(constants: Rows, state: Rows, r: float, u: float, y: float) -> bool:
    """Take one sample of one asset, in place; return whether an evaluation is due."""
    every, stride = int(constants[0]), int(constants[1])
    c = lane_view(constants, 1, 1)
    s = stack_array(state, _floats, 1)
    h = stack_array(state, HEADER_SIZE, 1)
    g = stack_array(state, _watched, 1)
    tile = stack_array(state, _tile, 1)
    v = stack_array(state, _rows, 1)
    shadow = stack_array(state, _columns, 1)
    e = stack_array(state, 2, 1)
    status = stack_array(state, 1, 1)
    private = HEADER_SIZE + _floats + _watched
    row = lane_view(state, _size, 1)
    _unpack_states(row, 0, s, h, g)
    tile[0, 0], tile[TILE, 0], tile[2 * TILE, 0], tile[3 * TILE, 0] = r, u, y, 0.0
    number = int(state[SAMPLE])
    extra = state[private : private + _extra]
    first, last = number % every == 0, (number + 1) % every == 0
    _process_samples(c, s, h, g, tile, 0, 1, number % stride, stride, first, last, v, shadow, e, status, extra)
    _pack_states(s, h, g, row, 0)
    return last


def evaluate_states(constants: Rows, state: Rows, out: Rows) -> None:
    """Evaluate states (assets, size) as they are, one asset after the other, to out (assets, row)."""
    for asset in range(len(state)):
        c = lane_view(constants[asset if _own else 0], 1, 1)
        s = stack_array(state, _floats, 1)
        h = stack_array(state, HEADER_SIZE, 1)
        g = stack_array(state, _watched, 1)
        q = stack_array(state, _row, 1)
        _unpack_states(state, asset, s, h, g)
        _evaluate(c, s, h, q)
        for i in range(_row):
            out[asset, i] = q[i, 0]


def write_regressors(
    constants: Rows, state: Rows, r: Rows, u: Rows, y: Rows, restart: BoolArray, stride: int, out: Rows, ok: Any
) -> None:
    """Write [eta, phi, z] of every sample of one asset to out (N, rows), and its status to ok (N,).

    The state is carried on in place.
    """
    c = lane_view(constants, 1, 1)
    s = stack_array(constants, _floats, 1)
    h = stack_array(constants, HEADER_SIZE, 1)
    g = stack_array(constants, _watched, 1)
    v = stack_array(constants, _rows, 1)
    tile = stack_array(constants, _tile, 1)
    shadow = stack_array(constants, _columns, 1)
    status = stack_array(constants, 1, 1)
    row = lane_view(state, _size, 1)
    _unpack_states(row, 0, s, h, g)
    number = int(state[SAMPLE])
    for k in range(len(r)):
        tile[0, 0], tile[TILE, 0], tile[2 * TILE, 0], tile[3 * TILE, 0] = r[k], u[k], y[k], restart[k]
        _filter_sample(c, s, h, status, 0, tile, 0, (number + k + 1) % stride == 0, v, shadow)
        ok[k] = status[0, 0]
        if ok[k] != MISSING:
            for i in range(_rows):
                out[k, i] = v[i, 0]
    h[SAMPLE, 0] = number + len(r)
    _pack_states(s, h, g, row, 0)


DRIVERS = (run_blocks, run_sample, evaluate_states, write_regressors)
