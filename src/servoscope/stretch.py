"""Takes a stretch of samples through the chain, in all lanes: together where nothing is odd, one by one where it is.

Templates: `servoscope.machine` fills them with sizes, and with the steps of `servoscope.chain` as code. Arrays are
(rows, lanes), one lane per asset; where all lanes do the same, the loops over them become vector instructions.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from servoscope.chain import ABSURD, ARMED, BETWEEN, MISSING, TILE, USED, WATCHED
from servoscope.compiled import laid, local
from servoscope.plants import FloatArray

# what the templates are filled with
_advance: Any = None
_advance_one: Any = None
_alarm: Any = None
_at: Any = None
_begin_one: Any = None
_calm: Any = None
_enter: Any = None
_evaluate: Any = None
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
_renew: Any = None
_respond: Any = None
_room: Any = None
_rows: Any = None
_sample: Any = None
_several: Any = None
_take: Any = None
_take_all: Any = None
_tell: Any = None
_tick: Any = None
_to: Any = None
_update: Any = None
_used: Any = None
_watched: Any = None
_weigh: Any = None
_width: Any = None


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
    c: FloatArray,
    s: FloatArray,
    h: FloatArray,
    tile: FloatArray,
    begin: int,
    end: int,
    e: FloatArray,
    w: Any,
    when: Any,
) -> bool:
    """Take samples of the tile in all lanes if there is nothing odd about any of them; return whether."""
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
    c: FloatArray,
    s: FloatArray,
    h: FloatArray,
    tile: FloatArray,
    begin: int,
    end: int,
    e: FloatArray,
    w: Any,
    when: Any,
) -> bool:
    """Leave all to `sample`: axes may rest at any of them, some estimators have a P of their own."""
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


# each calls only those before it
PARTS = (enter, settled, refreshed, together, apart, sample, gliding, never, stretch, complete, plain)
