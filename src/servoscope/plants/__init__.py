"""Plants: physics behind the coefficients theta; a new plant is a new file in this folder."""

from __future__ import annotations

import functools
import importlib
import pkgutil
from collections.abc import Mapping
from typing import Any

from servoscope.errors import LoopError
from servoscope.plants.base import EXTRAS, Fault, FloatArray, Plant, StateSpace

__all__ = ["EXTRAS", "Fault", "FloatArray", "Plant", "StateSpace", "kinds", "parse", "plant_class"]


@functools.cache
def _classes() -> dict[str, type[Plant]]:
    for module in pkgutil.iter_modules(__path__):
        importlib.import_module(f"{__name__}.{module.name}")
    return {str(found.model_fields["kind"].default): found for found in sorted(Plant.__subclasses__(), key=str)}


def kinds() -> list[str]:
    """Return the kinds of plants that exist, sorted."""
    return sorted(_classes())


def plant_class(kind: object) -> type[Plant]:
    """Return the class of a kind.

    Raises
    ------
    LoopError
        If there is no such kind.
    """
    if not isinstance(kind, str) or kind not in _classes():
        raise LoopError(f"[plant] kind = {kind!r}: unknown, choose from {', '.join(kinds())}")
    return _classes()[kind]


def parse(mapping: Mapping[str, Any]) -> Plant:
    """Build the plant that a mapping describes, for example the table ``[plant]`` of a loop file.

    Raises
    ------
    LoopError
        If ``kind`` is missing or unknown.
    pydantic.ValidationError
        If another setting is missing, unknown or out of range.
    """
    if "kind" not in mapping:
        raise LoopError(f"[plant] kind: missing, choose from {', '.join(kinds())}")
    return plant_class(mapping["kind"]).model_validate(dict(mapping))
