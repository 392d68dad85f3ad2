"""What an outlet is: it tells others how assets are, each time that this has been stored."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

__all__ = ["Outlet", "Statuses"]

Statuses = Mapping[str, Mapping[str, Any]]  # by asset, and by the name of the service: what `watch --json` shows


class Outlet(Protocol):
    """Somewhere to look at assets from outside.

    It tells how things are, not what has happened: what was not heard is made up for by the next look.
    """

    def open(self, statuses: Statuses) -> None:
        """Begin with what the store holds."""

    def tell(self, statuses: Statuses) -> None:
        """Take what has been stored; at once, and without an exception: nobody waits for those who look."""

    def close(self) -> None:
        """Stop."""
