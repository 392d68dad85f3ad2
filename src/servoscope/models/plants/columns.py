"""Columns of the regression beyond the powers of s: friction, a constant, sines of the position."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from typing import Any

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.jit import fma, maximum, minimum, sine, where


class Column(StrEnum):
    """A function of y and y'; those of `SHAPED_COLUMNS` have a factor and a phase (`Plant.column_shapes`)."""

    SIGN = "sign_v"  # sign(y')
    FORWARD = "forward_v"  # max(y', 0)
    BACKWARD = "backward_v"  # min(y', 0)
    CONSTANT = "one"
    STRIBECK = "stribeck_v"  # sign(y')/(1 + (factor y')^2)
    SINE = "sin_y"  # sin(factor y + phase)
    COGGING_SIN = "cogging_sin"  # the same
    COGGING_COS = "cogging_cos"  # the same
    LOAD = "load_v"  # |sin(factor y + phase)| sign(y')


SHAPED_COLUMNS = frozenset({Column.STRIBECK, Column.SINE, Column.COGGING_SIN, Column.COGGING_COS, Column.LOAD})


def trace_column(
    column: Column, y: Any, speed: Any, dead_speed: Callable[[], Any], factor: Any = 1.0, phase: Any = 0.0
) -> Any:
    """Return a column of one sample, of numbers or of symbols (see `core.jit`).

    `dead_speed` is the speed up to which the sign of y' is 0: a function, so that no code reads it in vain.
    """
    match column:
        case Column.SIGN:
            return _sign(speed, dead_speed())
        case Column.FORWARD:
            return maximum(speed, 0.0)
        case Column.BACKWARD:
            return minimum(speed, 0.0)
        case Column.CONSTANT:
            return 1.0
        case Column.STRIBECK:
            slow = factor * speed
            return _sign(speed, dead_speed()) / fma(slow, slow, 1.0)
        case Column.LOAD:
            return _sign(speed, dead_speed()) * abs(sine(fma(factor, y, phase)))
    return sine(fma(factor, y, phase))


def _sign(speed: Any, dead_speed: Any) -> Any:
    return where(abs(speed) <= dead_speed, 0.0, where(speed > 0.0, 1.0, -1.0))


def column_values(column: Column, y: FloatArray, v: FloatArray, factor: float, phase: float) -> FloatArray:
    """Return a column of N samples of y and y', shape (N,); `v` is 0 where its sign is not trusted."""
    match column:
        case Column.SIGN:
            return np.sign(v)
        case Column.FORWARD:
            return np.maximum(v, 0.0)
        case Column.BACKWARD:
            return np.minimum(v, 0.0)
        case Column.CONSTANT:
            return np.ones_like(y)
        case Column.STRIBECK:
            return np.asarray(np.sign(v) / (1.0 + (factor * v) ** 2))
        case Column.LOAD:
            return np.asarray(np.abs(np.sin(factor * y + phase)) * np.sign(v))
    return np.sin(factor * y + phase)
