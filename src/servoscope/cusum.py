"""The sequential test, compiled: what a healthy loop would do is taken off, the rest whitened, and CUSUMs add it up.

Beside the measured loop runs a shadow: the healthy loop without noise, driven by the same reference, through the same
filters. What the measured residual has beyond the shadow's is noise, white after its own filter; a change of the
actuator adds Delta' phi to it. One CUSUM (Page, 1954) per expected change adds up the logarithm of the likelihood
ratio of "changed by Delta" against "healthy", and starts anew whenever that falls below zero.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servoscope.compiled import kernel
from servoscope.noise import Coloured
from servoscope.plants import FloatArray

CLIP = 4.0  # standard deviations that one sample may contribute: a spike alone raises no alarm
CAP = 2.0  # limits that a CUSUM may reach: a repaired actuator is not held for ill much longer than it was
LINGER = 0.05  # what may be left of the whitening filter's start before its output counts
LONGEST_WARMUP = 1000  # updates
LAGS = 2  # delayed copies of the last column: with them, changes between samples are told from others


class Watch(NamedTuple):
    """Constants of the sequential test; without members there is none.

    ``A, B, C, D, X0`` are the shadow, r -> [eta, phi]; `theta` the coefficients that the residual is formed with;
    `numerator` and `denominator` the whitening filter, both of one length, first element 1, and `gain` its factor;
    `warm` the updates that it needs; `changes` (members, n + `LAGS`) the weights of the columns and `limits`
    (members,) where a CUSUM alarms. Scaled as `servoscope.recursion.Constants`.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    X0: FloatArray
    theta: FloatArray
    numerator: FloatArray
    denominator: FloatArray
    gain: float
    warm: int
    changes: FloatArray
    limits: FloatArray

    @property
    def size(self) -> int:
        """Numbers that the test keeps from sample to sample."""
        memory = len(self.numerator) - 1
        n = len(self.theta)
        return len(self.A) + (n + 1) * memory + n + LAGS + len(self.limits) if len(self.limits) else 0


def idle(n: int) -> Watch:
    """Return the constants of no test, for n coefficients."""
    none, one = np.zeros((0, 0)), np.ones(2)
    return Watch(
        none, np.zeros((0, 1)), none, none, none, np.zeros(n), one, one, 1.0, 0, np.zeros((0, n + LAGS)), np.zeros(0)
    )


def whitening(noise: Coloured) -> tuple[FloatArray, FloatArray, float, int]:
    """Return numerator, denominator, gain and warm-up of the filter that whitens a noise."""
    length = max(len(noise.a), len(noise.b)) + 1
    numerator, denominator = (np.pad(each, (0, length - len(each))) for each in noise.polynomials)
    slowest = float(np.abs(np.roots(denominator)).max(initial=0.0)) if len(noise.b) else 0.0
    warm = LONGEST_WARMUP
    if slowest < 1.0:
        warm = min(int(np.log(LINGER) / np.log(max(slowest, 0.1))), LONGEST_WARMUP) + length
    return numerator, denominator, 1.0 / float(np.sqrt(noise.variance)), warm


def columns(phi: FloatArray) -> FloatArray:
    """Return whitened columns (N, n) with `LAGS` delayed copies of the last beside them, shape (N, n + LAGS)."""
    late = [np.concatenate([np.zeros(lag), phi[:, -1]])[: len(phi)] for lag in range(1, LAGS + 1)]
    return np.column_stack([phi, *late])


@kernel
def follow(watch: Watch, x: FloatArray, r: float, arm: bool, out: FloatArray) -> None:
    """Let the shadow follow the reference for one sample; `out` (1 + n,) becomes its [eta, phi]."""
    nx = watch.A.shape[0]
    if arm:
        for i in range(nx):
            x[i] = watch.X0[i, 0] * r
    for i in range(len(out)):
        out[i] = watch.D[i, 0] * r
        for j in range(nx):
            out[i] += watch.C[i, j] * x[j]
    new = np.empty(nx)
    for i in range(nx):
        new[i] = watch.B[i, 0] * r
        for j in range(nx):
            new[i] += watch.A[i, j] * x[j]
    for i in range(nx):
        x[i] = new[i]


@kernel
def _white(watch: Watch, d: FloatArray, x: float) -> float:
    """Whiten one sample; d holds the filter's memory (transposed direct form II)."""
    y = x + d[0]
    last = len(d) - 1
    for i in range(last):
        d[i] = watch.numerator[i + 1] * x - watch.denominator[i + 1] * y + d[i + 1]
    d[last] = watch.numerator[last + 1] * x - watch.denominator[last + 1] * y
    white: float = y * watch.gain
    return white


@kernel
def accumulate(watch: Watch, s: FloatArray, eta: float, phi: FloatArray, shadow: FloatArray, used: float) -> float:
    """Take one update into the CUSUMs; return the largest of them, as a multiple of its limit.

    `s` is the filters' memory, the whitened columns and the CUSUMs, `shadow` what `follow` wrote, `used` the updates
    since the last interruption.
    """
    n = len(watch.theta)
    memory = len(watch.numerator) - 1
    filters = (n + 1) * memory
    psi = s[filters : filters + n + LAGS]
    for lag in range(LAGS, 0, -1):
        psi[n - 1 + lag] = psi[n - 2 + lag]
    residual = eta - shadow[0]
    for i in range(n):
        residual -= watch.theta[i] * (phi[i] - shadow[1 + i])
        psi[i] = _white(watch, s[(i + 1) * memory : (i + 2) * memory], shadow[1 + i])
    e = _white(watch, s[:memory], residual)
    e = min(max(e, -CLIP), CLIP)
    g = s[filters + n + LAGS :]
    largest = 0.0
    for j in range(len(watch.limits)):
        if used > watch.warm:
            shift = 0.0
            for i in range(n + LAGS):
                shift += watch.changes[j, i] * psi[i]
            g[j] = min(max(g[j] + shift * (e - 0.5 * shift), 0.0), CAP * watch.limits[j])
        largest = max(largest, g[j] / watch.limits[j])
    return largest
