"""What a source of blocks is: it offers what is due, again until that is acknowledged, and says when it has ended."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from servoscope.live.block import Block, Resume
from servoscope.live.refusals import Refusal

__all__ = ["Source"]


class Source(Protocol):
    """Streams of blocks of several assets, which never end, as a rule.

    A source is asked, not heard: a service that cannot keep up, or cannot store, stops asking. What it has taken and
    not acknowledged is offered again after a restart.
    """

    @property
    def pace(self) -> float:
        """How fast the clock of the samples runs: 1 for what is measured now; 0 where it waits for whoever asks."""

    def open(self, resume: Mapping[str, Resume]) -> None:
        """Begin; streams of assets in `resume` go on after the sequence that it names, others at their beginning."""

    def poll(self, most: int) -> list[Block]:
        """Return up to `most` blocks that are due and were not returned before, in the order of time; at once."""

    def acknowledge(self, asset: str, blocks: int) -> None:
        """Take note that so many more of an asset's blocks are safe, in the order in which they were polled."""

    def refused(self) -> list[Refusal]:
        """Return what came and could not be used, since the last call."""

    @property
    def up(self) -> bool:
        """Whether it is connected to where its blocks come from."""

    @property
    def waits(self) -> float:
        """How long until the next block may be due, in s; infinite where the source has ended."""

    def close(self) -> None:
        """Stop."""
