"""A block: some samples of one asset, numbered by its source so that each counts exactly once."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servoscope.errors import RecordingError
from servoscope.plants import FloatArray

__all__ = ["Block", "Resume"]


class Resume(NamedTuple):
    """Where an asset goes on: last sequence that was counted, when its first block began, its stream, its last sample.

    Times are [UTC s].
    """

    sequence: int
    began: float
    stream: int = 0
    t: float = math.nan


@dataclass(frozen=True, eq=False)
class Block:
    """Samples of one asset in the order in which they came.

    Parameters
    ----------
    asset
        Name of the asset.
    sequence
        Number of the block in the asset's stream: 0, 1, 2 ... A number that was counted before is a repetition,
        a number that is left out is a loss.
    t
        Time stamps [UTC s], shape (N,).
    r, u, y
        Reference, control input, measured output, shape (N,); NaN where a value is missing.
    due
        When its last sample had been taken, by the clock of `time.monotonic` [s]: latency counts from there.
    stream
        Name of the asset's stream, greater for a later one; 0: it has none, and there is only one.
    kept
        Whether its sender keeps it until it is known to be safe, and sends it again as long.
    """

    asset: str
    sequence: int
    t: FloatArray
    r: FloatArray
    u: FloatArray
    y: FloatArray
    due: float = 0.0
    stream: int = 0
    kept: bool = False

    def begins(self) -> float:
        """Return the time of its first sample that has one.

        Raises
        ------
        RecordingError
            If it is no block: empty, without time, or of signals of different lengths.
        """
        known = np.flatnonzero(np.isfinite(self.t)) if self.t.ndim == 1 else np.zeros(0, dtype=np.intp)
        if not known.size or any(signal.shape != self.t.shape for signal in (self.r, self.u, self.y)):
            raise RecordingError(f"{self.asset}: block {self.sequence}: t, r, u, y must have one length, t a number")
        return float(self.t[known[0]])

    @property
    def signals(self) -> FloatArray:
        """t, r, u and y as rows, shape (4, N)."""
        return np.stack([self.t, self.r, self.u, self.y])

    def digest(self, before: int = 0) -> int:
        """Return the CRC-32 of its samples, continued from that of the blocks before it."""
        return zlib.crc32(self.signals.tobytes(), before)

    def pack(self) -> bytes:
        """Return its samples as bytes that `unpack` turns back, bit by bit."""
        return self.signals.astype("<f8").tobytes()

    @classmethod
    def unpack(cls, asset: str, sequence: int, packed: bytes) -> Block:
        """Return a block from its samples as bytes.

        Raises
        ------
        RecordingError
            If these are no whole samples.
        """
        if len(packed) % 32:
            raise RecordingError(f"{asset}: block {sequence} in the store is torn: restart with --anew {asset}")
        t, r, u, y = np.frombuffer(packed, dtype="<f8").astype(np.float64).reshape(4, -1)
        return cls(asset, sequence, t, r, u, y)
