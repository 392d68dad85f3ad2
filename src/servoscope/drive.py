"""Runs the chain over states: a block of many assets, one sample, a look at a state, the regressors of a log.

Templates: `servoscope.recursion` fills them with sizes, and with the steps of `servoscope.chain` as code. Arrays are
(rows, lanes), one lane per asset; where all lanes do the same, the loops over them become vector instructions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.chain import ABSURD, ARMED, BETWEEN, HEAD, MISSING, SAMPLE, TILE, USED
from servoscope.compiled import laid, local
from servoscope.plants import FloatArray

BoolArray = npt.NDArray[np.bool_]

# what the templates are filled with: sizes, places, lanes and how many of them go together, and the steps of the chain:
# each for as many lanes as go together, or (`_one`) for a single one
_to: Any = None
_at: Any = None
_n: Any = None
_floats: Any = None
_rows: Any = None
_row: Any = None
_columns: Any = None
_frequencies: Any = None
_extra: Any = None
_watched: Any = None
_room: Any = None
_tile: Any = None
_lanes: Any = None
_width: Any = None
_own: Any = None
_tick: Any = None
_begin_one: Any = None
_advance: Any = None
_advance_one: Any = None
_used: Any = None
_learn: Any = None
_learn_one: Any = None
_follow_one: Any = None
_forget_one: Any = None
_prick: Any = None
_listen: Any = None
_alarm: Any = None
_evaluate: Any = None
_respond: Any = None
_tell: Any = None
_update: Any = None
_enter: Any = None
_take: Any = None
_take_all: Any = None
_write: Any = None
_sample: Any = None


def enter(
    c: FloatArray,
    s: FloatArray,
    h: FloatArray,
    said: FloatArray,
    a: int,
    tile: FloatArray,
    i: int,
    turn: bool,
    v: FloatArray,
    shadow: FloatArray,
) -> None:
    """Pass any sample through the filters: after a gap they begin in their steady state; NaN only asks for that."""
    if not (abs(tile[i, a]) < ABSURD and abs(tile[i + TILE, a]) < ABSURD and abs(tile[i + 2 * TILE, a]) < ABSURD):
        h[ARMED, a] = 0.0  # NaN is not below anything either
        said[0, a] = MISSING
    else:
        if tile[i + 3 * TILE, a] != 0.0 or h[ARMED, a] == 0.0:
            _begin_one(a, c, s, h, tile, i)
        _advance_one(a, c, s, h, said, v, shadow, tile, i, turn)


def settled(
    c: FloatArray, s: FloatArray, h: FloatArray, a: int, v: FloatArray, shadow: FloatArray, e: FloatArray, extra: Any
) -> None:
    """Learn with an estimator whose P stays at P_d."""
    _learn_one(a, c, s, h, v, shadow, e)


def refreshed(
    c: FloatArray, s: FloatArray, h: FloatArray, a: int, v: FloatArray, shadow: FloatArray, e: FloatArray, extra: Any
) -> None:
    """Learn with any estimator: it updates theta and P itself."""
    theta = np.empty(_n)
    phi = np.empty(_n)
    z = np.empty(_n)
    K = np.empty(_n)
    P = np.empty((_n, _n))
    P_d = np.empty((_n, _n))
    k = local(s, _room, _lanes)
    left = v[0, a]
    for i in range(_n):
        theta[i], phi[i], z[i] = s[_to.theta + i, a], v[1 + i, a], v[_rows - _n + i, a]
        left -= phi[i] * theta[i]
        for j in range(_n):
            P[i, j] = s[_to.P + _n * i + j, a]
            P_d[i, j] = c[_at.P_d + _n * i + j, a]
    refused = _update(theta, P, P_d, c[_at.R, a], c[_at.memory, a], v[0, a], phi, z, K, extra)
    for i in range(_n):
        s[_to.theta + i, a], k[i, a] = theta[i], K[i]
        for j in range(_n):
            s[_to.P + _n * i + j, a] = P[i, j]
    k[_n, a] = left
    k[_n + 1, a] = refused
    _follow_one(a, c, s, h, v, shadow, e, k)


def together(c: FloatArray, s: FloatArray, h: FloatArray, v: FloatArray, shadow: FloatArray, e: FloatArray) -> None:
    """Learn in all lanes with an estimator whose P stays at P_d."""
    for a in range(0, _lanes, _width):
        _learn(a, c, s, h, v, shadow, e)


def apart(c: FloatArray, s: FloatArray, h: FloatArray, v: FloatArray, shadow: FloatArray, e: FloatArray) -> None:
    """Learn in one lane after the other with any estimator."""
    for a in range(_lanes):
        _take(c, s, h, a, v, shadow, e, c[0, 0:0])


def sample(
    c: FloatArray,
    s: FloatArray,
    h: FloatArray,
    g: FloatArray,
    tile: FloatArray,
    i: int,
    turn: bool,
    first: bool,
    v: FloatArray,
    shadow: FloatArray,
    e: FloatArray,
    said: FloatArray,
    extra: FloatArray,
) -> None:
    """Take sample i of the tile in all lanes."""
    whole = True
    for a in range(0, _lanes, _width):
        whole &= _tick(a, s, h, tile, i, first)
    used = True
    if _lanes > 1 and whole:
        for a in range(0, _lanes, _width):
            used &= _advance(a, c, s, h, said, v, shadow, tile, i, turn)
    else:
        for a in range(_lanes):
            _enter(c, s, h, said, a, tile, i, turn, v, shadow)
        for a in range(0, _lanes, _width):
            used &= _used(a, said)
    if _lanes > 1 and used:
        _take_all(c, s, h, v, shadow, e)
    else:
        for a in range(_lanes):
            if said[0, a] == USED:
                _take(c, s, h, a, v, shadow, e, extra)
            elif said[0, a] != BETWEEN:
                _forget_one(a, s, h)
    if _watched:
        for a in range(0, _lanes, _width):
            _prick(a, c, h, said, e)
        for j in range(_watched):
            for a in range(0, _lanes, _width):
                _listen(a, c, s, g, e, j)
        for a in range(0, _lanes, _width):
            _alarm(a, s, h, said, e)


def complete(c: FloatArray, s: FloatArray, h: FloatArray, q: FloatArray) -> None:
    """Write one complete evaluation of every lane to q."""
    for a in range(0, _lanes, _width):
        _evaluate(a, c, s, h, q)
    for f in range(_frequencies):
        for a in range(0, _lanes, _width):
            _respond(a, c, s, f, q)


def plain(c: FloatArray, s: FloatArray, h: FloatArray, q: FloatArray) -> None:
    """Write to q, for a diagnosis, what the recursion itself knows."""
    for a in range(0, _lanes, _width):
        _tell(a, s, h, q)


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
    for b in range(begin, end):
        c = laid(constants[b if _own else 0], _lanes, _own)
        s = local(constants, _floats, _lanes)
        h = local(state, HEAD, _lanes)
        g = local(constants, _watched, _lanes)
        tile = local(constants, _tile, _lanes)
        v = local(constants, _rows, _lanes)
        shadow = local(constants, _columns, _lanes)
        e = local(constants, 3, _lanes)
        said = local(state, 1, _lanes)
        q = local(constants, _row, _lanes)
        lowest = HEAD + _floats + _watched
        for a in range(_lanes):
            asset = min(b * _lanes + a, assets - 1)
            for i in range(HEAD):
                h[i, a] = state[asset, i]
            for i in range(_floats):
                s[i, a] = state[asset, HEAD + i]
            for i in range(_watched):
                g[i, a] = state[asset, HEAD + _floats + i]
            for i in range(_extra):
                new[asset, lowest + i] = state[asset, lowest + i]
            for i in range(3 * TILE, _tile):
                tile[i, a] = 0.0
        extra = new[b * _lanes, lowest : lowest + _extra]
        number = int(state[0, SAMPLE])
        since, turn, row = number % every, number % stride, 0
        for k in range(samples):
            if k % TILE == 0:
                for a in range(_lanes):
                    asset = min(b * _lanes + a, assets - 1)
                    for i in range(min(TILE, samples - k)):
                        tile[i, a] = r[asset, k + i]
                        tile[TILE + i, a] = u[asset, k + i]
                        tile[2 * TILE + i, a] = y[asset, k + i]
                    if restart.shape[0]:
                        for i in range(min(TILE, samples - k)):
                            tile[3 * TILE + i, a] = restart[asset, k + i]
            turn += 1
            _sample(c, s, h, g, tile, k % TILE, turn == stride, since == 0, v, shadow, e, said, extra)
            since += 1
            if turn == stride:
                turn = 0
            if since == every:
                since = 0
                _write(c, s, h, q)
                for a in range(_lanes):
                    asset = b * _lanes + a
                    if asset < assets:
                        for i in range(_row):
                            out[asset, row, i] = q[i, a]
                row += 1
        for a in range(_lanes):
            asset = b * _lanes + a
            if asset < assets:
                for i in range(HEAD):
                    new[asset, i] = h[i, a]
                for i in range(_floats):
                    new[asset, HEAD + i] = s[i, a]
                for i in range(_watched):
                    new[asset, HEAD + _floats + i] = g[i, a]


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
    e = local(state, 3, 1)
    said = local(state, 1, 1)
    lowest = HEAD + _floats + _watched
    for i in range(HEAD):
        h[i, 0] = state[i]
    for i in range(_floats):
        s[i, 0] = state[HEAD + i]
    for i in range(_watched):
        g[i, 0] = state[HEAD + _floats + i]
    tile[0, 0], tile[TILE, 0], tile[2 * TILE, 0], tile[3 * TILE, 0] = r, u, y, 0.0
    number = int(state[SAMPLE])
    turn, first = (number + 1) % stride == 0, number % every == 0
    _sample(c, s, h, g, tile, 0, turn, first, v, shadow, e, said, state[lowest : lowest + _extra])
    for i in range(HEAD):
        state[i] = h[i, 0]
    for i in range(_floats):
        state[HEAD + i] = s[i, 0]
    for i in range(_watched):
        state[HEAD + _floats + i] = g[i, 0]
    return (number + 1) % every == 0


def look(constants: FloatArray, state: FloatArray, out: FloatArray) -> None:
    """Evaluate states (assets, size) as they are, one asset after the other, to out (assets, row)."""
    for asset in range(len(state)):
        c = laid(constants[asset if _own else 0], 1, 1)
        s = local(state, _floats, 1)
        h = local(state, HEAD, 1)
        q = local(state, _row, 1)
        for i in range(HEAD):
            h[i, 0] = state[asset, i]
        for i in range(_floats):
            s[i, 0] = state[asset, HEAD + i]
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
    v = local(constants, _rows, 1)
    tile = local(constants, _tile, 1)
    shadow = local(constants, _columns, 1)
    said = local(constants, 1, 1)
    for i in range(HEAD):
        h[i, 0] = state[i]
    for i in range(_floats):
        s[i, 0] = state[HEAD + i]
    number = int(h[SAMPLE, 0])
    for k in range(len(r)):
        tile[0, 0], tile[TILE, 0], tile[2 * TILE, 0], tile[3 * TILE, 0] = r[k], u[k], y[k], restart[k]
        _enter(c, s, h, said, 0, tile, 0, (number + k + 1) % stride == 0, v, shadow)
        ok[k] = said[0, 0]
        if ok[k] != MISSING:
            for i in range(_rows):
                out[k, i] = v[i, 0]
    for i in range(HEAD):
        state[i] = h[i, 0]
    state[SAMPLE] = number + len(r)
    for i in range(_floats):
        state[HEAD + i] = s[i, 0]


PARTS = (enter, settled, refreshed, together, apart, sample, complete, plain)  # each calls only those before it
DRIVERS = (block, step, look, regress)
