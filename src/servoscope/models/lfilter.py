"""Rational filters over whole signals, compiled: what SciPy's `lfilter` does, without half a second of importing it."""

from __future__ import annotations

from typing import Any

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.jit.array_function import ArrayFunction


def lfilter(
    numerator: FloatArray, denominator: FloatArray, x: FloatArray, state: FloatArray | None = None
) -> FloatArray:
    """Return a signal (N,), or columns (N, m), behind a filter, from rest (transposed direct form II).

    `numerator, denominator`: coefficients from lag 0 on, that of the denominator 1; `state`: what it goes on from,
    shape (m, order + 1), which is changed.
    """
    signals = np.ascontiguousarray(x, dtype=np.float64)
    columns = signals[:, None] if signals.ndim == 1 else signals
    order = max(len(numerator), len(denominator)) - 1
    b, a = (np.pad(np.asarray(c, dtype=np.float64), (0, order + 1 - len(c))) for c in (numerator, denominator))
    out = np.empty_like(columns)
    z = np.zeros((columns.shape[1], order + 1)) if state is None else state
    _lfilter_loop(b, a, columns, z, out)
    return out.reshape(signals.shape)


@ArrayFunction
def _lfilter_loop(printer: Any, b: Any, a: Any, x: Any, z: Any, out: Any) -> None:
    """Write what leaves the filter; z (m, order + 1) is its state, whose last one stays zero."""
    for m in printer.loop(0, x.shape[1]):
        for k in printer.loop(0, x.shape[0]):
            y = b[0] * x[k, m] + z[m, 0]
            for i in printer.loop(0, b.shape[0] - 1):
                z[m, i] = b[i + 1] * x[k, m] + z[m, i + 1] - a[i + 1] * y
            out[k, m] = y
