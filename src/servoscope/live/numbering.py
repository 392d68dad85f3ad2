"""Which blocks of an asset's stream are new, which were counted before, and how many are missing between them."""

from __future__ import annotations

from typing import NamedTuple

from servoscope.live.block import Block
from servoscope.live.checkpoint import Counted

__all__ = ["Place", "place"]


class Place(NamedTuple):
    """Where a new block stands: how many are missing before it, and whether its stream is another one."""

    lost: int
    anew: bool


def place(counted: Counted | None, block: Block) -> Place | None:
    """Return where a block stands behind what was counted; None: it was counted before, or its place has passed.

    Numbers of a named stream begin at 0, and a later stream has a greater name. A stream without a name is taken up
    wherever it is; where its numbers fall back while its time goes on, its sender has begun anew.
    """
    if counted is None:
        return Place(block.sequence if block.stream else 0, False)
    if block.stream == counted.stream and block.sequence > counted.sequence:
        return Place(block.sequence - counted.sequence - 1, False)
    if block.stream > counted.stream:
        return Place(block.sequence, True)
    if not block.kept and block.t[0] > counted.t:
        return Place(0, True)
    return None
