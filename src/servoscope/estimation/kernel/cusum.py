"""The sequential test: the residual of a simulated healthy loop is subtracted, the rest whitened and tested by CUSUMs.

Beside the measured loop runs a shadow: the healthy loop without noise, driven by the same reference, through the same
filters. The measured residual minus the shadow's is noise, white after a filter of its own; a change of the
actuator adds Delta' phi to it. One CUSUM (Page, 1954) per expected change adds up the logarithm of the likelihood
ratio of "changed by Delta" against "healthy", and starts anew whenever that falls below zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.jit import dot, fma, maximum, minimum
from servoscope.estimation.noise_model import ArmaNoise
from servoscope.models.lti import LinearSystem, tapped_delay_line

CLIP = 4.0  # standard deviations that one sample may contribute: a spike alone raises no alarm
CAP = 2.0  # largest CUSUM, in limits: it falls soon after an actuator is repaired
WARMUP_REMAINDER = 0.05  # share of the whitening filter's transient below which its output counts
MAX_WARMUP = 1000  # updates
LAGS = 2  # delayed copies of the last column, for changes that come between samples


class CusumConstants(NamedTuple):
    """Constants of the sequential test; without members there is none.

    `shadow` leads from r to [residual, phi]; `theta` the coefficients that the residual is formed with;
    `numerator` and `denominator` the whitening filter, both of one length, first element 1, and `gain` its factor;
    `warm` the updates that it needs; `changes` (members, n + `LAGS`) the weights of the columns and `limits`
    (members,) where a CUSUM alarms. With `directions` (q, n + `LAGS`), whose combinations the changes are, CUSUMs step
    once per evaluation, with what its updates sum up to, and the shadow's columns are those of the directions, white;
    without, at each update. Scaled as `estimation.recursion.RecursionConstants`.
    """

    shadow: LinearSystem
    theta: FloatArray
    numerator: FloatArray
    denominator: FloatArray
    gain: float
    warm: int
    changes: FloatArray
    limits: FloatArray
    directions: FloatArray = np.zeros((0, 0))


def whitening_filter(noise: ArmaNoise) -> tuple[FloatArray, FloatArray, float, int]:
    """Return numerator, denominator, gain and warm-up of the filter that whitens a noise."""
    length = max(len(noise.a), len(noise.b)) + 1
    numerator, denominator = (np.pad(polynomial, (0, length - len(polynomial))) for polynomial in noise.polynomials)
    slowest = float(np.abs(np.roots(denominator)).max(initial=0.0)) if len(noise.b) else 0.0
    warm = MAX_WARMUP
    if slowest < 1.0:
        warm = min(int(np.log(WARMUP_REMAINDER) / np.log(max(slowest, 0.1))), MAX_WARMUP) + length
    return numerator, denominator, 1.0 / float(np.sqrt(noise.variance)), warm


def lagged_columns(phi: FloatArray) -> FloatArray:
    """Return whitened columns (N, n) with `LAGS` delayed copies of the last beside them, shape (N, n + LAGS)."""
    late = [np.concatenate([np.zeros(lag), phi[:, -1]])[: len(phi)] for lag in range(1, LAGS + 1)]
    return np.column_stack([phi, *late])


def lagged_directions(directions: FloatArray, stride: int) -> LinearSystem:
    """Return columns -> combinations of them and of delayed copies of the last, whose updates are `stride` apart."""
    n = directions.shape[1] - LAGS
    late = np.zeros((len(directions), LAGS * stride + 1))
    late[:, ::stride] = directions[:, n - 1 :]
    delays = tapped_delay_line(late)
    return LinearSystem(
        delays.A, delays.B @ np.eye(1, n, n - 1), delays.C, np.hstack([directions[:, : n - 1], delays.D])
    )


def direction_shares(changes: FloatArray, directions: FloatArray) -> FloatArray:
    """Return the share of each direction in each change, shape (members, q)."""
    return np.asarray(np.linalg.lstsq(directions.T, changes.T, rcond=None)[0].T)


def whiten_sample(c: Any, model: int, s: Any, at: int, memory: int, x: Any) -> Any:
    """Whiten one sample; s[at:] holds the filter's memory (transposed direct form II).

    c[model:] is the gain, then `memory` coefficients of the numerator and as many of the denominator, from lag 1 on.
    """
    y = x + s[at]
    for i in range(memory):
        new = fma(c[model + 1 + i], x, -(c[model + 1 + memory + i] * y))
        s[at + i] = new + s[at + i + 1] if i < memory - 1 else new
    return y * c[model]


def evaluation_weights(changes: FloatArray, directions: FloatArray, limits: FloatArray) -> FloatArray:
    """Return by how much each sum of `accumulate_sums` moves each CUSUM in units of its limit, (sums, members)."""
    shares = direction_shares(changes, directions).T
    rows, columns = np.tril_indices(len(directions))
    squares = np.where(rows == columns, -0.5, -1.0)[:, None] * shares[rows] * shares[columns]
    return np.vstack([shares, squares]) / limits


def accumulate_sums(s: Any, at: int, psi: Sequence[Any], e: Any) -> None:
    """Add psi e, and the products of psi among themselves, to the sums s[at:]: they make up any likelihood ratio.

    Over several updates the logarithm is the sum of m e - m^2/2 with m = weights' psi, linear in psi e and psi psi'.
    """
    factors = [(regressor, e) for regressor in psi] + [
        (regressor, other) for i, regressor in enumerate(psi) for other in psi[: i + 1]
    ]
    for k, (factor, other) in enumerate(factors):
        s[at + k] = fma(factor, other, s[at + k])


def update_cusum(weights: Sequence[Any], psi: Sequence[Any], e: Any, g: Any, half: Any) -> Any:
    """Return a CUSUM g, in units of its limit h, after one more whitened residual e.

    A change would shift e by m = h weights' psi, and the likelihood ratio grows by m e - m^2/2; `half` is -h/2.
    """
    shift = dot(weights, psi)
    return minimum(maximum(fma(shift, fma(shift, half, e), g), 0.0), CAP)


def update_cusum_by_sums(weights: Sequence[Any], sums: Sequence[Any], g: Any) -> Any:
    """Return a CUSUM g, in units of its limit, after the updates that the sums were taken over."""
    for weight, addend in zip(weights, sums, strict=True):
        g = fma(weight, addend, g)
    return minimum(maximum(g, 0.0), CAP)
