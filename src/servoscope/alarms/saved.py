"""Saved states: plain dictionaries with a version, refused as a whole where they are not what they should be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from servoscope.errors import StateError

__all__ = ["whole"]


def whole(plain: Mapping[str, Any], kind: type[Any], version: int, what: str) -> dict[str, Any]:
    """Return the fields of a saved dataclass, without its version.

    Parameters
    ----------
    plain
        What was saved.
    kind
        The dataclass.
    version
        That this servoscope writes.
    what
        What the state is called.

    Raises
    ------
    StateError
        If it is of another version, or is not whole.
    """
    found = plain.get("version")
    if found != version:
        raise StateError(f"{what} of version {found!r}, this servoscope reads {version}: use that which wrote it")
    if set(plain) != {each.name for each in fields(kind)} | {"version"}:
        raise StateError(f"{what} is not whole: restore it from a copy, or remove it to begin anew")
    return {key: value for key, value in plain.items() if key != "version"}
