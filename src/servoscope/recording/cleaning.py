"""A recording: r, u and y of one asset on one clock, and the defects that were found on the way in."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.errors import NotEnoughError, RecordingError
from servoscope.recording import clock
from servoscope.recording.defects import Defect, listed, shortened, spans
from servoscope.recording.spikes import find_spikes, steps_in

__all__ = ["LEAST_SAMPLES", "Defect", "Recording", "clean", "with_defects"]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int32]

LEAST_SAMPLES = 20
LARGEST = 1e60  # and its inverse: beyond, squares of squares leave the range of numbers
MOST_LOST = 0.5  # share of rows that may be unusable
PLATEAU = 5  # samples at the very extreme value before u is said to be at a limit
FOLLOWS = 0.5  # share of the reference's variation that is left when a signal follows it
SPIKE_SHARES = {"r": 0.1, "u": 0.7, "y": 0.1}  # u kicks; r and y belong to something with mass


@dataclass(frozen=True, eq=False)
class Recording:
    """r, u and y of one asset over a time span, on one clock; made by `clean`.

    Parameters
    ----------
    name
        What it is called in reports, for example the file's name.
    t
        Time [s], shape (N,), rising. Where the file's time restarts with a new run, runs are laid end to end.
    r, u, y
        Reference, control input, measured output as logged (SI units), shape (N,).
    sample_rate
        Sample rate [Hz].
    restart
        True where a row does not follow its predecessor by one sample: first row, new run, after a gap;
        shape (N,).
    run
        Index of the run, from 0, shape (N,).
    defects
        What was wrong, in the order of time.
    """

    name: str
    t: FloatArray
    r: FloatArray
    u: FloatArray
    y: FloatArray
    sample_rate: float
    restart: BoolArray
    run: IntArray
    defects: tuple[Defect, ...] = ()

    @property
    def samples(self) -> int:
        """Number of rows N."""
        return int(self.t.size)

    @property
    def duration_s(self) -> float:
        """From the first row to one sample after the last [s], gaps included."""
        return float(self.t[-1] - self.t[0]) + 1.0 / self.sample_rate

    @property
    def columns(self) -> tuple[npt.NDArray[Any], ...]:
        """All that has one value per row."""
        return self.t, self.r, self.u, self.y, self.restart, self.run

    def rows(self, rows: slice) -> Recording:
        """Return some rows as they stand here, without defects; nothing is copied."""
        t, r, u, y, restart, run = (column[rows] for column in self.columns)
        return replace(self, t=t, r=r, u=u, y=y, restart=restart, run=run, defects=())

    def part(self, from_s: float, to_s: float) -> Recording:
        """Return the rows with from_s <= t < to_s and the defects that overlap them.

        Raises
        ------
        RecordingError
            If there are none.
        """
        first, end = np.searchsorted(self.t, [from_s, to_s])
        if first >= end:
            span = f"{self.t[0]:g} to {self.t[-1]:g} s"
            raise RecordingError(f"{self.name}: nothing from {from_s:g} to {to_s:g} s, it spans {span}")
        found = self.rows(slice(first, end))
        restart = found.restart.copy()
        restart[0] = True
        defects = tuple(d for d in self.defects if d.to_s >= from_s and d.from_s < to_s)
        return replace(found, restart=restart, run=found.run - found.run[0], defects=defects)


def with_defects(recording: Recording, *more: Defect) -> Recording:
    """Return the recording with further defects, all in the order of time."""
    return replace(recording, defects=tuple(sorted((*recording.defects, *more), key=lambda defect: defect.from_s)))


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
    first_runs = np.zeros(raw[0].size, dtype=np.int64) if run is None else np.asarray(run)
    axis = clock.arrange(raw[0], first_runs, sample_rate, name)
    period, notes = 1.0 / axis.sample_rate, list(axis.notes)
    t_all, run_all = axis.t, axis.run
    r_all, u_all, y_all = (channel[axis.rows] for channel in raw[1:])

    unusable = ~(np.isfinite(r_all) & np.isfinite(u_all) & np.isfinite(y_all))
    which = [label for label, x in zip(labels, (r_all, u_all, y_all), strict=True) if not np.isfinite(x).all()]
    notes += listed("nan", unusable, t_all, f"not a number in {', '.join(which)}, row{{s}} dropped")
    kept = np.flatnonzero(~unusable)
    kept, repeated = _without_repeats(kept, t_all, run_all, period)
    notes += listed("repeat", _mask(repeated, t_all.size), t_all, "time stamp repeated, later row{s} dropped")
    spike, spiky = _spikes(r_all[kept], u_all[kept], y_all[kept], run_all[kept], labels)
    notes += listed("spike", _mask(kept[spike], t_all.size), t_all, f"spike in {', '.join(spiky)}, row{{s}} dropped")
    dropped = np.union1d(np.flatnonzero(unusable), kept[spike])
    kept = kept[~spike]
    if dropped.size > MOST_LOST * t_all.size:
        raise RecordingError(
            f"{name}: {dropped.size} of {t_all.size} rows hold NaN or spikes, that is too little to use"
        )

    t_kept, run_kept = t_all[kept], run_all[kept]
    _check_length(kept.size, int(run_kept.max(initial=0)) + 1, name)
    gap_after = clock.gaps(t_kept, run_kept, period)
    notes += _gap_notes(t_kept, gap_after, t_all[dropped], period)
    restart = np.diff(run_kept, prepend=run_kept[:1] - 1) != 0
    restart[gap_after + 1] = True
    r_kept, u_kept, y_kept = r_all[kept], u_all[kept], y_all[kept]
    _check_channels([r_kept, u_kept, y_kept], name, labels)
    _check_swapped(r_kept, u_kept, y_kept, name, labels)
    notes += _saturation(t_kept, u_kept, limits)
    numbered = np.unique(run_kept, return_inverse=True)[1].astype(np.int32)
    recording = Recording(name, t_kept, r_kept, u_kept, y_kept, axis.sample_rate, restart, numbered)
    return with_defects(recording, *notes)


def _check_channels(channels: list[FloatArray], name: str, labels: tuple[str, str, str]) -> None:
    if channels[0].size == 0:
        raise RecordingError(f"{name}: holds no rows")
    for x, label, may_rest in zip(channels, labels, (True, False, False), strict=True):
        finite = x[np.isfinite(x)]
        if finite.size == 0:
            raise RecordingError(f"{name}: {label} holds no numbers at all, choose another column")
        if np.abs(finite).max() > LARGEST:
            raise RecordingError(
                f"{name}: {label} reaches {np.abs(finite).max():g}, which is no physical signal: check its unit"
            )
        if not may_rest and np.ptp(finite) < 1.0 / LARGEST and finite.size > 1 and finite.min() != finite.max():
            raise RecordingError(f"{name}: {label} varies by {np.ptp(finite):g} only: check its unit")
        if not may_rest and finite.size > 1 and finite.min() == finite.max():
            raise RecordingError(
                f"{name}: {label} is constant: {finite[0]:g} in all {finite.size} rows;"
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
    scale, of_u, of_y = float(np.std(r)), float(np.std(u - r)), float(np.std(y - r))
    if of_u < FOLLOWS * scale and of_u < FOLLOWS * of_y:
        raise RecordingError(
            f"{name}: {labels[1]} follows the reference and {labels[2]} does not:"
            " u and y seem to be swapped, swap the two columns"
        )


def _without_repeats(
    kept: npt.NDArray[np.intp], t: FloatArray, run: IntArray, period: float
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    same = np.zeros(kept.size, dtype=bool)
    same[1:] = (np.diff(t[kept]) < clock.SAME * period) & (np.diff(run[kept]) == 0)
    return kept[~same], kept[same]


def _spikes(
    r: FloatArray, u: FloatArray, y: FloatArray, run: IntArray, labels: tuple[str, str, str]
) -> tuple[BoolArray, list[str]]:
    in_r = find_spikes(r, run, share=SPIKE_SHARES["r"])
    # A one-sample kick of u is what a controller does when r steps; spikes of r itself are no steps.
    sound = np.flatnonzero(~in_r)
    excused = np.zeros(r.size, dtype=bool)
    excused[sound] = steps_in(r[sound], run[sound])
    in_u = find_spikes(u, run, share=SPIKE_SHARES["u"], excused=excused)
    in_y = find_spikes(y, run, share=SPIKE_SHARES["y"])
    spiky = [label for label, mask in zip(labels, (in_r, in_u, in_y), strict=True) if mask.any()]
    return in_r | in_u | in_y, spiky


def _gap_notes(t: FloatArray, after: npt.NDArray[np.intp], dropped: FloatArray, period: float) -> list[Defect]:
    notes = []
    for index in after:
        start, end = t[index], t[index + 1]
        missing = max(round((end - start) / period) - 1, 1)
        # Rows that were dropped have been told already; only those that the file lacks count here.
        told = np.unique(np.round((dropped[(dropped > start) & (dropped < end)] - start) / period))
        lacking = missing - int(((told >= 1) & (told <= missing)).sum())
        if lacking > 0:
            rows = f"{lacking} row{'s' * (lacking > 1)}"
            message = f"gap of {rows} from {start + period:g} to {end:g} s, not bridged"
            notes.append(Defect("gap", float(start + period), float(end), lacking, message))
    return shortened(notes)


def _saturation(t: FloatArray, u: FloatArray, limits: tuple[float, float] | None) -> list[Defect]:
    low, high = (float(u.min()), float(u.max())) if limits is None else limits
    slack = 0.0 if limits is None else 1e-6 * (high - low)
    notes = []
    for mask, value in ((u >= high - slack, high), (u <= low + slack, low)):
        if limits is None:
            lengths = [stop - start for start, stop in spans(mask)]
            # Resting at 0, or moving between two values only, is not a limit.
            if value == 0.0 or max(lengths, default=0) < PLATEAU or mask.mean() > 0.5:
                continue
        # A limit cycle touches the limit again and again: touches within a second are one event.
        near = np.diff(t[mask]) <= 1.0
        words = "at its limit" if limits is not None else "flat at its extreme, perhaps at a limit,"
        for touches in np.split(t[mask], np.flatnonzero(~near) + 1) if mask.any() else ():
            span = f"{touches.size} rows from {touches[0]:g} to {touches[-1]:g} s"
            message = f"u {words} {value:g}: {span}, kept"
            notes.append(Defect("saturation", float(touches[0]), float(touches[-1]), touches.size, message))
    return shortened(notes)


def _mask(indices: npt.NDArray[np.intp], size: int) -> BoolArray:
    mask = np.zeros(size, dtype=bool)
    mask[indices] = True
    return mask
