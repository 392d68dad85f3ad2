"""What a table ``[sources.NAME]`` has in common, whichever kind it is of."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

from pydantic import PrivateAttr

from servoscope.core.settings import Settings
from servoscope.service.sources.inbox import Inbox
from servoscope.service.sources.message import SourceAsset


class SourceSettings(Settings):
    """A table ``[sources.NAME]``; a subclass adds the keys of its kind and says which source it creates."""

    asset_key: ClassVar[str] = ""  # the key of ``[assets.NAME]`` under which such a source finds an asset; empty: none
    asset_example: ClassVar[str] = ""  # what to write there
    visit_changes: ClassVar[Mapping[str, Any]] = {}  # values of keys for a client that only listens for a while
    _is_visit: bool = PrivateAttr(default=False)

    kind: str

    def identity(self, name: str) -> str:
        """Return what no other source or outlet may share, in words; empty: nothing. `name`: as in `create`."""
        return ""

    def for_visit(self) -> Self:
        """Return the settings of a client that only listens for a while, beside a service that runs."""
        visit = self.model_copy(update=self.visit_changes)
        visit._is_visit = True
        return visit

    @property
    def is_visit(self) -> bool:
        """Whether the client only listens, and may hear what is not for its assets, too."""
        return self._is_visit

    @property
    def pause_s(self) -> float:
        """How long an asset may pause, as a rule, without being silent [s]."""
        return 0.0

    @property
    def is_exclusive(self) -> bool:
        """Whether one process has to follow all its assets."""
        return False

    def carries(self, covariate: str, address: Any) -> bool:
        """Return whether blocks of an asset carry a covariate; `address`: the value of `asset_key`, if there is one."""
        return False

    def create(self, name: str, assets: Mapping[str, SourceAsset], folder: Path) -> Inbox:
        """Return the source, not yet open; `name` is unique among services, paths are relative to `folder`.

        Raises ConfigError if something that the settings name cannot be used.
        """
        raise NotImplementedError
