"""Pydantic's errors about settings as one line: section, key, what is wrong, what to do."""

from __future__ import annotations

import difflib
import types
from collections.abc import Collection, Iterable, Mapping
from datetime import datetime
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from servoscope.core.addresses import hide_secrets

TYPE_MESSAGES = {
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
BOUND_MESSAGES = {
    "gt": "must be greater than",
    "ge": "must be at least",
    "lt": "must be less than",
    "le": "must be at most",
}


def closest_names(name: str, known: Iterable[str], count: int = 1) -> list[str]:
    """Return up to `count` of the known names that look like `name`, whatever their case, best first."""
    folded = {candidate.casefold(): candidate for candidate in known}
    return [folded[match] for match in difflib.get_close_matches(name.casefold(), folded, n=count, cutoff=0.5)]


def suggest_name(name: str, known: Collection[str]) -> str:
    """Return a hint for an unknown name: the known one that looks like it, or all of them."""
    guess = closest_names(name, known)
    return f"did you mean {guess[0]!r}?" if guess else f"only {', '.join(known) or 'none yet'}"


def describe_error(error: ValidationError, model: type[BaseModel], section: str = "") -> str:
    """Describe the most specific of the errors in one line.

    `model` are the settings that were validated, of one `section` or, without a name, of a whole file.
    """
    # a misspelt key is reported twice, as unknown and as missing; the first report is the more specific one
    first = min(error.errors(include_url=False), key=lambda detail: detail["type"] != "extra_forbidden")
    place, owner = _resolve_location(model, first["loc"])
    path = ([section] if section else []) + [
        str(part) for part in place if not isinstance(part, int) and part != "[key]"
    ]
    entry = next((int(part) + 1 for part in place if isinstance(part, int)), None)
    if first["type"] in ("union_tag_invalid", "union_tag_not_found"):
        path.append(first["ctx"]["discriminator"].strip("'"))
    if not path or (path == [section] and first["type"] == "value_error"):
        return _one_line(f"[{section}] {_describe_detail(first)}" if section else _describe_detail(first))
    if entry is not None and first["type"] not in ("missing", "too_long", "too_short"):
        path[-1] += f", entry {entry}"
    key = path[0] if len(path) == 1 and not section else f"[{path[0]}] {'.'.join(path[1:])}".rstrip()
    if first["type"] == "extra_forbidden":
        return _one_line(f"{key}: {_describe_unknown_key(path, model, owner, section)}")
    if first["type"] == "missing" and entry is not None:
        return _one_line(f"{key}: has too few entries")
    if len(path) == 1 and not section and isinstance(first["input"], Mapping) and first["type"] == "missing":
        table = any(path[0] == name and _submodel(model, name) for name in model.model_fields) or path[0] == "plant"
        return f"[{path[0]}]: missing, add the section" if table else f"{key}: missing, add it"
    return _one_line(f"{key}: {_describe_detail(first)}")


def _resolve_location(model: type[BaseModel], loc: tuple[int | str, ...]) -> tuple[list[int | str], type[BaseModel]]:
    """Return a location without pydantic's tags of chosen models, and the innermost model."""
    place, owner = list[int | str](), model
    at: Any = model
    for part in loc:
        while get_origin(at) is Annotated:
            at = get_args(at)[0]
        united = get_args(at) if get_origin(at) in (Union, types.UnionType) else ()
        choices = [member for member in united if _is_model(member)]
        if not choices and len(set(united) - {types.NoneType}) > 1:
            at = Any  # of plain types, the part is pydantic's word for the one that it tried
            continue
        chosen = next((choice for choice in choices if part in _tags(choice)), None)
        if chosen is not None:
            owner = at = chosen
            continue
        place.append(part)
        if len(choices) == 1:
            at = choices[0]
        if _is_model(at):
            owner = at
            at = at.model_fields[part].annotation if part in at.model_fields else Any
        elif get_args(at):
            # the values of a table, the entries of a list
            at = [argument for argument in get_args(at) if argument is not ...][-1]
    return place, owner


def _is_model(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _tags(model: type[BaseModel]) -> set[Any]:
    kinds = (field.annotation for field in model.model_fields.values())
    return {tag for kind in kinds if get_origin(kind) is Literal for tag in get_args(kind)}


def _describe_unknown_key(path: list[str], model: type[BaseModel], owner: type[BaseModel], section: str) -> str:
    guess = closest_names(path[-1], owner.model_fields)
    if guess:
        return f"unknown key, did you mean {guess[0]!r}?"
    sections = () if section else model.model_fields
    for name in sections:
        if path[-1] in getattr(_submodel(model, name), "model_fields", ()):
            return f"unknown key here, it belongs in [{name}]"
    return f"unknown key, choose from {', '.join(owner.model_fields)}"


def _submodel(model: type[BaseModel], name: str) -> type[BaseModel] | None:
    field = model.model_fields.get(name)
    for candidate in (field.annotation, *getattr(field.annotation, "__args__", ())) if field else ():
        if isinstance(candidate, type) and issubclass(candidate, BaseModel):
            return candidate
    return None


def _describe_detail(detail: ErrorDetails) -> str:
    kind, value, context = detail["type"], detail["input"], detail.get("ctx", {})
    if kind in ("missing", "union_tag_not_found"):
        return "missing, add it"
    if kind == "value_error":
        return str(context.get("error", detail["msg"]))
    if kind in TYPE_MESSAGES:
        return f"{_format_value(value)} {TYPE_MESSAGES[kind]}"
    if kind == "literal_error":
        return f"{_format_value(value)} is not one of {context['expected']}"
    if kind == "union_tag_invalid":
        return f"{context['tag']!r} is not one of {context['expected_tags']}"
    if kind in ("too_long", "too_short"):
        bound = context.get("max_length", context.get("min_length"))
        relation = "at most" if kind == "too_long" else "at least"
        return f"has {context['actual_length']} entries, needs {relation} {bound}"
    if kind == "string_too_short":
        return "must not be empty"
    for short, words in BOUND_MESSAGES.items():
        if short in context:
            return f"{_format_value(value)} {words} {context[short]:g}"
    return f"{_format_value(value)}: {detail['msg']}"


def _format_value(value: Any) -> str:
    text = {True: "true", False: "false"}[value] if isinstance(value, bool) else repr(value)
    if isinstance(value, datetime):
        text = value.isoformat()
    text = hide_secrets(text)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _one_line(text: str) -> str:
    return " ".join(text.split())
