"""An arm's log as a regression: torques and columns behind one filter, and what each stretch of time says of changes.

Both sides of the regression pass the same zero-phase low-pass (parallel filtering: Gautier and Poignet, Extended
Kalman filtering and weighted least squares dynamic identification of robot, 2001). Samples of a joint that rests have
no weight: friction at rest is not known.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servoscope.arm.log import ArmRecording
from servoscope.arm.model import ArmModel
from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.errors import NotEnoughError

FILTER_ORDER = 3
MOTION_CUTOFF = 2.0  # times the cutoff: of the filter on positions, before they are differentiated
KEPT_RATE = 10.0  # times the cutoff: rate of the rows that are kept
MAX_PIECE_S = 120.0  # of a log that is filtered at once
EDGE = 1.0  # over the cutoff [s]: at both ends of a stretch, where a zero-phase filter is not settled
REST_SPAN_S = 0.3  # a joint that has been slow for twice as long rests
SETTLING = 1.0  # over the cutoff [s]: beside a rest, where the filter still holds what friction was at rest
MIN_MOVING_S = 2.0  # of a joint that moves
ANGLE_STEP = 1e-4  # rad or m: of the difference quotient that is the direction of an encoder's offset
MAX_BLOCKS = 600  # in which a recording is divided
BLOCK_S = 1.0
# times (M,), columns (n, D, M) and residuals (n, M), as `block_information` has them
Rows = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class ArmSignals:
    """Filtered rows of a log: `tau` (n, M) and its columns (n, P, M), all with the joints first and time last."""

    t: FloatArray  # (M,) [s]
    q: FloatArray  # (M, n)
    v: FloatArray  # (M, n)
    a: FloatArray  # (M, n)
    tau: FloatArray  # (n, M)
    columns: FloatArray  # (n, P, M) of `ArmModel.columns`
    mass: FloatArray  # (n, 4, M) of a mass at the last joint
    moving: BoolArray  # (n, M)
    temperature: FloatArray  # (M, n)
    tool: FloatArray  # (M,) [kg]

    def weighted(self, columns: FloatArray, residual: FloatArray, std: FloatArray) -> Rows:
        """Return columns and residual over a standard deviation (n,), 0 where a joint rests."""
        w = self.moving / std[:, None]
        return self.t, columns * w[:, None], residual * w


def filter_arm_log(recording: ArmRecording, model: ArmModel) -> ArmSignals:
    """Return the filtered rows of a log; raises NotEnoughError if all of its stretches are too short."""
    pieces = list(_filter_pieces(recording, model))
    if not pieces:
        raise NotEnoughError(f"{recording.name}: falls into stretches that are too short for cutoff, log without gaps")
    by_row = ("t", "q", "v", "a", "temperature", "tool")
    names = ArmSignals.__dataclass_fields__
    return ArmSignals(
        **{
            name: np.concatenate([getattr(piece, name) for piece in pieces], axis=0 if name in by_row else -1)
            for name in names
        }
    )


def _filter_pieces(recording: ArmRecording, model: ArmModel) -> Iterator[ArmSignals]:
    from scipy.ndimage import maximum_filter1d, minimum_filter1d
    from scipy.signal import butter, sosfiltfilt

    loop, rate = model.loop, recording.sample_rate
    of_motion, low_pass = (
        butter(FILTER_ORDER, factor * loop.cutoff, fs=rate, output="sos") for factor in (MOTION_CUTOFF, 1.0)
    )
    edge, every = round(EDGE / loop.cutoff * rate), max(1, int(rate / (KEPT_RATE * loop.cutoff)))
    ends = (*recording.begins[1:], recording.t.size)
    longest = int(MAX_PIECE_S * rate)
    for begin, end in zip(recording.begins, ends, strict=True):
        count = -(-(end - begin) // longest)
        cuts = np.linspace(begin, end, count + 1).astype(int)
        for first, last in itertools.pairwise(cuts):
            rows = slice(max(begin, first - edge), min(end, last + edge))
            if rows.stop - rows.start < 4 * edge:
                continue
            q = sosfiltfilt(of_motion, recording.q[rows], axis=0)
            v = np.gradient(q, 1.0 / rate, axis=0)
            if recording.velocity is not None:
                v = sosfiltfilt(of_motion, recording.velocity[rows], axis=0)
            a = np.gradient(v, 1.0 / rate, axis=0)
            columns, mass = model.columns(q, v, a)
            moving = np.abs(v) > loop.rest_speed
            bridged, settled = round(REST_SPAN_S * rate), round((REST_SPAN_S + SETTLING / loop.cutoff) * rate)
            moving = maximum_filter1d(moving, 2 * bridged + 1, axis=0)
            moving = minimum_filter1d(moving, 2 * settled + 1, axis=0)
            kept = slice(edge, rows.stop - rows.start - edge, every)
            yield ArmSignals(
                recording.t[rows][kept],
                q[kept],
                v[kept],
                a[kept],
                sosfiltfilt(low_pass, recording.torque[rows], axis=0)[kept].T,
                sosfiltfilt(low_pass, columns, axis=2)[:, :, kept],
                sosfiltfilt(low_pass, mass, axis=2)[:, :, kept],
                moving[kept].T,
                recording.temperature[rows][kept],
                recording.tool[rows][kept],
            )


class Information(NamedTuple):
    """What each block of time says of D columns: information matrices (K, D, D) and vectors (K, D) of least squares.

    `t`: where the blocks begin, and where the last one ends (K + 1,) [s].
    """

    t: FloatArray
    A: FloatArray
    g: FloatArray

    def part(self, columns: slice) -> Information:
        """Return the information of some of the columns alone."""
        return Information(self.t, self.A[:, columns, columns], self.g[:, columns])


def block_information(
    t: FloatArray,
    columns: FloatArray,
    residual: FloatArray,
    block_s: float = BLOCK_S,
    edges: FloatArray | None = None,
) -> Information:
    """Return the information of the blocks of a recording.

    `t`: (M,) [s]; `columns`: (n, D, M) and `residual`: (n, M), both over the residual's standard deviation, 0 where a
    sample has no weight, of which at least one must have some; `block_s`: length of a block [s], longer in long
    recordings; `edges`: where blocks begin instead, but for the first [s].
    """
    length = max(block_s, float(t[-1] - t[0]) / MAX_BLOCKS)
    used = columns.any((0, 1))
    t, columns, residual = t[used], columns[:, :, used], residual[:, used]
    number = np.floor((t - t[0]) / length).astype(int) if edges is None else np.searchsorted(edges, t, side="right")
    cuts = np.append(np.flatnonzero(np.diff(number, prepend=-1)), t.size)
    A, g = [], []
    for first, end in itertools.pairwise(cuts):
        X = columns[:, :, first:end].transpose(1, 0, 2).reshape(columns.shape[1], -1)
        A.append(X @ X.T)
        g.append(X @ residual[:, first:end].ravel())
    return Information(np.append(t[cuts[:-1]], t[-1]), np.array(A), np.array(g))
