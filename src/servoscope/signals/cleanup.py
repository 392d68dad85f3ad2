"""Rows as logged to a recording: what cannot be used is dropped and listed, chunk by chunk."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.core import outofcore
from servoscope.core.arrays import BoolArray, FloatArray, IndexArray, Int32Array, select_rows
from servoscope.core.errors import NotEnoughError, RecordingError
from servoscope.core.messages import message
from servoscope.signals.defects import Defect, defects_at, limit_defects, split_consecutive
from servoscope.signals.recording import Recording, with_defects
from servoscope.signals.resample import ResampleTarget, resample_rows
from servoscope.signals.spikes import find_spikes, follows_reference_step
from servoscope.signals.time_axis import build_time_axis, number_runs
from servoscope.signals.timebase import Timebase

MIN_SAMPLES = 20
MAX_MAGNITUDE = 1e60  # and its inverse: beyond, squares of squares leave the range of numbers
MAX_DROPPED_SHARE = 0.5  # share of rows that may be unusable
PLATEAU_SAMPLES = 5  # samples at the very extreme value before u is said to be at a limit
FOLLOWING_SHARE = 0.5  # share of the reference's variation that is left when a signal follows it
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
    channels: Mapping[str, npt.ArrayLike] | None = None,
    target: ResampleTarget | None = None,
) -> Recording:
    """Turn rows as logged into a recording; what cannot be used is dropped and listed.

    Rows are sorted and repeats dropped within a run; a row with a NaN or a spike in any channel is dropped
    whole; a step of more than 1.5 samples is a gap, after which `restart` is set. u at a limit is valid data. Without
    a `target`, to whose rate the rows that are left are resampled, nothing is interpolated.

    `t`: time stamps [s], shape (N,); `r, u, y`: reference, control input, measured output, shape (N,); `name`: what
    the recording is called, also in errors; `sample_rate`: expected sample rate [Hz]; None: taken from the time
    stamps; `run`: numbers, shape (N,), whose change starts a new run; a time reset does too; `limits`: limits [lo,
    hi] of u, for the count of saturated samples; None: a plateau at the extreme value counts; `labels`: what errors
    call r, u and y; `channels`: further columns, whose rows go with the others; `target`: what to resample to.

    Raises NotEnoughError if fewer than 20 usable rows, or runs shorter than that, are left; raises RecordingError if
    the time axis is unusable, the sample rate is not the expected one, a channel holds no numbers, u or y is constant,
    or u and y seem to be swapped.
    """
    raw = [np.asarray(channel, dtype=np.float64) for channel in (t, r, u, y)]
    extra = {name: np.asarray(channel, dtype=np.float64) for name, channel in (channels or {}).items()}
    if any(channel.ndim != 1 or channel.size != raw[0].size for channel in (*raw, *extra.values())):
        raise RecordingError(f"{name}: t, r, u and y must be columns of equal length")
    _check_channels(raw[1:], name, labels)
    marks, rate = None if run is None else np.asarray(run), None if target else sample_rate
    axis = build_time_axis(raw[0], marks, rate, name, regular=target is None, signals=raw[1:])
    target = target and target.at(axis.sample_rate, axis.t)
    timebase, defects = Timebase(1.0 / axis.sample_rate), list(axis.defects)
    logged: list[npt.NDArray[Any]] = [axis.t, axis.run, *(axis.reorder(channel) for channel in raw[1:])]
    carried = {name: axis.reorder(channel) for name, channel in extra.items()}

    empty = [outofcore.find_rows(lambda rows, x=x: ~np.isfinite(x[rows]), x) for x in logged[2:]]  # type: ignore[misc]
    unusable = _union(*empty)
    incomplete = [label for label, rows in zip(labels, empty, strict=True) if rows.size]
    defects += defects_at("nan", unusable, axis.t, channels=incomplete)
    columns = [outofcore.drop_rows(column, unusable) for column in logged]
    repeats = timebase.find_repeats(columns[0], columns[1])
    repeated = _original_rows(repeats, unusable)
    defects += defects_at("repeat", repeated, axis.t)
    columns = [outofcore.drop_rows(column, repeats) for column in columns]
    spikes, spiky = _find_spikes(columns[2], columns[3], columns[4], columns[1], labels)
    original = _original_rows(spikes, _union(unusable, repeated))
    defects += defects_at("spike", original, axis.t, channels=spiky)
    dropped = _union(unusable, original)
    gone = _union(dropped, repeated)
    if dropped.size > MAX_DROPPED_SHARE * axis.t.size:
        raise RecordingError(
            f"{name}: {dropped.size} of {axis.t.size} rows hold NaN or spikes, that is too little to use"
        )
    t_kept, run_kept, r_kept, u_kept, y_kept = (outofcore.drop_rows(column, spikes) for column in columns)

    _check_length(t_kept.size, int(run_kept[-1]) + 1 if run_kept.size else 1, name)
    kept = {name: outofcore.drop_rows(channel, gone) for name, channel in carried.items()}
    resampled = None
    if target is None:
        gap_after = timebase.find_gaps(t_kept, run_kept)
    else:
        signals = [r_kept, u_kept, y_kept, *kept.values()]
        held = {1} | ({0} if np.array_equal(r_kept, u_kept) else set())
        resampled = resample_rows(t_kept, run_kept, signals, held, target, name)
        gap_after = resampled.gap_after
    defects += _gap_defects(t_kept, gap_after, axis.t[dropped], timebase.period)
    if t_kept.size < raw[0].size:
        _check_channels([r_kept, u_kept, y_kept], name, labels)
    _check_swapped(r_kept, u_kept, y_kept, name, labels)
    defects += _saturation_defects(t_kept, u_kept, limits)
    rate = axis.sample_rate
    if resampled is not None and target is not None:
        words = message(
            "defect.resampled", measured=rate, rate=target.rate, error=resampled.error, cutoff=target.cutoff
        )
        defects.append(Defect("resampled", float(t_kept[0]), float(t_kept[-1]), t_kept.size, words))
        t_kept, run_kept, rate = resampled.t, resampled.run, target.rate
        r_kept, u_kept, y_kept, *others = resampled.columns
        kept = dict(zip(kept, others, strict=True))
        _check_length(t_kept.size, int(run_kept[-1]) + 1, name)
    numbered, restart = _renumber_runs(run_kept)
    restart |= resampled.restart if resampled is not None else False
    if resampled is None:
        restart[gap_after + 1] = True
    recording = Recording(t_kept, r_kept, u_kept, y_kept, restart, kept, name=name, sample_rate=rate, run=numbered)
    return with_defects(recording, *defects)


def _union(*rows: IndexArray) -> IndexArray:
    """Return the rows that are among any of these, in order."""
    return np.unique(np.concatenate(rows)) if any(row.size for row in rows) else rows[0]


def _original_rows(rows: IndexArray, dropped: IndexArray) -> IndexArray:
    """Return where rows stood before others were dropped."""
    if not (rows.size and dropped.size):
        return rows
    return np.asarray(rows + np.searchsorted(dropped - np.arange(dropped.size), rows, side="right"))


def _renumber_runs(run: Int32Array) -> tuple[Int32Array, BoolArray]:
    """Return the runs that are left, counted from 0, and where one begins, both (N,)."""
    begins = np.append(
        0, outofcore.find_rows(lambda rows: run[rows] != run[rows.start - 1 : rows.stop - 1], run, first=1)
    )
    restart = outofcore.empty((run.size,), np.bool_)
    for rows in outofcore.iter_chunks(0, run.size, restart):
        restart[rows] = False
    restart[begins] = True
    is_numbered = np.array_equal(run[begins], np.arange(begins.size))  # unless a run has lost all of its rows
    return run if is_numbered else number_runs(begins[1:], run.size), restart


def _check_channels(channels: list[FloatArray], name: str, labels: tuple[str, str, str]) -> None:
    if channels[0].size == 0:
        raise RecordingError(f"{name}: holds no rows")
    for x, label, may_rest in zip(channels, labels, (True, False, False), strict=True):
        low, high, count = np.inf, -np.inf, 0
        for rows in outofcore.iter_chunks(0, x.size, x):
            finite = select_rows(x[rows], np.isfinite(x[rows]))
            low, high = min(low, float(finite.min(initial=np.inf))), max(high, float(finite.max(initial=-np.inf)))
            count += finite.size
        if count == 0:
            raise RecordingError(f"{name}: {label} holds no numbers at all, choose another column")
        largest = max(abs(low), abs(high))
        if largest > MAX_MAGNITUDE:
            raise RecordingError(f"{name}: {label} reaches {largest:g}, which is no physical signal: check its unit")
        if not may_rest and 0.0 < high - low < 1.0 / MAX_MAGNITUDE:
            raise RecordingError(f"{name}: {label} varies by {high - low:g} only: check its unit")
        if not may_rest and count > 1 and low == high:
            raise RecordingError(
                f"{name}: {label} is constant: {low:g} in all {count} rows;"
                " choose the column that moves, or record while the machine moves"
            )
    _check_length(channels[0].size, 1, name)


def _check_length(samples: int, runs: int, name: str) -> None:
    if samples < MIN_SAMPLES:
        raise NotEnoughError(f"{name}: {samples} usable rows are too few, at least {MIN_SAMPLES} are needed")
    if samples < MIN_SAMPLES * runs:
        raise NotEnoughError(
            f"{name}: falls into {runs} runs of about {samples // runs} rows, too short to use;"
            " check the time column and the segment columns"
        )


def _check_swapped(r: FloatArray, u: FloatArray, y: FloatArray, name: str, labels: tuple[str, str, str]) -> None:
    scale, of_u, of_y = _standard_deviation(r), _standard_deviation(u, r), _standard_deviation(y, r)
    # where the command is the reference itself, as of an actuator with a position loop of its own, nothing is swapped
    if 0.0 < of_u < FOLLOWING_SHARE * scale and of_u < FOLLOWING_SHARE * of_y:
        raise RecordingError(
            f"{name}: {labels[1]} follows the reference and {labels[2]} does not:"
            " u and y seem to be swapped, swap the two columns"
        )


def _standard_deviation(x: FloatArray, other: FloatArray | None = None) -> float:
    """Return the standard deviation of x, or of its difference from another signal."""
    total = squares = 0.0
    about = float(x[0] if other is None else x[0] - other[0])
    for rows in outofcore.iter_chunks(0, x.size, x, x if other is None else other):
        off = x[rows] - about if other is None else x[rows] - other[rows] - about
        total, squares = total + float(off.sum()), squares + float(off @ off)
    return float(np.sqrt(max(squares / x.size - (total / x.size) ** 2, 0.0)))


def _find_spikes(
    r: FloatArray, u: FloatArray, y: FloatArray, run: Int32Array, labels: tuple[str, str, str]
) -> tuple[IndexArray, list[str]]:
    """Return the rows with a spike in any signal, and the labels of these signals."""
    with outofcore.second_thread(y.size) as pool:
        y_search = pool.submit(find_spikes, y, run, share=SPIKE_SHARES["y"])
        in_r, in_u = _find_input_spikes(r, u, run)
    spikes = in_r, in_u, y_search.result()
    spiky = [label for label, rows in zip(labels, spikes, strict=True) if rows.size]
    return _union(*spikes), spiky


def _find_input_spikes(r: FloatArray, u: FloatArray, run: Int32Array) -> tuple[IndexArray, IndexArray]:
    """Return the spikes of the reference, and those of the control input that are not its answer to a step."""
    in_r = find_spikes(r, run, share=SPIKE_SHARES["r"])
    sound, runs = outofcore.drop_rows(r, in_r), outofcore.drop_rows(run, in_r)

    def excused(rows: IndexArray) -> BoolArray:
        """Return where a controller kicks u because r steps; spikes of r itself are no steps."""
        return follows_reference_step(sound, runs, rows - np.searchsorted(in_r, rows)) & ~np.isin(rows, in_r)

    return in_r, find_spikes(u, run, share=SPIKE_SHARES["u"], excused=excused)


def _gap_defects(t: FloatArray, after: IndexArray, dropped: FloatArray, period: float) -> list[Defect]:
    defects = []
    for index in after:
        start, end = t[index], t[index + 1]
        missing = max(round((end - start) / period) - 1, 1)
        # Rows that were dropped are defects of their own; only those that the file lacks count here.
        first, last = np.searchsorted(dropped, start, side="right"), np.searchsorted(dropped, end)
        known = np.unique(np.round((dropped[first:last] - start) / period))
        lacking = missing - int(((known >= 1) & (known <= missing)).sum())
        if lacking > 0:
            span = float(start + period), float(end)
            key = f"defect.gap.{'one' if lacking == 1 else 'many'}"
            text = message(key, rows=lacking, from_s=span[0], to_s=span[1])
            defects.append(Defect("gap", *span, lacking, text))
    return limit_defects(defects)


def rows_at_limits(u: FloatArray, limits: tuple[float, float] | None, slack: float) -> list[tuple[float, IndexArray]]:
    """Return the highest and the lowest value of u, and the rows within a `slack` of each, as a share of the range.

    Of `limits`, or without them of plateaus at the extremes: where there is none, there are no rows.
    """
    low, high = limits or outofcore.extremes(u)
    least, ends = -slack * (high - low), list[tuple[float, IndexArray]]()
    for sign, value in ((1.0, high), (-1.0, low)):
        rows = outofcore.find_rows(lambda rows, s=sign, v=value: s * (u[rows] - v) >= least, u)  # type: ignore[misc]
        longest = max((stretch.size for stretch in split_consecutive(rows)), default=0)
        # Resting at 0, or moving between two values only, is not a limit.
        is_limit = limits is not None or (value != 0.0 and longest >= PLATEAU_SAMPLES and rows.size <= 0.5 * u.size)
        ends.append((value, rows if is_limit else rows[:0]))
    return ends


def _saturation_defects(t: FloatArray, u: FloatArray, limits: tuple[float, float] | None) -> list[Defect]:
    defects = []
    for value, touching in rows_at_limits(u, limits, 0.0 if limits is None else 1e-6):
        # A limit cycle touches the limit again and again: touches within a second are one event.
        times = t[touching]
        key = "defect.plateau" if limits is None else "defect.saturation"
        for touches in np.split(times, np.flatnonzero(np.diff(times) > 1.0) + 1) if times.size else ():
            span = float(touches[0]), float(touches[-1])
            text = message(key, value=value, rows=touches.size, from_s=span[0], to_s=span[1])
            defects.append(Defect("saturation", *span, touches.size, text))
    return limit_defects(defects)
