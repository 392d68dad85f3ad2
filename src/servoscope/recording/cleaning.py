"""Rows as logged to a recording: what cannot be used is dropped and told, piece by piece."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope import spool
from servoscope.errors import NotEnoughError, RecordingError
from servoscope.recording import clock
from servoscope.recording.defects import Defect, listed, shortened, together
from servoscope.recording.recorded import Recording, with_defects
from servoscope.recording.spikes import find_spikes, steps_in

__all__ = ["LEAST_SAMPLES", "clean"]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int32]
Index = npt.NDArray[np.intp]

LEAST_SAMPLES = 20
LARGEST = 1e60  # and its inverse: beyond, squares of squares leave the range of numbers
MOST_LOST = 0.5  # share of rows that may be unusable
PLATEAU = 5  # samples at the very extreme value before u is said to be at a limit
FOLLOWS = 0.5  # share of the reference's variation that is left when a signal follows it
SPIKE_SHARES = {"r": 0.1, "u": 0.7, "y": 0.1}  # u kicks; r and y belong to something with mass


def clean(
    t: npt.ArrayLike,
    r: npt.ArrayLike,
    u: npt.ArrayLike,
    y: npt.ArrayLike,
    *,
    name: str = "recording",
    sample_rate: float | None = None,
    run: npt.ArrayLike | None = None,
    limits: tuple[float, float] | None = None,
    labels: tuple[str, str, str] = ("r", "u", "y"),
) -> Recording:
    """Turn rows as logged into a recording; what cannot be used is dropped and told, nothing is interpolated.

    Rows are sorted and repeats dropped within a run; a row with a NaN or a spike in any channel is dropped
    whole; a step of more than 1.5 samples is a gap, after which `restart` is set. u at a limit is valid data.

    Parameters
    ----------
    t
        Time stamps [s], shape (N,).
    r, u, y
        Reference, control input, measured output, shape (N,).
    name
        What the recording is called, also in errors.
    sample_rate
        Expected sample rate [Hz]; None: taken from the time stamps.
    run
        Numbers, shape (N,), whose change starts a new run; a time reset does too.
    limits
        Limits [lo, hi] of u, for the count of saturated samples; None: a plateau at the extreme value counts.
    labels
        What errors call r, u and y.

    Raises
    ------
    NotEnoughError
        If fewer than 20 usable rows, or runs shorter than that, are left.
    RecordingError
        If the time axis is unusable, the sample rate is not the expected one, a channel holds no numbers,
        u or y is constant, or u and y seem to be swapped.
    """
    raw = [np.asarray(channel, dtype=np.float64) for channel in (t, r, u, y)]
    if any(channel.ndim != 1 or channel.size != raw[0].size for channel in raw):
        raise RecordingError(f"{name}: t, r, u and y must be columns of equal length")
    _check_channels(raw[1:], name, labels)
    axis = clock.arrange(raw[0], None if run is None else np.asarray(run), sample_rate, name)
    period, notes = 1.0 / axis.sample_rate, list(axis.notes)
    t_all, run_all = axis.t, axis.run
    channels = [axis.arranged(channel) for channel in raw[1:]]

    lacking = [_not_finite(channel) for channel in channels]
    unusable = np.unique(np.concatenate(lacking))
    which = [label for label, rows in zip(labels, lacking, strict=True) if rows.size]
    notes += listed("nan", unusable, t_all, f"not a number in {', '.join(which)}, row{{s}} dropped")
    columns: list[npt.NDArray[Any]] = [t_all, run_all, *channels]
    columns = [spool.without(column, unusable) for column in columns]
    again = _repeats(columns[0], columns[1], period)
    repeated = _before_dropping(again, unusable)
    notes += listed("repeat", repeated, t_all, "time stamp repeated, later row{s} dropped")
    columns = [spool.without(column, again) for column in columns]
    gone = np.union1d(unusable, repeated)
    found, spiky = _spikes(columns[2], columns[3], columns[4], columns[1], labels)
    spikes = _before_dropping(found, gone)
    notes += listed("spike", spikes, t_all, f"spike in {', '.join(spiky)}, row{{s}} dropped")
    dropped = np.union1d(unusable, spikes)
    if dropped.size > MOST_LOST * t_all.size:
        raise RecordingError(
            f"{name}: {dropped.size} of {t_all.size} rows hold NaN or spikes, that is too little to use"
        )
    t_kept, run_kept, r_kept, u_kept, y_kept = (spool.without(column, found) for column in columns)

    _check_length(t_kept.size, int(run_kept[-1]) + 1 if run_kept.size else 1, name)
    gap_after = clock.gaps(t_kept, run_kept, period)
    notes += _gap_notes(t_kept, gap_after, t_all[dropped], period)
    if t_kept.size < raw[0].size:
        _check_channels([r_kept, u_kept, y_kept], name, labels)
    _check_swapped(r_kept, u_kept, y_kept, name, labels)
    notes += _saturation(t_kept, u_kept, limits)
    numbered, restart = _numbered(run_kept)
    restart[gap_after + 1] = True
    recording = Recording(name, t_kept, r_kept, u_kept, y_kept, axis.sample_rate, restart, numbered)
    return with_defects(recording, *notes)


def _not_finite(x: FloatArray) -> Index:
    return spool.where(lambda rows: ~np.isfinite(x[rows]), x)


def _before_dropping(rows: Index, dropped: Index) -> Index:
    """Return where rows stood before others were dropped."""
    return np.asarray(rows + np.searchsorted(dropped - np.arange(dropped.size), rows, side="right"))


def _numbered(run: IntArray) -> tuple[IntArray, BoolArray]:
    """Return the runs that are left, counted from 0, and where one begins, both (N,)."""
    begins = np.append(0, spool.where(lambda rows: run[rows] != run[rows.start - 1 : rows.stop - 1], run, first=1))
    numbered, restart = spool.empty((run.size,), np.int32), spool.empty((run.size,), np.bool_)
    for rows in spool.pieces(0, run.size, run, numbered, restart):
        numbered[rows] = np.searchsorted(begins, np.arange(rows.start, rows.stop), side="right") - 1
        restart[rows] = False
    restart[begins] = True
    return numbered, restart


def _check_channels(channels: list[FloatArray], name: str, labels: tuple[str, str, str]) -> None:
    if channels[0].size == 0:
        raise RecordingError(f"{name}: holds no rows")
    for x, label, may_rest in zip(channels, labels, (True, False, False), strict=True):
        low, high, count = np.inf, -np.inf, 0
        for rows in spool.pieces(0, x.size, x):
            finite = x[rows][np.isfinite(x[rows])]
            low, high = min(low, float(finite.min(initial=np.inf))), max(high, float(finite.max(initial=-np.inf)))
            count += finite.size
        if count == 0:
            raise RecordingError(f"{name}: {label} holds no numbers at all, choose another column")
        largest = max(abs(low), abs(high))
        if largest > LARGEST:
            raise RecordingError(f"{name}: {label} reaches {largest:g}, which is no physical signal: check its unit")
        if not may_rest and 0.0 < high - low < 1.0 / LARGEST:
            raise RecordingError(f"{name}: {label} varies by {high - low:g} only: check its unit")
        if not may_rest and count > 1 and low == high:
            raise RecordingError(
                f"{name}: {label} is constant: {low:g} in all {count} rows;"
                " choose the column that moves, or record while the machine moves"
            )
    _check_length(channels[0].size, 1, name)


def _check_length(samples: int, runs: int, name: str) -> None:
    if samples < LEAST_SAMPLES:
        raise NotEnoughError(f"{name}: {samples} usable rows are too few, at least {LEAST_SAMPLES} are needed")
    if samples < LEAST_SAMPLES * runs:
        raise NotEnoughError(
            f"{name}: falls into {runs} runs of about {samples // runs} rows, too short to use;"
            " check the time column and the segment columns"
        )


def _check_swapped(r: FloatArray, u: FloatArray, y: FloatArray, name: str, labels: tuple[str, str, str]) -> None:
    scale, of_u, of_y = _scatter(r), _scatter(u, r), _scatter(y, r)
    if of_u < FOLLOWS * scale and of_u < FOLLOWS * of_y:
        raise RecordingError(
            f"{name}: {labels[1]} follows the reference and {labels[2]} does not:"
            " u and y seem to be swapped, swap the two columns"
        )


def _scatter(x: FloatArray, other: FloatArray | None = None) -> float:
    """Return the standard deviation of x, or of its difference from another signal."""
    total = squares = 0.0
    about = float(x[0] if other is None else x[0] - other[0])
    for rows in spool.pieces(0, x.size, x, x if other is None else other):
        off = x[rows] - about if other is None else x[rows] - other[rows] - about
        total, squares = total + float(off.sum()), squares + float(off @ off)
    return float(np.sqrt(max(squares / x.size - (total / x.size) ** 2, 0.0)))


def _repeats(t: FloatArray, run: IntArray, period: float) -> Index:
    def test(rows: slice) -> BoolArray:
        before = slice(rows.start - 1, rows.stop - 1)
        return np.asarray((t[rows] - t[before] < clock.SAME * period) & (run[rows] == run[before]))

    return spool.where(test, t, run, first=1)


def _spikes(
    r: FloatArray, u: FloatArray, y: FloatArray, run: IntArray, labels: tuple[str, str, str]
) -> tuple[Index, list[str]]:
    in_r = find_spikes(r, run, share=SPIKE_SHARES["r"])

    sound, runs = spool.without(r, in_r), spool.without(run, in_r)

    def excused(rows: Index) -> BoolArray:
        """Return where a controller kicks u because r steps; spikes of r itself are no steps."""
        return steps_in(sound, runs, rows - np.searchsorted(in_r, rows)) & ~np.isin(rows, in_r)

    in_u = find_spikes(u, run, share=SPIKE_SHARES["u"], excused=excused)
    in_y = find_spikes(y, run, share=SPIKE_SHARES["y"])
    spiky = [label for label, found in zip(labels, (in_r, in_u, in_y), strict=True) if found.size]
    return np.unique(np.concatenate([in_r, in_u, in_y])), spiky


def _gap_notes(t: FloatArray, after: Index, dropped: FloatArray, period: float) -> list[Defect]:
    notes = []
    for index in after:
        start, end = t[index], t[index + 1]
        missing = max(round((end - start) / period) - 1, 1)
        # Rows that were dropped have been told already; only those that the file lacks count here.
        first, last = np.searchsorted(dropped, start, side="right"), np.searchsorted(dropped, end)
        told = np.unique(np.round((dropped[first:last] - start) / period))
        lacking = missing - int(((told >= 1) & (told <= missing)).sum())
        if lacking > 0:
            rows = f"{lacking} row{'s' * (lacking > 1)}"
            message = f"gap of {rows} from {start + period:g} to {end:g} s, not bridged"
            notes.append(Defect("gap", float(start + period), float(end), lacking, message))
    return shortened(notes)


def _saturation(t: FloatArray, u: FloatArray, limits: tuple[float, float] | None) -> list[Defect]:
    low, high = limits or (
        min(float(u[rows].min()) for rows in spool.pieces(0, u.size, u)),
        max(float(u[rows].max()) for rows in spool.pieces(0, u.size, u)),
    )
    slack = 0.0 if limits is None else 1e-6 * (high - low)
    notes = []
    for sign, value in ((1.0, high), (-1.0, low)):
        touching = spool.where(lambda rows, s=sign, v=value: s * (u[rows] - v) >= -slack, u)  # type: ignore[misc]
        if limits is None:
            lengths = [rows.size for rows in together(touching)]
            # Resting at 0, or moving between two values only, is not a limit.
            if value == 0.0 or max(lengths, default=0) < PLATEAU or touching.size > 0.5 * u.size:
                continue
        # A limit cycle touches the limit again and again: touches within a second are one event.
        times = t[touching]
        words = "at its limit" if limits is not None else "flat at its extreme, perhaps at a limit,"
        for touches in np.split(times, np.flatnonzero(np.diff(times) > 1.0) + 1) if times.size else ():
            span = f"{touches.size} rows from {touches[0]:g} to {touches[-1]:g} s"
            message = f"u {words} {value:g}: {span}, kept"
            notes.append(Defect("saturation", float(touches[0]), float(touches[-1]), touches.size, message))
    return shortened(notes)
