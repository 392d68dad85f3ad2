"""The newest blocks of an asset: what an examination or a full diagnosis may still need."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable

from servoscope.service.examination_schedule import PendingDiagnosis
from servoscope.service.sources.block import Block


class RecentBlocks:
    """The blocks of the last `span_s` seconds at `rate` samples per second, and older ones that a diagnosis awaits.

    Blocks carry the numbers under which the store has them, and are kept as they are stored: as bytes, which are shared
    with what is being written, and which are no work for the garbage collector: a fleet has millions of blocks.
    """

    def __init__(self, asset: str, span_s: float, rate: float, blocks: Iterable[Block] = ()) -> None:
        self._asset, self._span_s, self._most = asset, span_s, 2.0 * span_s * rate
        # number, first and last time [UTC s], how many samples, and these packed
        self._blocks = deque[tuple[int, float, float, int, bytes]]()
        self._samples = 0
        for one in blocks:
            self.append(one.sequence, one.t.item(0), one.t.item(-1), one.t.size, one.pack())

    def __len__(self) -> int:
        return len(self._blocks)

    @property
    def first_sequence(self) -> int | None:
        """The number of the first block; None if there is none."""
        return self._blocks[0][0] if self._blocks else None

    def append(self, sequence: int, first: float, last: float, size: int, packed: bytes) -> None:
        """Add a block that follows the others: its number, first and last time [UTC s], size, and packed samples."""
        self._blocks.append((sequence, first, last, size, packed))
        self._samples += size

    def begins_with(self, t: float) -> bool:
        """Whether one of the blocks begins at `t` [UTC s]."""
        return any(one[1] == t for one in self._blocks)

    def after(self, t: float) -> list[Block]:
        """Return the blocks that end after `t` [UTC s]."""
        return [self._unpack(one[0], one[4]) for one in self._blocks if one[2] > t]

    def within(self, pending: PendingDiagnosis) -> list[Block]:
        """Return the blocks that a full diagnosis looks at."""
        found = (one for one in self._blocks if one[0] >= pending.first and one[1] < pending.until)
        return [self._unpack(one[0], one[4]) for one in found]

    def trim(self, t: float, pending: Collection[PendingDiagnosis]) -> None:
        """Drop what is not needed at `t` [UTC s] any more; also where the clock was set back."""
        first = min(one.first for one in pending) if pending else None
        while self._blocks and (first is None or self._blocks[0][0] < first):
            if self._blocks[0][2] > t - self._span_s and self._samples <= self._most:
                return
            self._samples -= self._blocks.popleft()[3]

    def _unpack(self, sequence: int, packed: bytes) -> Block:
        return Block.unpack(self._asset, sequence, packed)
