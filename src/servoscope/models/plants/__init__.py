"""Plants: physics behind the coefficients theta; a new plant is a new file in this folder, or another package's."""

from __future__ import annotations

import contextlib
import functools
import importlib
import inspect
import pkgutil
from collections.abc import Mapping
from importlib.metadata import entry_points
from typing import Any

from servoscope.core.errors import LoopError
from servoscope.core.messages import add_words
from servoscope.models.plants.base import SIGN_CUTOFF, Fault, FaultRay, Plant, StateSpace, VelocitySign
from servoscope.models.plants.columns import Column

__all__ = [
    "SIGN_CUTOFF",
    "Column",
    "Fault",
    "FaultRay",
    "Plant",
    "StateSpace",
    "VelocitySign",
    "parse_plant",
    "plant_class",
    "plant_kinds",
]

ENTRY_POINTS = "servoscope.plants"  # of other packages: name is the kind, object the subclass of `Plant`


@functools.cache
def _built_in() -> dict[str, type[Plant]]:
    modules = [
        importlib.import_module(f"{__name__}.{module_info.name}") for module_info in pkgutil.iter_modules(__path__)
    ]
    classes = {member for module in modules for member in vars(module).values() if isinstance(member, type)}
    plants = [candidate for candidate in classes if issubclass(candidate, Plant) and not inspect.isabstract(candidate)]
    return {str(plant.model_fields["kind"].default): plant for plant in plants}


def plant_kinds() -> list[str]:
    """Return the kinds of plants that exist, sorted."""
    return sorted({*_built_in(), *entry_points(group=ENTRY_POINTS).names})


def plant_class(kind: object) -> type[Plant]:
    """Return the class of a kind.

    Raises LoopError if there is no such kind.
    """
    if isinstance(kind, str) and kind in _built_in():
        return _built_in()[kind]
    point = next((point for point in entry_points(group=ENTRY_POINTS) if point.name == kind), None)
    if point is None:
        raise LoopError(f"[plant] kind = {kind!r}: unknown, choose from {', '.join(plant_kinds())}")
    try:
        loaded: type[Plant] = point.load()
    except Exception as error:  # whatever another package raises
        raise LoopError(f"[plant] kind = {kind!r}: its package is broken, repair or remove it ({error})") from error
    return loaded


def translated_words(language: str) -> dict[str, str]:
    """Return the words of all plants in a language by their English; those of plants in this folder come first."""
    words: dict[str, str] = {}
    for kind in [*entry_points(group=ENTRY_POINTS).names, *_built_in()]:
        with contextlib.suppress(LoopError):  # it matters to loops of that plant alone
            words |= plant_class(kind).translations.get(language, {})
    return words


add_words(translated_words)


def parse_plant(mapping: Mapping[str, Any]) -> Plant:
    """Build the plant that a mapping describes, for example the table ``[plant]`` of a loop file.

    Raises LoopError if ``kind`` is missing or unknown; raises pydantic.ValidationError if another setting is
    missing, unknown or out of range.
    """
    if "kind" not in mapping:
        raise LoopError(f"[plant] kind: missing, choose from {', '.join(plant_kinds())}")
    return plant_class(mapping["kind"]).model_validate(dict(mapping))
