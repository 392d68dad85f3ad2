"""Public names by name, for methods of results that lead to packages above theirs: looked up when they are called."""

from __future__ import annotations

import sys
from typing import Any


def public_name(name: str) -> Any:
    """Return what ``servoscope.NAME`` is; the package is loaded whenever one of its modules is."""
    return getattr(sys.modules["servoscope"], name)
