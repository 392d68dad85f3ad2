"""Import paths of earlier versions, which still lead to their modules."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

ALIASES = {
    "servoscope.loop": "servoscope.models.loop",
    "servoscope.errors": "servoscope.core.errors",
    "servoscope.scoring": "servoscope.research.scoring",
    "servoscope.fleet.spark": "servoscope.fleet.spark",
    "servoscope.fleet.sinks": "servoscope.fleet.sinks",
}


class _Finder(MetaPathFinder, Loader):
    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(fullname, self) if fullname in ALIASES else None

    def exec_module(self, module: ModuleType) -> None:
        # the import system takes the module from here, so both names are one module with one set of classes
        sys.modules[module.__name__] = importlib.import_module(ALIASES[module.__name__])


def install() -> None:
    """Add the paths of earlier versions to the import system."""
    sys.meta_path.append(_Finder())
