"""Data quality of an endless stream, block by block: a small state, carried along; exact under any blocking."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import RecordingError, StateError
from servoscope.signals.quality.settings import KINDS, QualityFinding, QualityLimits

SILENT = KINDS.index("silent")
BUFFER = 64  # findings that the compiled loop returns at a time


def init_state() -> FloatArray:
    """Return the state before the first sample, shape (size,): finite numbers, so that JSON can carry it too."""
    state = np.zeros(STATE_SIZE)
    named = _state_record(state)
    named["version"] = STATE_VERSION
    named["active"][KINDS.index("waiting")] = 1.0
    return state


def upgrade_state(state: FloatArray) -> FloatArray:
    """Return a saved state as this version has it: one of version 1 knows nothing of how often u changes."""
    if state.shape != (SIZE_OF_VERSION_1,) or state[0] != 1.0:
        return state
    new = init_state()
    new[1:SIZE_OF_VERSION_1] = state[1:]
    return new


def check_block(
    limits: QualityLimits, state: FloatArray, t: npt.ArrayLike, r: npt.ArrayLike, u: npt.ArrayLike, y: npt.ArrayLike
) -> tuple[FloatArray, tuple[QualityFinding, ...]]:
    """Check a block of samples of one asset, of any length, in the order of time.

    `state`: of `init_state`, `tick` or an earlier call; it stays valid; `t`: time stamps (epoch, s). A value that is
    not finite is a missing sample. Returns the new state, and the findings that began or ended. Raises RecordingError
    if the shapes do not fit together, StateError if the state is of another version.
    """
    from servoscope.signals.quality.kernel import check_samples

    t, r, u, y = (np.ascontiguousarray(signal, dtype=np.float64) for signal in (t, r, u, y))
    if t.ndim != 1 or not t.shape == r.shape == u.shape == y.shape:
        raise RecordingError("t, r, u and y of a block must have the same shape (N,)")
    new, findings = _copy_state(state), []
    out, count, begin = np.empty((BUFFER, 5)), np.empty(1, dtype=np.int64), 0
    while begin < len(t):
        begin = check_samples(limits, new.view(STATE_DTYPE), t, r, u, y, begin, out, count)
        rows = out[: count[0]].tolist()
        findings += [QualityFinding(KINDS[int(kind)], bool(on), *numbers) for kind, on, *numbers in rows]
    return new, tuple(findings)


def check_lanes(limits: QualityLimits, states: FloatArray, t: FloatArray, signals: FloatArray) -> FloatArray:
    """Do what `check_block` and a `tick` at its last sample do, for a block of each of several assets.

    `states`: shape (assets, size); `t`: finite, shape (assets, N); `signals`: r, u and y, shape (assets, 3, N). Returns
    the new states.
    """
    from servoscope.signals.quality.kernel import check_rows

    new = np.array(states)
    named = new.view(STATE_DTYPE)[:, 0]
    check_rows(limits, named, *map(np.ascontiguousarray, (t, signals)), np.empty((BUFFER, 5)))
    now = t[:, -1]
    anew = (named["seen_count"] != named["count"]) | (named["is_running"] == 0.0) | (now < named["seen_at"])
    for name, values in (("seen_count", named["count"]), ("seen_at", now), ("is_running", 1.0)):
        named[name] = np.where(anew, values, named[name])
    silent = named["active"][:, SILENT] != 0.0
    changed = silent != (now - named["seen_at"] > limits.silent_s)
    named["active"][:, SILENT] = silent != changed
    named["since"][:, SILENT] = np.where(changed, now, named["since"][:, SILENT])
    return new


def tick(limits: QualityLimits, state: FloatArray, now: float) -> tuple[FloatArray, tuple[QualityFinding, ...]]:
    """Check for silence by the clock of the service, about once a second and with each block.

    `now`: time (s) of one clock; in a replay it runs as fast as the replay.
    """
    new = _copy_state(state)
    named = _state_record(new)
    if named["seen_count"] != named["count"] or not named["is_running"] or now < named["seen_at"]:
        _reset_silence(new, now)
    quiet, silent = now - float(named["seen_at"]), bool(named["active"][SILENT])
    if silent == (quiet > limits.silent_s):
        return new, ()
    named["active"][SILENT], named["since"][SILENT] = not silent, now
    return new, (QualityFinding("silent", not silent, now, quiet, limits.silent_s),)


def restart_silence(state: FloatArray, now: float) -> FloatArray:
    """Return a restored state for a service that starts again now (s): the silence before was its own."""
    new = _copy_state(state)
    _reset_silence(new, now)
    return new


def active_findings(state: FloatArray) -> dict[str, float]:
    """Return what is wrong at the moment, and since when (epoch, s); ``waiting`` until the first window is complete."""
    if not any(state[ACTIVE].tolist()):  # faster than NumPy for so few
        return {}
    named = _state_record(state)
    since = named["since"].tolist()
    return {kind: since[i] for i, kind in enumerate(KINDS) if named["active"][i]}


def _reset_silence(state: FloatArray, now: float) -> None:
    named = _state_record(state)
    named["seen_count"], named["seen_at"], named["is_running"] = named["count"], now, 1.0


def _state_record(state: FloatArray) -> Any:
    """Return a view of the state whose places have names."""
    return state.view(STATE_DTYPE)[0]


def _copy_state(state: FloatArray) -> FloatArray:
    if state.shape != (STATE_SIZE,) or state.dtype != np.float64 or _state_record(state)["version"] != STATE_VERSION:
        raise StateError(
            "state of data quality: another version wrote it, or it is not whole; start again with init_state()"
        )
    return state.copy()


STATE_VERSION = 2

# All of them numbers of the same type: for saving, an array (size,) of float64; for the kernel, a record.
STATE_DTYPE = np.dtype(
    [
        ("version", np.float64),
        # the stream: samples so far, the last time stamp, and how many of them the service had seen by when
        ("count", np.float64),
        ("t", np.float64),
        ("is_running", np.float64),
        ("seen_count", np.float64),
        ("seen_at", np.float64),
        # the window: samples; steps of about one sample, and those that jitter; whole periods in a span [s], for the
        # rate; missing samples; jumps
        ("samples", np.float64),
        ("steps", np.float64),
        ("jittery", np.float64),
        ("periods", np.float64),
        ("span", np.float64),
        ("missing", np.float64),
        ("jumps", np.float64),
        # r, u and y: samples so far, the last ones, how long each has stayed the same [samples], smallest change
        ("values", np.float64),
        ("last", np.float64, (3,)),
        ("same", np.float64, (3,)),
        ("smallest_change", np.float64, (3,)),
        # lowest and highest of r, u, y and r - y: of this epoch, of the one before; windows in this epoch
        ("ranges", np.float64, (2, 4, 2)),
        ("windows", np.float64),
        # lowest and highest while y stays the same: r; while u does: y, r - y; while r does: y
        ("r_range", np.float64, (2,)),
        ("y_range", np.float64, (2,)),
        ("e_range", np.float64, (2,)),
        ("rest_range", np.float64, (2,)),
        # turns of y at rest, the direction of its last change, and whether it is known to be noisy there
        ("turns", np.float64),
        ("direction", np.float64),
        ("noisy", np.float64),
        # which findings are active, 1 or 0, and since when (epoch, s); the order is that of KINDS
        ("active", np.float64, (len(KINDS),)),
        ("since", np.float64, (len(KINDS),)),
        # changes of u, and samples, since it was last the same for long
        ("u_changes", np.float64),
        ("u_samples", np.float64),
    ]
)
STATE_SIZE = STATE_DTYPE.itemsize // 8
SIZE_OF_VERSION_1 = STATE_SIZE - 2  # it does not count the changes of u
# where in a state the flags are
ACTIVE = slice((_begin := STATE_DTYPE.fields["active"][1] // 8), _begin + len(KINDS))  # type: ignore[index]
