"""The source files of servoscope, as the rules of its structure read them."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType

PROJECT = Path(__file__).resolve().parents[2]
PACKAGE = PROJECT / "src" / "servoscope"


def load(path: Path) -> ModuleType:
    """Import a script by its path."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # where dataclasses look for the types of their fields
    spec.loader.exec_module(module)
    return module


house = load(PROJECT / "scripts" / "house.py")
SOURCES = house.read(PACKAGE)


def listing(lines: Iterable[str]) -> str:
    return "".join(f"\n  {line}" for line in lines)
