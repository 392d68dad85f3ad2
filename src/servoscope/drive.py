"""Runs the chain over states: a block of many assets, one sample, a look at a state, the regressors of a log.

Templates: `servoscope.recursion` fills them with sizes, and with the steps of `servoscope.chain` as code. Arrays are
(rows, lanes), one lane per asset; where all lanes do the same, the loops over them become vector instructions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.chain import ARMED, BETWEEN, COUNTS, CROSSED, HEAD, LARGEST, MISSING, SAMPLE, USED, USED_UP
from servoscope.compiled import laid, local
from servoscope.plants import FloatArray

BoolArray = npt.NDArray[np.bool_]

ABSURD = 1e100  # no physical signal; its square would overflow and stay in the state for ever
TILE = 8  # samples that are fetched together: a cache line of each signal

# what the templates are filled with: sizes, places, number of lanes, whether each has constants of its own
_to: Any = None
_at: Any = None
_n: Any = None
_floats: Any = None
_rows: Any = None
_row: Any = None
_columns: Any = None
_frequencies: Any = None
_extra: Any = None
_tile: Any = None
_lanes: Any = None
_own: Any = None
_watching: Any = None
# and the steps of the chain
_begin: Any = None
_advance: Any = None
_learn: Any = None
_forget: Any = None
_listen: Any = None
_evaluate: Any = None
_respond: Any = None
_tell: Any = None
_follow: Any = None
_update: Any = None
_enter: Any = None
_take: Any = None
_write: Any = None
_test: Any = None
_sample: Any = None


def enter(
    c: FloatArray,
    s: FloatArray,
    h: FloatArray,
    said: FloatArray,
    a: int,
    r: float,
    u: float,
    y: float,
    restart: bool,
    turn: bool,
    v: FloatArray,
    shadow: FloatArray,
) -> None:
    """Pass any sample through the filters: after a gap they begin in their steady state; NaN only asks for that."""
    if not (abs(r) < ABSURD and abs(u) < ABSURD and abs(y) < ABSURD):  # NaN is not below anything either
        h[ARMED, a] = 0.0
        said[0, a] = MISSING
    else:
        if restart or h[ARMED, a] == 0.0:
            _begin(a, c, s, h, r, u, y)
        _advance(a, c, s, h, said, v, shadow, r, u, y, turn)


def settled(
    c: FloatArray, s: FloatArray, h: FloatArray, a: int, v: FloatArray, shadow: FloatArray, e: FloatArray, extra: Any
) -> None:
    """Learn with an estimator whose P stays at P_d."""
    _learn(a, c, s, h, v, shadow, e)


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
    k = local(s, _columns, _lanes)
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
    _follow(a, c, s, h, v, shadow, e, k, float(refused))


def test(
    c: FloatArray, s: FloatArray, h: FloatArray, g: FloatArray, number: int, count: int, e: FloatArray, said: FloatArray
) -> None:
    """Add the whitened residuals to all CUSUMs of all lanes; note the largest, and when one passes its limit."""
    for a in range(_lanes):
        e[LARGEST, a] = 0.0
        e[COUNTS, a] = 1.0 if said[0, a] == USED and h[USED_UP, a] > c[_at.warm, a] else 0.0
    for j in range(count):
        for a in range(_lanes):
            _listen(a, c, s, g, e, j, count)
    for a in range(_lanes):
        if said[0, a] == USED:
            s[_to.level, a] = e[LARGEST, a]
            s[_to.peak, a] = max(s[_to.peak, a], e[LARGEST, a])
            if e[LARGEST, a] >= 1.0 and h[CROSSED, a] == 0.0:
                h[CROSSED, a] = number


def untested(
    c: FloatArray, s: FloatArray, h: FloatArray, g: FloatArray, number: int, count: int, e: FloatArray, said: FloatArray
) -> None:
    """Do without the sequential test."""


def sample(
    c: FloatArray,
    s: FloatArray,
    h: FloatArray,
    g: FloatArray,
    tile: FloatArray,
    i: int,
    number: int,
    turn: bool,
    first: bool,
    watched: int,
    v: FloatArray,
    shadow: FloatArray,
    e: FloatArray,
    said: FloatArray,
    extra: FloatArray,
) -> None:
    """Take sample i of the tile, number `number` since the start, in all lanes."""
    r, u, y, restart = i, TILE + i, 2 * TILE + i, 3 * TILE + i
    if first and watched:  # a new evaluation begins
        for a in range(_lanes):
            s[_to.peak, a] = s[_to.level, a]
            h[CROSSED, a] = h[CROSSED, a] if s[_to.level, a] >= 1.0 else 0.0
    sound = 0
    if _lanes > 1:
        for a in range(_lanes):
            whole = (abs(tile[r, a]) < ABSURD) & (abs(tile[u, a]) < ABSURD) & (abs(tile[y, a]) < ABSURD)
            sound += whole & (tile[restart, a] == 0.0) & (h[ARMED, a] != 0.0)
    if _lanes > 1 and sound == _lanes:
        for a in range(_lanes):
            _advance(a, c, s, h, said, v, shadow, tile[r, a], tile[u, a], tile[y, a], turn)
    else:
        for a in range(_lanes):
            again = tile[restart, a] != 0.0
            _enter(c, s, h, said, a, tile[r, a], tile[u, a], tile[y, a], again, turn, v, shadow)
    used = 0
    for a in range(_lanes):
        used += said[0, a] == USED
    if _lanes > 1 and used == _lanes:
        for a in range(_lanes):
            _take(c, s, h, a, v, shadow, e, extra)
    else:
        for a in range(_lanes):
            if said[0, a] == USED:
                _take(c, s, h, a, v, shadow, e, extra)
            elif said[0, a] != BETWEEN:
                _forget(a, s, h)
    if watched and used:
        _test(c, s, h, g, number, watched, e, said)


def complete(c: FloatArray, s: FloatArray, h: FloatArray, q: FloatArray) -> None:
    """Write one complete evaluation of every lane to q."""
    for a in range(_lanes):
        _evaluate(a, c, s, h, q)
    for f in range(_frequencies):
        for a in range(_lanes):
            _respond(a, c, s, f, q)


def plain(c: FloatArray, s: FloatArray, h: FloatArray, q: FloatArray) -> None:
    """Write to q, for a diagnosis, what the recursion itself knows."""
    for a in range(_lanes):
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
    watched: int,
    scratch: FloatArray,
    out: FloatArray,
    begin: int,
    end: int,
) -> None:
    """Run the blocks of lanes from `begin` to `end`: r, u, y (assets, N) lead from `state` to `new` and `out`.

    `constants` (blocks, rows times lanes) has one row if all share it, `scratch` room for the CUSUMs of one block, and
    `restart` no rows where no sample restarts.
    """
    assets, samples = r.shape
    for b in range(begin, end):
        c = laid(constants[b if _own else 0], _lanes, _own)
        g = laid(scratch, _lanes, 1)
        s = local(scratch, _floats, _lanes)
        h = local(state, HEAD, _lanes)
        tile = local(scratch, _tile, _lanes)
        v = local(scratch, _rows, _lanes)
        shadow = local(scratch, _columns, _lanes)
        e = local(scratch, 3, _lanes)
        said = local(state, 1, _lanes)
        q = local(scratch, _row, _lanes)
        lowest = HEAD + _floats + watched
        for a in range(_lanes):
            asset = min(b * _lanes + a, assets - 1)
            for i in range(HEAD):
                h[i, a] = state[asset, i]
            for i in range(_floats):
                s[i, a] = state[asset, HEAD + i]
            for i in range(watched):
                g[i, a] = state[asset, HEAD + _floats + i]
            for i in range(lowest, state.shape[1]):
                new[asset, i] = state[asset, i]
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
                        tile[3 * TILE + i, a] = 0.0
                        if restart.shape[0]:
                            tile[3 * TILE + i, a] = restart[asset, k + i]
            number += 1
            turn += 1
            _sample(
                c, s, h, g, tile, k % TILE, number, turn == stride, since == 0, watched, v, shadow, e, said, extra
            )
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
                new[asset, SAMPLE] = number
                for i in range(_floats):
                    new[asset, HEAD + i] = s[i, a]
                for i in range(watched):
                    new[asset, HEAD + _floats + i] = g[i, a]


def step(constants: FloatArray, state: FloatArray, r: float, u: float, y: float) -> bool:
    """Take one sample of one asset, in place; return whether an evaluation is due."""
    every, stride, watched = int(constants[0]), int(constants[1]), int(constants[2])
    c = laid(constants, 1, 1)
    s = local(state, _floats, 1)
    h = local(state, HEAD, 1)
    tile = local(state, _tile, 1)
    v = local(state, _rows, 1)
    shadow = local(state, _columns, 1)
    e = local(state, 3, 1)
    said = local(state, 1, 1)
    for i in range(HEAD):
        h[i, 0] = state[i]
    for i in range(_floats):
        s[i, 0] = state[HEAD + i]
    lowest = HEAD + _floats
    g = laid(state[lowest : lowest + watched], 1, 1)
    extra = state[lowest + watched : lowest + watched + _extra]
    tile[0, 0], tile[TILE, 0], tile[2 * TILE, 0], tile[3 * TILE, 0] = r, u, y, 0.0
    number = int(state[SAMPLE])
    first = number % every == 0
    number += 1
    _sample(c, s, h, g, tile, 0, number, number % stride == 0, first, watched, v, shadow, e, said, extra)
    for i in range(HEAD):
        state[i] = h[i, 0]
    state[SAMPLE] = number
    for i in range(_floats):
        state[HEAD + i] = s[i, 0]
    return number % every == 0


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
    """Write [eta, phi, z] of every sample of one asset to out (N, rows), and what `advance` says to ok (N,)."""
    c = laid(constants, 1, 1)
    s = local(constants, _floats, 1)
    h = local(constants, HEAD, 1)
    v = local(constants, _rows, 1)
    shadow = local(constants, _columns, 1)
    said = local(constants, 1, 1)
    for i in range(HEAD):
        h[i, 0] = state[i]
    for i in range(_floats):
        s[i, 0] = state[HEAD + i]
    for k in range(len(r)):
        turn = (k + 1) % stride == 0
        _enter(c, s, h, said, 0, r[k], u[k], y[k], restart[k], turn, v, shadow)
        ok[k] = said[0, 0]
        if ok[k] != MISSING:
            for i in range(_rows):
                out[k, i] = v[i, 0]


PARTS = (enter, settled, refreshed, test, untested, sample, complete, plain)  # each calls only those before it
DRIVERS = (block, step, look, regress)
