"""A continuous plant between two samples: exact transition for a held or ramped input that arrives late."""

from __future__ import annotations

import functools
from typing import Literal, NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.models.plants import StateSpace

MatrixRows = tuple[tuple[float, ...], ...]
_WHOLE_TOLERANCE = 1e-9  # a delay this close to a whole number of samples [samples] is one


class DiscretePlant(NamedTuple):
    """One sample of a linear plant.

    ::

        x(k+1) = A x(k) + b_next u(k-m+1) + b_now u(k-m) + b_late u(k-m-1),   y = c x

    ``b_next`` is zero for a held input, ``b_late`` for a delay of whole samples.
    """

    A: FloatArray
    b_next: FloatArray
    b_now: FloatArray
    b_late: FloatArray
    c: FloatArray
    delay_samples: int


def split_delay(delay: float, sample_rate: float) -> tuple[int, float]:
    """Split a delay [s] into whole samples and the rest, 0 <= rest < 1 sample."""
    samples = delay * sample_rate
    whole = int(np.floor(samples + _WHOLE_TOLERANCE))
    fraction = samples - whole
    return whole, fraction if fraction > _WHOLE_TOLERANCE else 0.0


def discretise(
    system: StateSpace, sample_rate: float, *, hold: Literal["zoh", "foh"] = "zoh", delay: float = 0.0
) -> DiscretePlant:
    """Return the exact discrete plant for an input that is held (zoh) or runs in straight lines (foh).

    `system`: a (n, n), B (n, 1), C (1, n) of the continuous plant; `sample_rate`: samples per second [Hz]; `hold`:
    what the input does between samples; `delay`: time [s] from u to the plant; any fraction of a sample.
    """
    return _discretise_cached(*(tuple(map(tuple, matrix.tolist())) for matrix in system), sample_rate, hold, delay)


@functools.lru_cache(maxsize=64)  # while signatures are drawn, the healthy plant comes back with every point
def _discretise_cached(
    a: MatrixRows, b: MatrixRows, c: MatrixRows, sample_rate: float, hold: str, delay: float
) -> DiscretePlant:
    A, B, C = (np.array(matrix) for matrix in (a, b, c))
    return discretise_uncached((A, B, C), sample_rate, hold, delay)


def discretise_uncached(system: StateSpace, sample_rate: float, hold: str, delay: float) -> DiscretePlant:
    """Do as `discretise`, without looking whether this plant was seen before: a search never meets one again."""
    A, B, C = system
    T = 1.0 / sample_rate
    m, fraction = split_delay(delay, sample_rate)
    Phi, level, slope = transition(A, B, (1.0 - fraction) * T)
    late = np.zeros_like(level)
    if hold == "zoh":
        ahead, now = np.zeros_like(level), level
    else:
        ahead, now = slope / T, level - slope / T
    if fraction > 0.0:
        first, level_first, slope_first = transition(A, B, fraction * T)
        if hold == "zoh":
            late = Phi @ level_first
        else:
            # The sample begins a share (1 - rest) of the way from u(k-m-1) to u(k-m).
            now = now + Phi @ ((1.0 - fraction) * level_first + slope_first / T)
            late = Phi @ (fraction * level_first - slope_first / T)
        Phi = Phi @ first
    return DiscretePlant(Phi, ahead, now, late, C[0], m)


def transition(A: FloatArray, B: FloatArray, duration: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return exp(A t) (n, n) and the responses (n,) to a unit step and a unit ramp of the input over t [s].

    The matrix is balanced first: pressures beside displacements spread its entries over 13 decades, and the
    exponential of the unbalanced one would lose half of its digits (Van Loan 1978 for the augmented form). Complex
    matrices of complex-step derivatives are taken as they are.
    """
    from scipy.linalg import expm
    from scipy.linalg.lapack import dgebal  # `matrix_balance` around it takes as long as all the rest

    n = A.shape[0]
    scale = dgebal(A.real, scale=1, permute=0)[3]
    block = np.zeros((n + 2, n + 2), dtype=np.result_type(A, B))
    block[:n, :n] = A * scale / scale[:, None]
    unit = max(float(np.max(np.abs(B[:, 0] / scale))), np.finfo(np.float64).tiny)
    block[:n, n] = B[:, 0] / scale / unit
    # In units of the duration the chain of integrators is of order one whatever the sample rate.
    block[:n] *= duration
    block[n, n + 1] = 1.0
    result = np.asarray(expm(block))
    Phi = result[:n, :n] * scale[:, None] / scale
    level, slope = (result[:n, n + i] * scale * unit for i in (0, 1))
    return Phi, level, slope * duration
