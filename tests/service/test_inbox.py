"""What the inbox does for every transport: it looks in order, bounds the blocks that wait, and releases messages."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from brokers import BEGAN
from inboxes import STUB, HandTransport

from servoscope.service.sources import inbox as inbox_module
from servoscope.service.sources.block import Block
from servoscope.service.sources.inbox import Inbox
from servoscope.service.sources.message import BlockDecoder, InboxMessage


def message(sequence: int, released: list[int] | None = None) -> InboxMessage:
    """Return a message that is a block of one sample."""
    block = Block("press", sequence, np.array([BEGAN + sequence]), *np.ones((3, 1)))
    return InboxMessage("press", block, 0.0, lambda: None if released is None else released.append(sequence))


def test_a_message_that_is_handed_over_while_the_pause_is_asked_for_is_seen() -> None:
    """Else an asset whose file has just been read would be silent."""

    class Busy(HandTransport):
        looks = 0

        @property
        def pause_s(self) -> float:  # type: ignore[override]
            self.looks += 1
            if self.looks > 1:
                self.waiting.append(message(0))
            return math.inf if self.looks == 1 else 5.0

    source = Inbox(Busy(), BlockDecoder(), {"press": STUB})
    assert source.pause_s == math.inf and source.pause_s == math.inf


def test_blocks_that_cannot_come_again_wait_up_to_a_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inbox_module, "MAX_READY", 5)
    source = Inbox(HandTransport(), BlockDecoder(), {"press": STUB})
    source.open({})
    for k in range(8):
        source.transport.waiting.append(message(k))
        assert source.poll(0) == []
    assert [block.sequence for block in source.poll(100)] == [3, 4, 5, 6, 7]
    source.acknowledge("press", 5)
    (found,) = source.rejections.take()
    assert (found.asset, found.kind, found.count) == ("press", "overflow", 3)


def test_a_message_is_released_when_its_block_is_stored_and_without_another_poll() -> None:
    class Keeping(HandTransport):
        keeps = True

    released: list[int] = []
    source: Any = Inbox(Keeping(), BlockDecoder(), {"press": STUB})
    source.open({})
    source.transport.waiting.extend(message(k, released) for k in range(4))
    assert source.poll(0) == [] and len(source.transport.waiting) == 4  # they wait where they are kept
    assert [block.sequence for block in source.poll(3)] == [0, 1, 2] and not released
    source.acknowledge("press", 3)
    assert released == [0, 1, 2]
