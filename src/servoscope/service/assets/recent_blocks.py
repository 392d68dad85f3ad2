"""The newest blocks of an asset: what an examination or a full diagnosis may still need."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable
from itertools import groupby

import numpy as np

from servoscope.service.assets.examination_schedule import PendingDiagnosis
from servoscope.service.sources.block import Block
from servoscope.service.store.bundles import pack_samples, restore_times

# number, first and last time [UTC s], how many samples, and these as `pack_samples` returns them; plain, as the garbage
# collector skips these
PackedBlock = tuple[int, float, float, int, bytes, bool]


class RecentBlocks:
    """The blocks of the last `span_s` seconds at `rate` samples per second, and older ones that a diagnosis awaits.

    Blocks carry the numbers under which the store has them, and are kept as they are stored: as bytes, which are shared
    with what is being written, and which are no work for the garbage collector: a fleet has millions of blocks.
    """

    def __init__(self, asset: str, span_s: float, rate: float, blocks: Iterable[Block] = ()) -> None:
        self._asset, self._span_s, self._most = asset, span_s, 2.0 * span_s * rate
        self._blocks = deque[PackedBlock]()
        self._samples = 0
        for _, alike in groupby(blocks, key=lambda block: block.signals.shape):
            own = list(alike)
            for block, packed in zip(own, pack_samples(np.stack([block.signals for block in own])), strict=True):
                self.append((block.sequence, block.t.item(0), block.t.item(-1), block.t.size, *packed))

    def __len__(self) -> int:
        return len(self._blocks)

    @property
    def first_sequence(self) -> int | None:
        """The number of the first block; None if there is none."""
        return self._blocks[0][0] if self._blocks else None

    def append(self, block: PackedBlock) -> None:
        """Add a block that follows the others."""
        self._blocks.append(block)
        self._samples += block[3]

    def begins_with(self, t: float) -> bool:
        """Whether one of the blocks begins at `t` [UTC s]."""
        return any(block[1] == t for block in self._blocks)

    def after(self, t: float) -> list[Block]:
        """Return the blocks that end after `t` [UTC s]."""
        return [self._unpack(block[0], *block[4:]) for block in self._blocks if block[2] > t]

    def within(self, pending: PendingDiagnosis) -> list[Block]:
        """Return the blocks that a full diagnosis looks at."""
        generator = (block for block in self._blocks if block[0] >= pending.first and block[1] < pending.until)
        return [self._unpack(entry[0], *entry[4:]) for entry in generator]

    def trim(self, t: float, pending: Collection[PendingDiagnosis]) -> None:
        """Drop what is not needed at `t` [UTC s] any more; also where the clock was set back."""
        first, begin, blocks = (
            min(diagnosis.first for diagnosis in pending) if pending else None,
            t - self._span_s,
            self._blocks,
        )
        while blocks and (first is None or blocks[0][0] < first):
            if blocks[0][2] > begin and self._samples <= self._most:
                return
            self._samples -= blocks.popleft()[3]

    def _unpack(self, sequence: int, packed: bytes, regular: bool) -> Block:
        return Block.unpack(self._asset, sequence, restore_times(packed) if regular else packed)
