"""Turns what pydantic finds wrong with settings into one line: section, key, what is wrong, what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from datetime import datetime
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

__all__ = ["describe", "nearest"]

TYPES = {
    "float_type": "is not a number",
    "int_type": "is not a whole number",
    "string_type": "is not text, put it in quotes",
    "bool_type": "is not true or false",
    "tuple_type": "is not a list, write [ ... ]",
    "dict_type": "is not a table",
    "model_type": "is not a table of settings",
    "model_attributes_type": "is not a table of settings",
    "finite_number": "is not a finite number",
    "timezone_aware": "has no time zone, write it as in 2026-01-31T12:00:00Z",
    "datetime_type": "is not a time, write it as in 2026-01-31T12:00:00Z",
    "datetime_parsing": "is not a time, write it as in 2026-01-31T12:00:00Z",
    "datetime_from_date_parsing": "is not a time, write it as in 2026-01-31T12:00:00Z",
}
RELATIONS = {
    "gt": "must be greater than",
    "ge": "must be at least",
    "lt": "must be less than",
    "le": "must be at most",
}


def nearest(name: str, known: Iterable[str], count: int = 1) -> list[str]:
    """Return up to `count` of the known names that look like `name`, whatever their case, best first."""
    folded = {candidate.casefold(): candidate for candidate in known}
    return [folded[match] for match in difflib.get_close_matches(name.casefold(), folded, n=count, cutoff=0.5)]


def describe(error: ValidationError, model: type[BaseModel], section: str = "") -> str:
    """Describe the most telling of the errors in one line.

    Parameters
    ----------
    error
        What pydantic raised.
    model
        The settings that were validated; its keys are offered in place of unknown ones.
    section
        Name of the section that `model` describes, empty for a whole file.
    """
    found = error.errors(include_url=False)
    # A misspelt key is reported twice, as unknown and as missing: the first says more.
    first = min(found, key=lambda detail: detail["type"] != "extra_forbidden")
    words = [str(part) for part in first["loc"] if not isinstance(part, int) and part != "[key]"]
    path = ([section] if section else []) + words
    entry = next((int(part) + 1 for part in first["loc"] if isinstance(part, int)), None)
    if not path or (path == [section] and first["type"] == "value_error"):
        return _one_line(f"[{section}] {_text(first)}" if section else _text(first))
    if entry is not None and first["type"] not in ("missing", "too_long", "too_short"):
        path[-1] += f", entry {entry}"
    key = path[0] if len(path) == 1 and not section else f"[{path[0]}] {'.'.join(path[1:])}".rstrip()
    if first["type"] == "extra_forbidden":
        return _one_line(f"{key}: {_unknown(path, model, section)}")
    if first["type"] == "missing" and entry is not None:
        return _one_line(f"{key}: has too few entries")
    if len(path) == 1 and not section and isinstance(first["input"], Mapping) and first["type"] == "missing":
        table = any(path[0] == name and _submodel(model, name) for name in model.model_fields) or path[0] == "plant"
        return f"[{path[0]}]: missing, add the section" if table else f"{key}: missing, add it"
    return _one_line(f"{key}: {_text(first)}")


def _unknown(path: list[str], model: type[BaseModel], section: str) -> str:
    parents = path[1:-1] if section else path[:-1]
    owner: type[BaseModel] = model
    for name in parents:
        owner = _submodel(owner, name) or owner
    guess = nearest(path[-1], owner.model_fields)
    if guess:
        return f"unknown key, did you mean {guess[0]!r}?"
    homes = (
        []
        if section
        else [n for n in model.model_fields if path[-1] in getattr(_submodel(model, n), "model_fields", ())]
    )
    if homes:
        return f"unknown key here, it belongs in [{homes[0]}]"
    return f"unknown key, choose from {', '.join(owner.model_fields)}"


def _submodel(model: type[BaseModel], name: str) -> type[BaseModel] | None:
    field = model.model_fields.get(name)
    for candidate in (field.annotation, *getattr(field.annotation, "__args__", ())) if field else ():
        if isinstance(candidate, type) and issubclass(candidate, BaseModel):
            return candidate
    return None


def _text(detail: ErrorDetails) -> str:
    kind, value, context = detail["type"], detail["input"], detail.get("ctx", {})
    if kind == "missing":
        return "missing, add it"
    if kind == "value_error":
        return str(context.get("error", detail["msg"]))
    if kind in TYPES:
        return f"{_shown(value)} {TYPES[kind]}"
    if kind == "literal_error":
        return f"{_shown(value)} is not one of {context['expected']}"
    if kind in ("too_long", "too_short"):
        bound = context.get("max_length", context.get("min_length"))
        relation = "at most" if kind == "too_long" else "at least"
        return f"has {context['actual_length']} entries, needs {relation} {bound}"
    if kind == "string_too_short":
        return "must not be empty"
    for short, words in RELATIONS.items():
        if short in context:
            return f"{_shown(value)} {words} {context[short]:g}"
    return f"{_shown(value)}: {detail['msg']}"


def _shown(value: Any) -> str:
    text = {True: "true", False: "false"}[value] if isinstance(value, bool) else repr(value)
    if isinstance(value, datetime):
        text = value.isoformat()
    return text if len(text) <= 60 else f"{text[:57]}..."


def _one_line(text: str) -> str:
    return " ".join(text.split())
