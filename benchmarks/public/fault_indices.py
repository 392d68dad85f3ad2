"""The indices of the DAMADICS benchmark, which others report: how soon, how long and how rightly a fault is shown."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import BoolArray, FloatArray


class FaultIndices(NamedTuple):
    """Indices of one fault after Bartys, Patton, Syfert, de las Heras and Quevedo (2006).

    Parameters
    ----------
    t_dt
        From the onset to the detection that lasts, in s; inf where there is none.
    r_fd
        Share of the time before the onset in which a fault is shown; NaN where there is no such time.
    r_td
        Share of the time of the fault in which one is shown.
    r_fi
        Share of the time of the fault in which another fault is named.
    r_ti
        Share of the time of the fault in which it is named.
    t_it
        From the onset to the right name that lasts, in s; inf where there is none.
    """

    t_dt: float
    r_fd: float
    r_td: float
    r_fi: float
    r_ti: float
    t_it: float


def fault_indices(
    t: npt.ArrayLike, shown: npt.ArrayLike, named: Sequence[str], fault: str, from_s: float, to_s: float = np.inf
) -> FaultIndices:
    """Return the indices of a fault that lasts from one time to another.

    Parameters
    ----------
    t
        Rising times of N decisions, in s, shape (N,); each holds until the next one, the last as long as the one
        before.
    shown
        Whether a fault is shown, shape (N,).
    named
        The fault that is named, empty for none, N of them.
    fault
        The true one.
    from_s, to_s
        When it is there; decisions after its end do not count.

    Raises
    ------
    ValueError
        If there are fewer than two decisions, or none while the fault is there.
    """
    times, alarm = np.asarray(t, dtype=np.float64), np.asarray(shown, dtype=np.bool_)
    if times.size < 2:
        raise ValueError("indices need at least two decisions")
    ends = np.append(times[1:], 2.0 * times[-1] - times[-2])
    during = _overlap(times, ends, from_s, to_s)
    if not during.sum() > 0.0:
        raise ValueError(f"no decision from {from_s:g} to {to_s:g} s, while the fault is there")
    right = np.array([name == fault for name in named], dtype=np.bool_)
    other = np.array([name not in ("", fault) for name in named], dtype=np.bool_)
    return FaultIndices(
        _lasting(times, alarm, during, from_s),
        _share(alarm, _overlap(times, ends, -np.inf, from_s)),
        _share(alarm, during),
        _share(other, during),
        _share(right, during),
        _lasting(times, right, during, from_s),
    )


def _overlap(begin: FloatArray, end: FloatArray, from_s: float, to_s: float) -> FloatArray:
    """Return how much of each interval lies within another one."""
    return np.asarray(np.maximum(np.minimum(end, to_s) - np.maximum(begin, from_s), 0.0))


def _share(on: BoolArray, duration: FloatArray) -> float:
    total = float(duration.sum())
    return float(duration[on].sum()) / total if total > 0.0 else float("nan")


def _lasting(t: FloatArray, on: BoolArray, during: FloatArray, from_s: float) -> float:
    """Return how long after the onset a decision is made that holds until the fault ends."""
    within = np.flatnonzero(during > 0.0)
    off = within[~on[within]]
    first = int(within[0]) if not off.size else int(off[-1]) + 1
    return max(float(t[first]) - from_s, 0.0) if first <= within[-1] else float("inf")
