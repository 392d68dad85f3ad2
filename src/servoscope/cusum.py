"""The sequential test: what a healthy loop would do is taken off, the rest whitened, and CUSUMs add it up.

Beside the measured loop runs a shadow: the healthy loop without noise, driven by the same reference, through the same
filters. What the measured residual has beyond the shadow's is noise, white after its own filter; a change of the
actuator adds Delta' phi to it. One CUSUM (Page, 1954) per expected change adds up the logarithm of the likelihood
ratio of "changed by Delta" against "healthy", and starts anew whenever that falls below zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from servoscope.arithmetic import dot, fma, larger, smaller
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


def whitened(c: Any, model: int, s: Any, at: int, memory: int, x: Any) -> Any:
    """Whiten one sample; s[at:] holds the filter's memory (transposed direct form II).

    c[model:] is the gain, then `memory` coefficients of the numerator and as many of the denominator, from lag 1 on.
    """
    y = x + s[at]
    for i in range(memory):
        new = fma(c[model + 1 + i], x, -(c[model + 1 + memory + i] * y))
        s[at + i] = new + s[at + i + 1] if i < memory - 1 else new
    return y * c[model]


def grown(weights: Sequence[Any], psi: Sequence[Any], e: Any, g: Any, half: Any) -> Any:
    """Return a CUSUM g, in units of its limit h, after one more whitened residual e.

    A change would shift e by m = h weights' psi, and the likelihood ratio grows by m e - m^2/2; `half` is -h/2.
    """
    shift = dot(weights, psi)
    return smaller(larger(fma(shift, fma(shift, half, e), g), 0.0), CAP)
