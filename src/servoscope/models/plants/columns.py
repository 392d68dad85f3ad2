"""Columns of the regression beyond the powers of s: friction, a constant, sines of the position, loads of a valve."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.jit import fma, maximum, minimum, sine, where


class Column(StrEnum):
    """A function of y and y'; `COLUMN_FORMS` has its arithmetic."""

    SIGN = "sign_v"  # sign(y')
    FORWARD = "forward_v"  # max(y', 0)
    BACKWARD = "backward_v"  # min(y', 0)
    CONSTANT = "one"
    STRIBECK = "stribeck_v"  # sign(y')/(1 + (factor y')^2)
    SINE = "sin_y"  # sin(factor y + phase)
    COGGING_SIN = "cogging_sin"  # the same
    COGGING_COS = "cogging_cos"  # the same
    LOAD = "load_v"  # |sin(factor y + phase)| sign(y')
    SPEED_POSITION = "abs_v_y"  # |y'| y
    SPEED_BEYOND = "abs_v_beyond"  # |y'| where y is beyond the factor, 0 elsewhere
    SPEED_SQUARED = "v_abs_v"  # y' |y'|


# what a coefficient has besides the unit of u, where it is not that of u
COLUMN_UNITS = {
    **dict.fromkeys((Column.FORWARD, Column.BACKWARD, Column.SPEED_BEYOND), " s/y"),
    Column.SPEED_POSITION: " s/y²",
    Column.SPEED_SQUARED: " s²/y²",
}


class ColumnForm(NamedTuple):
    """The arithmetic of a column, once for each of those who compute it.

    `trace` takes y, y' and a function that returns the speed up to which the sign of y' is 0, of one sample: numbers,
    or symbols that become code (see `core.jit`). `values` takes y and y' of N samples; y' is 0 where its sign is not
    trusted. Both take the factor and the phase of `Plant.column_shapes` too where the column is `shaped`.
    """

    trace: Callable[..., Any]
    values: Callable[..., FloatArray]
    shaped: bool = False


def _sign(speed: Any, dead_speed: Callable[[], Any]) -> Any:
    return where(abs(speed) <= dead_speed(), 0.0, where(speed > 0.0, 1.0, -1.0))


_WAVE = ColumnForm(lambda y, v, dead, a, b: sine(fma(a, y, b)), lambda y, v, a, b: np.sin(a * y + b), True)
COLUMN_FORMS = {
    Column.SIGN: ColumnForm(lambda y, v, dead: _sign(v, dead), lambda y, v: np.sign(v)),
    Column.FORWARD: ColumnForm(lambda y, v, dead: maximum(v, 0.0), lambda y, v: np.maximum(v, 0.0)),
    Column.BACKWARD: ColumnForm(lambda y, v, dead: minimum(v, 0.0), lambda y, v: np.minimum(v, 0.0)),
    Column.CONSTANT: ColumnForm(lambda y, v, dead: 1.0, lambda y, v: np.ones_like(y)),
    Column.STRIBECK: ColumnForm(
        lambda y, v, dead, a, b: _sign(v, dead) / fma(a * v, a * v, 1.0),
        lambda y, v, a, b: np.sign(v) / (1.0 + (a * v) ** 2),
        True,
    ),
    Column.SINE: _WAVE,
    Column.COGGING_SIN: _WAVE,
    Column.COGGING_COS: _WAVE,
    Column.LOAD: ColumnForm(
        lambda y, v, dead, a, b: _sign(v, dead) * abs(sine(fma(a, y, b))),
        lambda y, v, a, b: np.abs(np.sin(a * y + b)) * np.sign(v),
        True,
    ),
    Column.SPEED_POSITION: ColumnForm(lambda y, v, dead: abs(v) * y, lambda y, v: np.abs(v) * y),
    Column.SPEED_BEYOND: ColumnForm(
        lambda y, v, dead, a, b: where(y > a, abs(v), 0.0),
        lambda y, v, a, b: np.where(y > a, np.abs(v), 0.0),
        True,
    ),
    Column.SPEED_SQUARED: ColumnForm(lambda y, v, dead: abs(v) * v, lambda y, v: np.abs(v) * v),
}
