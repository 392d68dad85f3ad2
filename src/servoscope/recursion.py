"""The compiled heart: constant arrays, state and a block of samples -> new state and evaluations.

One sample, a log and a fleet run through the same `block`. The state of an asset is one row of floats; `Layout` says
what stands where. Splitting a recording anywhere changes nothing, because everything that is carried from sample to
sample stands in that row.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from servoscope import cusum, estimators, propagation
from servoscope.compiled import around, kernel
from servoscope.cusum import LAGS, Watch, accumulate, follow
from servoscope.plants import FloatArray
from servoscope.propagation import spread

IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

# counters at the head of the state row
ARMED, WAIT, SAMPLE, UPDATES, SKIPPED, POWER, STILL, DRIFT, USED_UP, LEVEL, PEAK, CROSSED = range(12)
HEAD = 12
ABSURD = 1e100  # no physical signal; its square would overflow and stay in the state for ever
# what `sense` says of a sample
MISSING, HELD, USED, BETWEEN = -1, 0, 1, 2


class Constants(NamedTuple):
    """Everything that a loop and a baseline say, as arrays (scaled: phi / scale, theta * scale).

    ``A, B, C, D, X0`` are the filter bank and its steady state per unit input, ``vA ... vX0`` the velocity filter,
    `codes` the non-linear inputs, `limits` and `deadzone` of u; `weights` and `heads` are the noise's model as
    `servoscope.propagation.spread` takes it, `lags` of them the autoregression's (heads[0] is its variance), in
    updates: of every `stride`-th sample; `extra` is the size of the estimator's private state, and `watch` is the
    sequential test.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    X0: FloatArray
    vA: FloatArray
    vB: FloatArray
    vC: FloatArray
    vD: FloatArray
    vX0: FloatArray
    v_of_r: bool
    codes: IntArray
    limits: FloatArray
    deadzone: FloatArray
    sign_speed: float
    rest_speed: float
    still_speed: float
    only_moving: bool
    wait: int
    stride: int
    every: int
    theta: FloatArray
    P_d: FloatArray
    R: float
    weights: FloatArray
    heads: FloatArray
    lags: int
    memory: float
    extra: int
    watch: Watch


class Layout:
    """Where things stand in the state row of one asset, and in a row of evaluations.

    Parameters
    ----------
    c
        The constants, which fix the sizes.
    """

    def __init__(self, c: Constants) -> None:
        nx, nv, n, p = len(c.A), len(c.vA), len(c.theta), len(c.weights)
        self.n = n
        sizes = {
            "head": HEAD,
            "x": nx,
            "xv": nv,
            "theta": n,
            "P": n * n,
            "S": n * n,
            "M": n * p,
            "Psi": n * n,
            "extra": c.extra,
            "watch": c.watch.size,
        }
        ends = np.cumsum(list(sizes.values()))
        self.slices = {
            name: slice(int(end) - size, int(end)) for (name, size), end in zip(sizes.items(), ends, strict=True)
        }
        self.size = int(ends[-1])
        self.row = 5 + n + 2 * n * n  # counters, sequential test, theta, S, Psi

    def start(self, c: Constants, assets: int) -> FloatArray:
        """Return the state before the first sample, shape (assets, size): theta at the baseline, P = P_d."""
        state = np.zeros((assets, self.size))
        state[:, self.slices["theta"]] = c.theta
        state[:, self.slices["P"]] = c.P_d.ravel()
        state[:, self.slices["Psi"]] = np.eye(self.n).ravel()
        state[:, POWER] = c.heads[0]
        return state


@kernel
def sense(
    c: Constants,
    s: FloatArray,
    w: FloatArray,
    v_out: FloatArray,
    r: float,
    u: float,
    y: float,
    restart: bool,
) -> int:
    """Pass one sample through the filter bank; v_out becomes [eta, phi, z].

    Returns `USED` when the sample may update the estimator, `HELD` when the filters settle, the axis rests or u is
    dead, `BETWEEN` when the stride leaves it out, and `MISSING` for a NaN: then only the demand to re-arm stays.
    """
    s[SAMPLE] += 1.0
    if not (abs(r) < ABSURD and abs(u) < ABSURD and abs(y) < ABSURD):  # NaN is not below anything either
        s[ARMED] = 0.0
        return MISSING
    nx = c.A.shape[0]
    nv = c.vA.shape[0]
    x = s[HEAD : HEAD + nx]
    xv = s[HEAD + nx : HEAD + nx + nv]
    arm = restart or s[ARMED] == 0.0
    source = r if c.v_of_r else y
    if arm:
        for i in range(nv):
            xv[i] = c.vX0[i, 0] * source
    v = c.vD[0, 0] * source
    for i in range(nv):
        v += c.vC[0, i] * xv[i]
    t0 = c.vA[0, 0] * xv[0] + c.vA[0, 1] * xv[1] + c.vB[0, 0] * source
    xv[1] = c.vA[1, 0] * xv[0] + c.vA[1, 1] * xv[1] + c.vB[1, 0] * source
    xv[0] = t0
    w[0] = r
    w[1] = min(max(u, c.limits[0]), c.limits[1])
    w[2] = y
    for i in range(len(c.codes)):
        if c.codes[i] == 0:
            w[3 + i] = 0.0 if abs(v) <= c.sign_speed else (1.0 if v > 0.0 else -1.0)
        elif c.codes[i] == 1:
            w[3 + i] = max(v, 0.0)
        elif c.codes[i] == 2:
            w[3 + i] = min(v, 0.0)
        else:
            w[3 + i] = 1.0
    nw = len(w)
    if arm:
        s[ARMED] = 1.0
        s[WAIT] = c.wait
        for i in range(nx):
            x[i] = 0.0
            for j in range(nw):
                x[i] += c.X0[i, j] * w[j]
    for i in range(len(v_out)):
        v_out[i] = 0.0
        for j in range(nw):
            v_out[i] += c.D[i, j] * w[j]
        for j in range(nx):
            v_out[i] += c.C[i, j] * x[j]
    new = np.empty(nx)
    for i in range(nx):
        new[i] = 0.0
        for j in range(nw):
            new[i] += c.B[i, j] * w[j]
        for j in range(nx):
            new[i] += c.A[i, j] * x[j]
    for i in range(nx):
        x[i] = new[i]
    # a reversal is short; an axis that has stood longer than the filters remember is at rest
    s[DRIFT] += (v - s[DRIFT]) / c.wait  # the speed without its noise
    s[STILL] = s[STILL] + 1.0 if abs(s[DRIFT]) < c.still_speed else 0.0
    at_rest = s[STILL] > c.wait
    if at_rest or (c.only_moving and (abs(v) <= c.rest_speed or (c.deadzone[0] <= w[1] <= c.deadzone[1]))):
        # what enters the filters now has nothing to do with the motion: wait until they have forgotten it
        s[WAIT] = c.wait
        return HELD
    if s[WAIT] > 0.0:
        s[WAIT] -= 1.0
        return HELD
    if c.stride > 1 and s[SAMPLE] % c.stride != 0.0:
        return BETWEEN
    return USED


def _update(*_: Any) -> int:  # the template's placeholder: `block` is built with an estimator in its place
    return 0


def _block(
    c: Constants,
    state: FloatArray,
    r: FloatArray,
    u: FloatArray,
    y: FloatArray,
    restart: BoolArray,
    out: FloatArray,
) -> int:
    nx = c.A.shape[0]
    nv = c.vA.shape[0]
    n = len(c.theta)
    p = len(c.weights)
    assets, samples = r.shape
    w = np.empty(c.B.shape[1])
    v_out = np.empty(c.C.shape[0])
    K = np.empty(n)
    watched = len(c.watch.limits) > 0
    nxs = c.watch.A.shape[0]
    shadow = np.empty(1 + n)
    row = 0
    for asset in range(assets):
        s = state[asset]
        o = HEAD + nx + nv
        theta = s[o : o + n]
        P = s[o + n : o + n + n * n].reshape((n, n))
        o += n + n * n
        S = s[o : o + n * n].reshape((n, n))
        M = s[o + n * n : o + n * n + n * p].reshape((n, p))
        o += n * n + n * p
        Psi = s[o : o + n * n].reshape((n, n))
        extra = s[o + n * n : o + n * n + c.extra]
        xs = s[o + n * n + c.extra : o + n * n + c.extra + nxs]
        o += n * n + c.extra + nxs
        filters = (n + 1) * (len(c.watch.numerator) - 1) + n + LAGS
        test = s[o : o + filters + len(c.watch.limits)]
        phi = v_out[1 : 1 + n]
        z = v_out[len(v_out) - n :]
        row = 0
        for k in range(samples):
            arm = restart[asset, k] or s[ARMED] == 0.0
            if s[SAMPLE] % c.every == 0.0:  # a new evaluation begins
                s[PEAK] = s[LEVEL]
                if s[LEVEL] < 1.0:
                    s[CROSSED] = 0.0
            ok = sense(c, s, w, v_out, r[asset, k], u[asset, k], y[asset, k], restart[asset, k])
            if watched and ok != MISSING:
                follow(c.watch, xs, r[asset, k], arm, shadow)
            if ok == USED:
                if watched:
                    s[USED_UP] += 1.0
                    s[LEVEL] = accumulate(c.watch, test, v_out[0], phi, shadow, s[USED_UP])
                    s[PEAK] = max(s[PEAK], s[LEVEL])
                    if s[LEVEL] >= 1.0 and s[CROSSED] == 0.0:
                        s[CROSSED] = s[SAMPLE]
                e = v_out[0]
                for i in range(n):
                    e -= phi[i] * theta[i]
                if _update(theta, P, c.P_d, c.R, c.memory, v_out[0], phi, z, K, extra) == 0:
                    s[UPDATES] += 1.0
                    s[POWER] += (e * e - s[POWER]) / c.memory
                else:
                    s[SKIPPED] += 1.0
                spread(c.weights, c.heads, c.lags, K, phi, S, M, Psi)
            elif ok != BETWEEN:
                for i in range(n):  # after a gap or a rest the noise is new
                    for j in range(p):
                        M[i, j] = 0.0
                if watched:
                    s[USED_UP] = 0.0
                    for i in range(filters):
                        test[i] = 0.0
            if s[SAMPLE] % c.every == 0.0:
                q = out[asset, row]
                q[0] = s[UPDATES]
                q[1] = s[SKIPPED]
                q[2] = s[POWER]
                q[3] = s[PEAK]
                q[4] = s[CROSSED]
                for i in range(n):
                    q[5 + i] = theta[i]
                    for j in range(n):
                        q[5 + n + i * n + j] = S[i, j]
                        q[5 + n + n * n + i * n + j] = Psi[i, j]
                row += 1
    return row


@kernel
def regressors(
    c: Constants,
    state: FloatArray,
    r: FloatArray,
    u: FloatArray,
    y: FloatArray,
    restart: BoolArray,
    out: FloatArray,
    ok: IntArray,
) -> None:
    """Write [eta, phi, z] of every sample of one asset to `out` (N, 1 + n [+ n]) and what `sense` says to `ok` (N,)."""
    w = np.empty(c.B.shape[1])
    for k in range(len(r)):
        ok[k] = sense(c, state, w, out[k], r[k], u[k], y[k], restart[k])


@functools.cache
def block(estimator: str) -> Callable[..., int]:
    """Compile the block function around one estimator.

    The signature is ``block(c, state, r, u, y, restart, out) -> rows``; r, u, y, restart have shape
    (assets, samples), `state` is changed in place, and `out` (assets, rows, `Layout.row`) receives an evaluation
    every ``c.every`` samples.
    """
    return around(estimators.load(estimator), _block, [propagation, cusum])
