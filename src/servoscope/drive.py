"""Runs the chain over states: a block of many assets, one sample, a look at a state, the regressors of a log.

Templates: `servoscope.recursion` fills them with sizes, and with the steps of `servoscope.chain` as code. Arrays are
(rows, lanes), one lane per asset; where all lanes do the same, the loops over them become vector instructions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.chain import ABSURD, ARMED, BETWEEN, HEAD, MISSING, SAMPLE, TILE, USED, WATCHED
from servoscope.compiled import LINE, ahead, laid, local
from servoscope.plants import FloatArray

BoolArray = npt.NDArray[np.bool_]

# what the templates are filled with: sizes, places, lanes and how many of them go together, and the steps of the chain:
# each for as many lanes as go together, or (`_one`) for a single one
_advance: Any = None
_advance_one: Any = None
_alarm: Any = None
_at: Any = None
_begin_one: Any = None
_calm: Any = None
_columns: Any = None
_enter: Any = None
_evaluate: Any = None
_extra: Any = None
_fetch: Any = None
_fetch_each: Any = None
_floats: Any = None
_follow_one: Any = None
_forget_one: Any = None
_frequencies: Any = None
_glide: Any = None
_glided: Any = None
_handed: Any = None
_highest: Any = None
_lanes: Any = None
_learn: Any = None
_learn_one: Any = None
_listen: Any = None
_n: Any = None
_note: Any = None
_own: Any = None
_pack: Any = None
_pack_each: Any = None
_put: Any = None
_put_each: Any = None
_renew: Any = None
_respond: Any = None
_room: Any = None
_row: Any = None
_rows: Any = None
_sample: Any = None
_several: Any = None
_size: Any = None
_square: Any = None
_stretch: Any = None
_take: Any = None
_take_all: Any = None
_tell: Any = None
_tick: Any = None
_tile: Any = None
_to: Any = None
_turn: Any = None
_unpack: Any = None
_unpack_each: Any = None
_update: Any = None
_used: Any = None
_watched: Any = None
_weigh: Any = None
_width: Any = None
_write: Any = None


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
    tile: FloatArray,
    i: int,
    turn: bool,
    v: FloatArray,
    shadow: FloatArray,
    e: FloatArray,
    said: FloatArray,
    extra: FloatArray,
) -> None:
    """Take sample i of the tile in all lanes, whatever it is."""
    whole = True
    for a in range(0, _lanes, _width):
        whole &= _tick(a, h, tile, i)
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


def gliding(
    c: FloatArray, s: FloatArray, h: FloatArray, tile: FloatArray, begin: int, end: int, e: FloatArray, w: Any, when: Any
) -> bool:
    """Take samples of the tile, from `begin` to `end`, in all lanes if there is nothing odd about any of them; return whether."""
    for a in range(_lanes):
        e[0, a] = e[1, a] = 0.0
    calm = True
    for a in range(0, _lanes, _width):
        _weigh(a, e, tile, begin, end)
        calm &= _calm(a, h, e)
    if calm:
        for a in range(0, _lanes, _width):
            _glide(a, c, s, h, w, when, tile, begin, end)
    return calm


def never(
    c: FloatArray, s: FloatArray, h: FloatArray, tile: FloatArray, begin: int, end: int, e: FloatArray, w: Any, when: Any
) -> bool:
    """Leave all samples to `sample`: for one lane, axes that may rest at any of them, estimators with a P of their own."""
    return False


def stretch(
    c: FloatArray,
    s: FloatArray,
    h: FloatArray,
    g: FloatArray,
    tile: FloatArray,
    begin: int,
    end: int,
    turn: int,
    stride: int,
    first: bool,
    v: FloatArray,
    shadow: FloatArray,
    e: FloatArray,
    said: FloatArray,
    extra: FloatArray,
) -> None:
    """Take samples of the tile, from `begin` to `end`, in all lanes; with `first`, an evaluation begins with them."""
    w = local(c, _handed, _lanes)
    when = local(h, TILE, _lanes)
    if first:
        for a in range(0, _lanes, _width):
            _renew(a, s, h)
    if not (stride == 1 and _glided(c, s, h, tile, begin, end, e, w, when)):
        for i in range(begin, end):
            turn += 1
            _sample(c, s, h, tile, i, turn == stride, v, shadow, e, said, extra)
            if turn == stride:
                turn = 0
            if _watched:
                for a in range(0, _lanes, _width):
                    _note(a, c, s, h, said, e, w, when, i)
    if not _watched:
        return
    top = local(c, TILE, _several)
    for i in range(begin, end):
        for a in range(_several):
            top[i, a] = 0.0
    if _lanes > 1:
        for j in range(0, _watched, WATCHED):
            for a in range(0, _lanes, _width):
                _listen(a, c[_at.tail + j :], g[j:], w, top, begin, end)
    else:
        _listen(0, laid(c[_at.tail :], _several, 1), laid(g, _several, 1), laid(w, _several, 0), top, begin, end)
        for i in range(begin, end):
            _highest(0, laid(top, 1, 1), i)
    for a in range(0, _lanes, _width):
        _alarm(a, s, h, top, when, begin, end)


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
    """Write [eta, phi, z] of every sample of one asset to out (N, rows), and what is said of it to ok (N,)."""
    c = laid(constants, 1, 1)
    s = local(constants, _floats, 1)
    h = local(constants, HEAD, 1)
    g = local(constants, _watched, 1)
    v = local(constants, _rows, 1)
    tile = local(constants, _tile, 1)
    shadow = local(constants, _columns, 1)
    said = local(constants, 1, 1)
    _unpack(state, 0, s, h, g)
    for k in range(len(r)):
        tile[0, 0], tile[TILE, 0], tile[2 * TILE, 0], tile[3 * TILE, 0] = r[k], u[k], y[k], restart[k]
        _enter(c, s, h, said, 0, tile, 0, (k + 1) % stride == 0, v, shadow)
        ok[k] = said[0, 0]
        if ok[k] != MISSING:
            for i in range(_rows):
                out[k, i] = v[i, 0]


# each calls only those before it
PARTS = (enter, settled, refreshed, together, apart, sample, gliding, never, stretch, complete, plain)
MOVES = (unpack, pack, fetch, put)
SQUARES = (unpack_squares, pack_squares, fetch_squares, put_squares)  # the same, for many lanes
DRIVERS = (block, step, look, regress)
