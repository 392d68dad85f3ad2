"""Types of arrays, and a choice of their rows."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Int32Array = npt.NDArray[np.int32]
FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]
ComplexArray = npt.NDArray[np.complex128]
IndexArray = npt.NDArray[np.intp]


def select_rows(x: FloatArray, mask: BoolArray) -> FloatArray:
    """Return the rows (M,) of x (N,) where the mask (N,) is set; x itself where it is set everywhere, not a copy."""
    return x if mask.all() else x[mask]


def to_tuples(x: FloatArray) -> Any:
    """Return an array as nested tuples of numbers, which frozen records hold."""
    return tuple(map(to_tuples, x)) if x.ndim else float(x)
