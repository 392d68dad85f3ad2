"""The reference pages are complete: each command, option, loop-file key and public name has its line.

The names come from the code, so a new one fails here until it is documented. A line counts when it names the
thing in backticks, in the section that it belongs to.
"""

from __future__ import annotations

import inspect
import re
import tomllib
import typing
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer.main
from pydantic import BaseModel, TypeAdapter
from pydantic.fields import FieldInfo

import servoscope

REFERENCE = Path(__file__).resolve().parents[2] / "docs" / "reference"


@cache
def page(name: str) -> str:
    path = REFERENCE / name
    assert path.is_file(), f"docs/reference/{name} is missing"
    return path.read_text(encoding="utf-8")


def sections(name: str) -> dict[str, str]:
    """Split a page at its headings of any depth: heading -> text; what stands before the first is ""."""
    parts = re.split(r"^#+ +(.*)$", "\n" + page(name), flags=re.MULTILINE)
    return {"": parts[0], **dict(zip(parts[1::2], parts[2::2], strict=True))}


def section(name: str, *patterns: str) -> str | None:
    """Return the section whose heading, without its backticks, has all the patterns, or None."""
    found = [
        text
        for heading, text in sections(name).items()
        if all(re.search(pattern, heading.replace("`", "")) for pattern in patterns)
    ]
    assert len(found) <= 1, f"docs/reference/{name} has {len(found)} headings with {' and '.join(patterns)}"
    return found[0] if found else None


def has_line(text: str, name: str) -> bool:
    """Tell whether a name, perhaps with its arguments or its short form beside it, stands in backticks."""
    return re.search(rf"`(?:[^`\n]*[\s,./])?{re.escape(name)}(?![\w-])[^`\n]*`", text) is not None


def commands() -> Iterator[tuple[str, typing.Any]]:
    """Yield each command as it is typed, without the program's name, and what it takes."""
    import servoscope.cli

    apps = [value for value in vars(servoscope.cli).values() if isinstance(value, typer.Typer)]
    assert apps, "servoscope.cli has no typer.Typer"
    # The outermost one is that which no other contains.
    inner = {id(group.typer_instance) for app in apps for group in app.registered_groups}
    (top,) = {id(app): app for app in apps if id(app) not in inner}.values()

    def walk(command: typing.Any, words: tuple[str, ...]) -> Iterator[tuple[str, typing.Any]]:
        children = getattr(command, "commands", None)
        if children is None:
            yield " ".join(words), command
            return
        for name, child in children.items():
            if not child.hidden:
                yield from walk(child, (*words, name))

    return walk(typer.main.get_command(top), ())


def models_in(annotation: object) -> list[type[BaseModel]]:
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for argument in typing.get_args(annotation) for model in models_in(argument)]


def keys_of_loop_file() -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield the words of a section's heading, none for "Top level", and a key in it."""
    from servoscope.models import plants
    from servoscope.models.loop import Loop

    for key, field in Loop.model_fields.items():
        models = models_in(field.annotation)
        if any(issubclass(model, plants.Plant) for model in models):
            for kind in plants.plant_kinds():
                yield from (((f"[{key}]", kind), inside) for inside in plants.plant_class(kind).model_fields)
        elif models:
            yield from (((f"[{key}]",), inside) for model in models for inside in model.model_fields)
        else:
            yield (), key


def test_every_command_and_option_is_documented() -> None:
    missing = []
    for name, command in commands():
        text = section("cli.md", rf"^servoscope {name}(?![\w-])")
        if text is None:
            missing.append(f"a heading 'servoscope {name}'")
            continue
        for parameter in command.params:
            if parameter.param_type_name == "option" and not parameter.hidden:
                long = [option for option in parameter.opts if option.startswith("--")]
                missing += [
                    f"servoscope {name} {option}" for option in long or parameter.opts if not has_line(text, option)
                ]
    assert not missing, f"not in docs/reference/cli.md: {', '.join(missing)}"


def test_every_key_of_the_loop_file_is_documented() -> None:
    from servoscope.arm.settings import ArmLoop, JointColumns

    missing = []
    for words, key in keys_of_loop_file():
        text = section("loop-file.md", *(re.escape(word) for word in words or ("Top level",)))
        if text is None or not has_line(text, key):
            missing.append(" ".join([*words, key]))
    for heading, model in (("loop file of an arm", ArmLoop), (r"\[joints\.NAME\]", JointColumns)):
        text = section("loop-file.md", heading) or ""
        missing += [f"{heading} {key}" for key in model.model_fields if not has_line(text, key)]
    assert not missing, f"not in docs/reference/loop-file.md: {', '.join(missing)}"


def test_every_key_of_the_service_file_is_documented() -> None:
    from servoscope.service.access.sign_on import SignOnSettings
    from servoscope.service.config import ServiceFile
    from servoscope.service.kinds import PUBLISHERS, SOURCES, find_kinds
    from servoscope.service.mapping.settings import PayloadSettings

    kinds = {"sources": find_kinds(SOURCES), "outlets": find_kinds(PUBLISHERS)}
    elsewhere = ("quality", "alarms", "actions")
    missing = []
    for key, field in ServiceFile.model_fields.items():
        models = [each.load() for each in kinds[key].values()] if key in kinds else models_in(field.annotation)
        text = section("service-file.md", rf"\[{key}(\.NAME)?\]" if models else "Top level") or ""
        inside = [name for model in models for name in model.model_fields] if models else [key]
        if key not in elsewhere:
            missing += [f"{key}: {name}" for name in inside if not has_line(text, name)]
    text = section("service-file.md", r"\[sources\.NAME\.payload\]") or ""
    missing += [f"payload: {name}" for name in PayloadSettings.model_fields if not has_line(text, name)]
    text = section("service-file.md", r"\[web\.sign_on\]") or ""
    missing += [f"web.sign_on: {name}" for name in SignOnSettings.model_fields if not has_line(text, name)]
    assert not missing, f"not in docs/reference/service-file.md: {', '.join(missing)}"


def default_cells(text: str) -> Iterator[tuple[str, str]]:
    """Yield key and documented default of each row of the tables that have a column of defaults."""
    column = None
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split(" | ")] if line.startswith("|") else []
        if "default" in [cell.strip() for cell in cells]:
            column = [cell.strip() for cell in cells].index("default")
        elif not cells:
            column = None
        elif column is not None and len(cells) > column:
            keys, given = re.findall(r"`(\w+)`", cells[0]), cells[column].split(", ")
            yield from zip(keys, given if len(given) == len(keys) else [cells[column]] * len(keys), strict=True)


def wrong_default(field: FieldInfo, cell: str) -> bool:
    """Tell whether a default that the code has is another than the documented one; words stand for a computed one."""
    if cell == "required" or field.is_required():
        return (cell == "required") != field.is_required()
    default = field.get_default(call_default_factory=True, validated_data={})
    if not (literal := re.match(r"`([^`]*)`", cell)):
        return cell == "none" and bool(default)
    try:
        documented = tomllib.loads(f"x = {literal[1]}")["x"]
    except tomllib.TOMLDecodeError:
        return False  # a name that the code forms
    return bool(documented != TypeAdapter(Any).dump_python(default, mode="json"))


def test_documented_defaults_are_those_of_the_code() -> None:
    from servoscope.arm.settings import ArmLoop, JointColumns
    from servoscope.models import plants
    from servoscope.models.loop import Columns, Controller, Loop, MonitorSettings
    from servoscope.service.config import ServiceFile
    from servoscope.service.kinds import PUBLISHERS, SOURCES, find_kinds

    tables: list[tuple[str, tuple[str, ...], type[BaseModel]]] = [
        ("loop-file.md", ("Top level",), Loop),
        ("loop-file.md", (r"\[columns\]",), Columns),
        ("loop-file.md", (r"\[controller\]",), Controller),
        ("loop-file.md", (r"\[monitor\]",), MonitorSettings),
        ("loop-file.md", ("loop file of an arm",), ArmLoop),
        ("loop-file.md", (r"\[joints\.NAME\]",), JointColumns),
        *(("loop-file.md", (r"\[plant\]", kind), plants.plant_class(kind)) for kind in plants.plant_kinds()),
    ]
    for key, field in ServiceFile.model_fields.items():
        tables += [("service-file.md", (rf"^\[{key}(\.NAME)?\]$",), model) for model in models_in(field.annotation)]
    for key, group in (("sources", SOURCES), ("outlets", PUBLISHERS)):
        for kind, found in find_kinds(group).items():
            tables.append(("service-file.md", (rf"\[{key}\.NAME\]$", kind), found.load()))
    wrong, compared = [], 0
    for name, words, model in tables:
        text = section(name, *words)
        if text is None:  # one section has the tables of all kinds
            parts = re.split(r"^Of kind `(\w+)`", section(name, *words[:1]) or "", flags=re.MULTILINE)
            text = dict(zip(parts[1::2], parts[2::2], strict=True)).get(words[-1], "")
        for key, cell in default_cells(text):
            field = model.model_fields.get(key)
            compared += field is not None
            if field is not None and wrong_default(field, cell):
                wrong.append(f"{name} {' '.join(words)} {key}: {cell}, in the code {field.default!r}")
    assert not wrong, "\n".join(wrong)
    assert compared > 100, compared


def test_every_key_of_alarms_data_quality_and_actions_is_documented() -> None:
    from servoscope.service import actions, alarms
    from servoscope.signals import quality

    text = (REFERENCE.parent / "alarms.md").read_text() + (REFERENCE.parent / "how-to" / "actions.md").read_text()
    models = [alarms.AlarmDefinition, alarms.FloodSettings, quality.QualitySettings, actions.RetrySettings]
    models += [actions.WebhookSettings, actions.CommandSettings, actions.EmailSettings, actions.FaultToleranceSettings]
    keys = {key for model in models for key in model.model_fields}
    missing = [key for key in sorted(keys) if not re.search(rf"[`\n ]{key}( = [^`\n]*)?[`\n]|`{key}`", text)]
    assert not missing, f"not in docs/alarms.md or docs/how-to/actions.md: {', '.join(missing)}"


@pytest.mark.parametrize("name", servoscope.__all__)
def test_every_public_name_is_documented(name: str) -> None:
    assert has_line(page("python.md"), name), f"{name} is not in docs/reference/python.md"


def test_docstrings_of_public_names_have_examples() -> None:
    """Tests run them, in the folder of the tutorial."""
    without = {"__version__", "Columns", "design_study"}  # a page documents the keys; it takes most of a minute
    names = {*servoscope.__all__, "NoveltyDetector"} - without
    assert {name for name in names if ">>>" not in getattr(servoscope, name).__doc__} == set()


def test_links_between_pages_lead_somewhere() -> None:
    root = REFERENCE.parent.parent
    pages = [*sorted(root.glob("*.md")), *sorted((root / "docs").rglob("*.md"))]
    broken = [
        f"{path.relative_to(root)} -> {target}"
        for path in pages
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", path.read_text(encoding="utf-8"))
        if not re.match(r"\w+:", target) and not (path.parent / target).exists()
    ]
    assert not broken
