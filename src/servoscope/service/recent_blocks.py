"""The newest blocks of an asset: what an examination or a full diagnosis may still need."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from servoscope.service.examination_schedule import PendingDiagnosis
from servoscope.service.sources.block import Block


class RecentBlocks:
    """The blocks of the last `span_s` seconds at `rate` samples per second, and older ones that a diagnosis awaits.

    Blocks carry the numbers under which the store has them.
    """

    def __init__(self, span_s: float, rate: float, blocks: Iterable[Block] = ()) -> None:
        self._span_s, self._most = span_s, 2.0 * span_s * rate
        self._blocks = deque(blocks)
        self._samples = sum(one.t.size for one in self._blocks)

    def __len__(self) -> int:
        return len(self._blocks)

    @property
    def first_sequence(self) -> int | None:
        """The number of the first block; None if there is none."""
        return self._blocks[0].sequence if self._blocks else None

    def append(self, block: Block) -> None:
        """Add a block that follows the others."""
        self._blocks.append(block)
        self._samples += block.t.size

    def begins_with(self, t: float) -> bool:
        """Whether one of the blocks begins at `t` [UTC s]."""
        return any(one.t[0] == t for one in self._blocks)

    def after(self, t: float) -> list[Block]:
        """Return the blocks that end after `t` [UTC s]."""
        return [one for one in self._blocks if one.t[-1] > t]

    def within(self, pending: PendingDiagnosis) -> list[Block]:
        """Return the blocks that a full diagnosis looks at."""
        return [one for one in self._blocks if one.sequence >= pending.first and one.t[0] < pending.until]

    def trim(self, t: float, pending: Iterable[PendingDiagnosis]) -> None:
        """Drop what is not needed at `t` [UTC s] any more; also where the clock was set back."""
        first = min((one.first for one in pending), default=None)
        while self._blocks and (first is None or self._blocks[0].sequence < first):
            if self._blocks[0].t[-1] > t - self._span_s and self._samples <= self._most:
                return
            self._samples -= self._blocks.popleft().t.size
