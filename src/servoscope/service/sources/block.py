"""A block of samples as a source hands it over, and where a source continues after a restart."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import RecordingError

MAX_COUNT = 2**63 - 1  # what a database can count
MAX_TIME_S = 253402300800.0  # s: the year 10000, from which on calendars end
NO_COVARIATES = np.zeros((0, 0))


class ResumePosition(NamedTuple):
    """Where an asset continues: last sequence counted, start of its first block, stream, last sample; times [UTC s]."""

    sequence: int
    stream_start: float
    stream: int = 0
    last_t: float = math.nan


def covariate_tail(count: int) -> bytes:
    """Return what ends a packed block: a byte with the number of its covariates, nothing where it has none.

    Without it the length of a packed block is a multiple of eight.
    """
    return bytes([count] * (count > 0))


def split_covariate_tail(packed: bytes) -> tuple[bytes, int]:
    """Return a packed block without what `covariate_tail` has added, and the number of its covariates."""
    count = packed[-1] if len(packed) % 8 == 1 else 0
    return packed[:-1] if count else packed, count


@dataclass(frozen=True, eq=False)
class Block:
    """Samples of one asset in the order in which they came."""

    asset: str
    # 0, 1, 2 ... in the asset's stream; a number that was counted before is a repetition, one left out a loss
    sequence: int
    t: FloatArray  # time stamps [UTC s], shape (N,)
    r: FloatArray  # r, u, y: reference, control input, measured output, shape (N,); NaN where a value is missing
    u: FloatArray
    y: FloatArray
    completed_at: float = 0.0  # when its last sample was taken, by `time.monotonic` [s]: latency counts from there
    stream: int = 0  # name of the asset's stream, greater for a later one; 0: it has none, and there is only one
    # number of the oldest block that its sender keeps, and sends again, until it is acknowledged; None: it keeps none
    oldest: int | None = None
    # columns of what the healthy coefficients depend on, as the loop file names them, shape (k, N)
    covariates: FloatArray = field(default_factory=lambda: NO_COVARIATES)

    @property
    def retained(self) -> bool:
        """Whether its sender keeps it until it is acknowledged."""
        return self.oldest is not None

    def start_time(self) -> float:
        """Return the time of its first sample that has one.

        Raises RecordingError if it is no block: empty, without time, or of signals of different lengths.
        """
        if "signals" in vars(self) and self.t.size and math.isfinite(first := self.t.item(0)):
            return first  # rows of one array: nearly all blocks
        shape = self.t.shape
        known = np.flatnonzero(np.isfinite(self.t)) if len(shape) == 1 else np.zeros(0, dtype=np.intp)
        same = shape == self.r.shape == self.u.shape == self.y.shape
        if not known.size or not same or any(x.shape != shape for x in self.covariates):
            raise RecordingError(f"{self.asset}: block {self.sequence}: t, r, u, y must have one length, t a number")
        return float(self.t[known[0]])

    @property
    def shape(self) -> tuple[int, ...]:
        """How many signals and how many samples there are; raises RecordingError if it is no block."""
        if "signals" not in vars(self) or not self.t.size:
            self.start_time()
        return self.signals.shape

    def until(self, latest: float) -> Block | None:
        """Return it without the stamps of samples that claim to be later [UTC s]; None: all of them claim that."""
        if not np.fmax.reduce(self.t) > latest:
            return self
        future = self.t > latest
        return None if (future | ~np.isfinite(self.t)).all() else replace(self, t=np.where(future, np.nan, self.t))

    @classmethod
    def from_signals(
        cls,
        asset: str,
        sequence: int,
        signals: FloatArray,
        completed_at: float = 0.0,
        stream: int = 0,
        oldest: int | None = None,
    ) -> Block:
        """Return the block of t, r, u, y and the covariates as rows, shape (4 + k, N), which it keeps."""
        block = object.__new__(cls)  # checks nothing, in a third of the time
        vars(block).update(
            asset=asset,
            sequence=sequence,
            t=signals[0],
            r=signals[1],
            u=signals[2],
            y=signals[3],
            completed_at=completed_at,
            stream=stream,
            oldest=oldest,
            covariates=signals[4:] if len(signals) > 4 else NO_COVARIATES,
            signals=signals,
        )
        return block

    @cached_property
    def signals(self) -> FloatArray:
        """t, r, u, y and the covariates as rows, shape (4 + k, N)."""
        return np.stack([self.t, self.r, self.u, self.y, *self.covariates])

    def pack(self) -> bytes:
        """Return its samples as bytes, from which `unpack` restores them bit by bit."""
        return self.signals.astype("<f8", copy=False).tobytes() + covariate_tail(len(self.covariates))

    @classmethod
    def unpack(cls, asset: str, sequence: int, packed: bytes) -> Block:
        """Return the block of packed samples; raises RecordingError if they are not whole."""
        numbers, k = split_covariate_tail(packed)
        if len(numbers) % (8 * (4 + k)):
            raise RecordingError(f"{asset}: block {sequence} in the store is torn: restart with --anew {asset}")
        signals = np.frombuffer(numbers, dtype="<f8").astype(np.float64).reshape(4 + k, -1)
        return cls.from_signals(asset, sequence, signals)
