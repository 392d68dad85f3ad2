"""What a publisher is: it shows others how the assets are, each time that this has been stored."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Protocol

from servoscope.core.settings import Settings

StatusByAsset = Mapping[str, Mapping[str, Any]]  # by asset, and by the name of the service: what `watch --json` shows


class AlarmCommand(NamedTuple):
    """What an operator commands an alarm at the system that shows it, executed and audited like any other command."""

    asset: str  # or the name of the service
    alarm: str
    command: str  # one of `COMMANDS`
    who: str
    reason: str = ""
    for_s: float | None = None  # how long to shelve [s]


class StatusPublisher(Protocol):
    """Shows how assets are now, not what has happened: who missed a status reads the next one.

    One that takes commands has `take_requests`, which returns each `AlarmCommand` once; one that can be cut off has
    `trouble`, in words.
    """

    def open(self, statuses: StatusByAsset) -> None:
        """Start with what the store holds; raises ConfigError or SourceError if that is impossible."""

    def publish(self, statuses: StatusByAsset) -> None:
        """Take statuses that have been stored; it must neither block nor raise, for it runs between two blocks."""

    def close(self) -> None:
        """Stop; it may be called twice."""


class PublisherSettings(Settings):
    """A table ``[outlets.NAME]``; a subclass adds the keys of its kind and says which publisher it creates."""

    listens: ClassVar[bool] = False  # whether it answers at an address, which one process has alone

    kind: str

    def identity(self, name: str) -> str:
        """Return what no other source or outlet may share, in words; empty: nothing. `name`: as in `create`."""
        return ""

    def create(self, name: str, folder: Path) -> StatusPublisher:
        """Return the publisher, not yet open; `name` is unique among services, paths are relative to `folder`.

        Raises ConfigError if something that the settings name cannot be used.
        """
        raise NotImplementedError
