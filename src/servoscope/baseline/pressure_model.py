"""A cylinder whose pressures are logged: flow through the valve, balance of forces and supply, recording by recording.

::

    u w = forward max(v, 0) + backward min(v, 0) + lag (u w)' + leakage (p_A - p_B) + oil p_A'
          + overlap sign(u) w + zero w,        w = sqrt(p_S - p_A) where u > 0, sqrt(p_A) elsewhere
    p_A = area p_B + mass a + coulomb sign(v) + viscous v + spring y + process [y > contact] + weight
    p_S = supply + droop_forward max(v, 0) + droop_backward min(v, 0)

The flow through an edge is exact (Merritt, *Hydraulic Control Systems*, 1967), so no load, no friction and no supply
is in the first equation. All columns pass one low-pass filter; p is relative to the healthy supply. Coefficients are
compared with those of healthy recordings, by how these scatter.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from servoscope.baseline.records import BaselineModel, Matrix, Vector
from servoscope.baseline.residual_model import MIN_COLUMN_SHARE
from servoscope.core import outofcore
from servoscope.core.arrays import FloatArray
from servoscope.models.plants.cylinder import CHANNELS
from servoscope.signals import Recording

FLOW = "forward", "backward", "lag", "leakage", "oil", "overlap", "zero"
FORCE = "mass", "coulomb", "viscous", "spring", "process", "weight"
SUPPLY = "supply", "droop_forward", "droop_backward"
EQUATIONS = FLOW, FORCE, SUPPLY
NAMES = (*FLOW, *FORCE, *SUPPLY)
FILTER_ORDER = 3
MOVING_SHARE = 0.05  # of the rms speed, from which on the sign of a speed is trusted
# by parameter of the plant, the powers of its ratio with which coefficients go
EXPONENTS: Mapping[str, Mapping[str, float]] = {
    "supply_pressure": {"supply": 1.0},
    "gain_forward": {"forward": -1.0},
    "gain_backward": {"backward": -1.0},
    "load": {"coulomb": 1.0, "viscous": 1.0},
    "acceleration": {"lag": 1.0},
    "jerk": {"oil": 1.0},
    "offset": {"zero": 1.0},
    **{name: {name: 1.0} for name in ("leakage", "overlap", "process")},
}
MIN_END_S = 5.0  # before an end of a recording: a change there is dated by less than its parts show
PIECE_S = 1.0  # of which sums are kept, so that any stretch of a recording is fitted without reading it again

Sums = tuple[FloatArray, ...]  # by equation, the products of its columns and its left side, shape (..., k + 1, k + 1)


class PressureLayout(BaselineModel):
    """What turns a recording into the columns of the equations."""

    cutoff: float  # of the low-pass filter [Hz]
    delay: float  # from u as logged to u acting [s]
    supply: float  # mean p_S when healthy, in the unit of the log
    speed: float  # rms when healthy [output per s]
    contact: float | None  # output beyond which a process force acts
    area: float = 0.0  # of the piston's side B over that of A; 0: not learned yet
    rms: Vector = ()  # of each column when healthy, in the order of `NAMES`

    def sums(self, recording: Recording) -> Sums:
        """Return the sums of a recording, piece by piece of `PIECE_S`: (pieces, k + 1, k + 1) by equation."""
        length, sums = max(round(PIECE_S * recording.sample_rate), 1), list[list[FloatArray]]()
        for rows in outofcore.iter_chunks(0, recording.samples):
            tables = list(self._tables(recording.rows(rows)))
            cuts = range(0, rows.stop - rows.start, length)
            sums.append([np.array([x[k : k + length].T @ x[k : k + length] for k in cuts]) for x in tables])
            outofcore.release(*recording.columns)
        flow, force, supply = (np.concatenate(parts) for parts in zip(*sums, strict=True))
        return flow, self._without_area(force), supply

    def _without_area(self, sums: FloatArray) -> FloatArray:
        """Return sums of the balance of forces, (..., k, k), with p_A - area p_B on its left: areas do not change."""
        if not self.area:
            return sums
        balance = np.eye(sums.shape[-1])[:, 1:]
        balance[0, -1] = -self.area
        return np.asarray(balance.T @ sums @ balance)

    def _tables(self, part: Recording) -> Iterator[FloatArray]:
        """Yield, by equation, the columns and behind them the left side, (N, k + 1); rows of no use are 0."""
        from scipy import signal

        rate = part.sample_rate
        lowpass = signal.butter(FILTER_ORDER, self.cutoff, fs=rate, output="sos")

        def smooth(x: FloatArray) -> FloatArray:
            return np.asarray(signal.sosfiltfilt(lowpass, x, axis=0, padlen=min(len(x) - 1, round(rate))))

        a, b, s = (part.channels[name] / self.supply for name in CHANNELS)
        y = smooth(part.y)
        v = np.gradient(y) * rate
        late = round(self.delay * rate)
        u = np.concatenate([np.repeat(part.u[:1], late), part.u[: len(y) - late]])
        root = np.sqrt(np.maximum(np.where(u > 0.0, s - a, a), 0.0))
        beyond = np.zeros_like(y) if self.contact is None else (part.y > self.contact) * 1.0
        speeds = [np.maximum(v, 0.0), np.minimum(v, 0.0)]
        ones, moving = np.ones_like(y), (np.abs(v) > MOVING_SHARE * self.speed)[:, None]
        flow, compressed = smooth(u * root), smooth(a)
        lag, oil = (np.gradient(x) * rate for x in (flow, compressed))
        filtered = smooth(np.column_stack([a - b, np.sign(u) * root, root, b, np.sign(v), beyond, s]))
        leak, overlap, zero, opposite, rubs, presses, supplied = filtered.T
        yield moving * np.column_stack([*speeds, lag, leak, oil, overlap, zero, flow])
        inertia = np.gradient(v) * rate
        yield moving * np.column_stack([opposite, inertia, rubs, v, y, presses, ones, compressed])
        yield np.column_stack([ones, *speeds, supplied])

    def coefficients(self, sums: Sums) -> FloatArray:
        """Return least squares on sums of a stretch, (k + 1, k + 1) each; NaN where a column is hardly there."""
        blocks, at = [], 0
        for S in sums:
            size, k = np.sqrt(np.diag(S)), len(S) - 1
            rms = np.array(self.rms[at : at + k]) if self.rms else np.zeros(k)
            known = np.flatnonzero(size[:k] > MIN_COLUMN_SHARE * rms * np.sqrt(self._rows(sums)))
            values = np.full(k, np.nan)
            if known.size:
                scaled = S / np.outer(size, size).clip(np.finfo(np.float64).tiny)
                solved = np.linalg.lstsq(scaled[np.ix_(known, known)], scaled[known, k], rcond=1e-12)[0]
                values[known] = solved * size[k] / size[known]
            blocks.append(values)
            at += k
        return np.concatenate(blocks)

    def _rows(self, sums: Sums) -> float:
        """Return the number of samples behind sums: the supply has a column of ones."""
        return float(sums[-1][0, 0])

    def with_columns_of(self, recordings: Sequence[Recording]) -> Self:
        """Return the layout with the areas of healthy recordings, and the rms that their columns have."""
        sums = [self.sums(recording) for recording in recordings]
        flow, force, supply = (np.vstack(parts).sum(axis=0) for parts in zip(*sums, strict=True))
        size = np.sqrt(np.diag(force)).clip(np.finfo(np.float64).tiny)
        scaled = force / np.outer(size, size)
        area = np.linalg.lstsq(scaled[:-1, :-1], scaled[:-1, -1], rcond=1e-12)[0][0] * size[-1] / size[0]
        known = self.model_copy(update={"area": float(area)})
        total = flow, known._without_area(force), supply
        squares = np.concatenate([np.diag(S)[:-1] for S in total]) / self._rows(total)
        return known.model_copy(update={"rms": tuple(np.sqrt(squares).tolist())})


class PressureModel(BaselineModel):
    """The coefficients of healthy recordings; everything that compares another recording with them."""

    layout: PressureLayout
    theta: Vector  # in the order of `NAMES`
    halves: Matrix  # covariance of those of half a recording, shape (n, n), n = 16
    shifts: Vector  # standard deviations of those of a second half less those of the first, shape (n,)
    rows: float  # samples of a recording, on average
    limits: tuple[float, float] = (1.0, 1.0)  # of the largest deviation, in standard deviations

    @cached_property
    def std(self) -> FloatArray:
        """Standard deviations of coefficients of half a recording or more."""
        return np.asarray(np.sqrt(np.diag(np.array(self.halves))))

    def evidence(self, recording: Recording) -> PressureEvidence | None:
        """Return what a recording shows; None where it lacks a pressure anywhere."""
        if not all(name in recording.channels and np.isfinite(recording.channels[name]).all() for name in CHANNELS):
            return None
        return PressureEvidence(self, self.layout.sums(recording))

    def ratios(self, sums: Sums) -> FloatArray:
        """Return the largest deviation of a recording, and of its second half from its first, over their limits."""
        first, second = halves(sums)
        whole = self.layout.coefficients(tuple(map(np.add, first, second)))
        moved = np.subtract(*map(self.layout.coefficients, (second, first)))
        scores = (whole - np.array(self.theta)) / self.std, moved / np.array(self.shifts)
        return np.array([np.nanmax(np.abs(score), initial=0.0) for score in scores]) / self.limits

    @property
    def detectable_changes(self) -> dict[str, float]:
        """The smallest changes that leave the limit, relative, by parameter; infinite where no recording shows it."""
        with np.errstate(divide="ignore"):
            sizes = dict(zip(NAMES, (self.limits[0] * self.std / np.abs(self.theta)).tolist(), strict=True))
        return {parameter: min(sizes[name] for name in powers) for parameter, powers in EXPONENTS.items()}

    def onset(self, sums: Sums) -> int:
        """Return the piece from which on one coefficient most likely changed: least squares on what is left.

        0: all of the recording is changed, as far as it can be told.
        """
        gains = []
        theta = np.split(np.array(self.theta), np.cumsum([len(names) for names in EQUATIONS])[:-1])
        for S, known in zip(sums, theta, strict=True):
            k = len(known)
            left = np.cumsum((S[:, :k, k] - S[:, :k, :k] @ known)[::-1], axis=0)[::-1]
            size = np.cumsum(np.diagonal(S, axis1=1, axis2=2)[::-1, :k], axis=0)[::-1]
            noise = max(float(np.einsum("i,nij,j->", np.append(-known, 1.0), S, np.append(-known, 1.0))), 1e-300)
            gains.append(left**2 / np.maximum(size, 1e-300) / noise)
        gain = np.hstack(gains)
        deviation = np.abs(self.layout.coefficients(tuple(S.sum(axis=0) for S in sums)) - self.theta) / self.std
        ends = round(MIN_END_S / PIECE_S)
        course = gain[:, int(np.nanargmax(deviation))]
        begin = int(np.argmax(course[: max(len(course) - ends, 1)]))
        return begin if begin >= ends else 0

    def stretch_covariance(self, rows: float) -> FloatArray:
        """Return the covariance (n, n) of coefficients of so many samples of a healthy recording."""
        return np.array(self.halves) * max(1.0, 0.5 * self.rows / max(rows, 1.0))


@dataclass(frozen=True, eq=False)
class PressureEvidence:
    """What the pressures of one recording show."""

    model: PressureModel
    sums: Sums

    @cached_property
    def excess(self) -> float:
        """The largest deviation over its limit."""
        return float(self.model.ratios(self.sums).max())


def halves(sums: Sums) -> tuple[Sums, Sums]:
    """Return the sums of a recording's first and second half."""
    middle = len(sums[0]) // 2
    return tuple(S[:middle].sum(axis=0) for S in sums), tuple(S[middle:].sum(axis=0) for S in sums)
