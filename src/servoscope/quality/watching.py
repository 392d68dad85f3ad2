"""Data quality of an endless stream, block by block: a small state, carried along; exact under any blocking."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.errors import RecordingError, StateError
from servoscope.quality.findings import KINDS, Finding
from servoscope.quality.settings import Limits
from servoscope.quality.state import LAYOUT, SIZE, VERSION

__all__ = ["examine", "init", "listen", "standing", "tick"]

FloatArray = npt.NDArray[np.float64]

SILENT = KINDS.index("silent")
BUFFER = 64  # findings that the compiled loop tells at a time


def init() -> FloatArray:
    """Return the state before the first sample, shape (size,): finite numbers, so that JSON can carry it too."""
    state = np.zeros(SIZE)
    named = _named(state)
    named["version"] = VERSION
    named["stands"][KINDS.index("waiting")] = 1.0
    return state


def examine(
    limits: Limits, state: FloatArray, t: npt.ArrayLike, r: npt.ArrayLike, u: npt.ArrayLike, y: npt.ArrayLike
) -> tuple[FloatArray, tuple[Finding, ...]]:
    """Look at a block of samples of one asset, of any length.

    Parameters
    ----------
    limits
        `QualitySettings.limits` for the loop's sample rate.
    state
        As returned by `init`, `tick` or an earlier call; it stays valid.
    t, r, u, y
        Time stamps (epoch, s) and signals, shape (N,). A number that is not finite is a missing sample.

    Returns
    -------
    numpy.ndarray, tuple of Finding
        The new state, and what began or ended.

    Raises
    ------
    RecordingError
        If the shapes do not fit together.
    StateError
        If the state is of another version.
    """
    from servoscope.quality.kernel import look

    t, r, u, y = (np.ascontiguousarray(each, dtype=np.float64) for each in (t, r, u, y))
    if t.ndim != 1 or not t.shape == r.shape == u.shape == y.shape:
        raise RecordingError("t, r, u and y of a block must have the same shape (N,)")
    new, findings = _copy(state), []
    told, begin = np.empty((BUFFER, 5)), 0
    while begin < len(t):
        begin, count = look(limits, new.view(LAYOUT), t, r, u, y, begin, told)
        findings += [Finding(KINDS[int(kind)], bool(on), *rest) for kind, on, *rest in told[:count].tolist()]
    return new, tuple(findings)


def tick(limits: Limits, state: FloatArray, now: float) -> tuple[FloatArray, tuple[Finding, ...]]:
    """Let time pass by the clock of the service: the only one that goes on where no data come.

    Call it about once a second, and with each block.

    Parameters
    ----------
    limits, state
        As for `examine`.
    now
        Time (s) of one clock; in a replay it runs as fast as the replay.
    """
    new = _copy(state)
    named = _named(new)
    if named["heard"] != named["count"] or not named["listens"] or now < named["heard_at"]:
        _hear(new, now)
    quiet, stands = now - float(named["heard_at"]), bool(named["stands"][SILENT])
    if stands == (quiet > limits.silent_s):
        return new, ()
    named["stands"][SILENT], named["since"][SILENT] = not stands, now
    return new, (Finding("silent", not stands, now, quiet, limits.silent_s),)


def listen(state: FloatArray, now: float) -> FloatArray:
    """Return a restored state for a service that listens again from now (s) on: the silence before was its own."""
    new = _copy(state)
    _hear(new, now)
    return new


def standing(state: FloatArray) -> dict[str, float]:
    """Return what is wrong at the moment, and since when (epoch, s); ``waiting`` until the first window is complete."""
    named = _named(state)
    since = named["since"].tolist()
    return {kind: since[i] for i, kind in enumerate(KINDS) if named["stands"][i]}


def _hear(state: FloatArray, now: float) -> None:
    named = _named(state)
    named["heard"], named["heard_at"], named["listens"] = named["count"], now, 1.0


def _named(state: FloatArray) -> Any:
    """Return a view of the state whose places have names."""
    return state.view(LAYOUT)[0]


def _copy(state: FloatArray) -> FloatArray:
    if state.shape != (SIZE,) or state.dtype != np.float64 or _named(state)["version"] != VERSION:
        raise StateError("state of data quality: another version wrote it, or it is not whole; begin anew with init()")
    return state.copy()
