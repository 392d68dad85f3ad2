"""An inbox whose messages are put into it by hand."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from servoscope.service.mapping.rows import MessageMapping
from servoscope.service.mapping.settings import PayloadSettings
from servoscope.service.sources.block import ResumePosition
from servoscope.service.sources.inbox import Inbox
from servoscope.service.sources.message import InboxMessage, RejectionCounter, SourceAsset, Transport

STUB = SourceAsset(SimpleNamespace(columns=SimpleNamespace(covariates={}), sample_rate=100.0), None)  # type: ignore[arg-type]


class HandTransport(Transport):
    """Receives what it is given."""

    keeps = False  # all is decoded at the next poll, whatever its limit

    def open(self, resume: Mapping[str, ResumePosition]) -> None:
        pass

    def close(self) -> None:
        pass


class HandInbox(Inbox):
    """An inbox for a plant's messages, which `add` hands over one by one."""

    def __init__(
        self,
        settings: PayloadSettings,
        assets: Mapping[str, SourceAsset],
        rejections: RejectionCounter | None = None,
        limit: int = 10**9,
    ) -> None:
        rejections = rejections or RejectionCounter()
        self.mapping = MessageMapping.of_assets(settings, assets, rejections)
        super().__init__(HandTransport(), self.mapping, assets, rejections, limit)

    def begin(self, resume: Mapping[str, ResumePosition] | None = None, state_file: Path | None = None) -> None:
        """Open it."""
        self.state_file = state_file
        self.open(resume or {})

    def add(self, address: str, content: bytes, release: Callable[[], Any], *, old: bool = False) -> None:
        """Take a message, and all that it leads to."""
        self.transport.waiting.append(InboxMessage(address, content, time.monotonic(), release, old))
        self.poll(0)
