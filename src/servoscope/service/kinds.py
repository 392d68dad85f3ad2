"""The kinds of sources and publishers of a service file: built-in ones, and those that installed packages offer."""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

from pydantic import ValidationError

from servoscope.core.settings import Settings
from servoscope.core.settings_errors import describe_error
from servoscope.service import publishers

SOURCES, PUBLISHERS = "servoscope.sources", "servoscope.publishers"  # groups of entry points
BUILT_IN = tuple(  # written like the entry points of other packages, and loaded like them: when a kind is used
    EntryPoint(name, f"servoscope.service.{value}", group)
    for group, name, value in (
        (SOURCES, "replay", "sources.replay:ReplaySettings"),
        (SOURCES, "folder", "sources.folder:FolderSettings"),
        (SOURCES, "mqtt", "mqtt.source:MqttSourceSettings"),
        (SOURCES, "opcua", "opcua.source:OpcuaSourceSettings"),
        (SOURCES, "kafka", "kafka.source:KafkaSourceSettings"),
        (PUBLISHERS, "mqtt", "mqtt.publisher:MqttPublisherSettings"),
        (PUBLISHERS, "opcua", "opcua.server:OpcuaServerSettings"),
        *(  # each file there but those that they share, by its name: `night_shift` has `NightShiftSettings`
            (PUBLISHERS, name.replace("_", "-"), f"publishers.{name}:{name.title().replace('_', '')}Settings")
            for _, name, _ in pkgutil.iter_modules(publishers.__path__)
            if name not in ("base", "files")
        ),
    )
)
S = TypeVar("S", bound=Settings)


def find_kinds(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group by kind; a package cannot replace a built-in kind."""
    return {
        entry_point.name: entry_point
        for entry_point in (*entry_points(group=group), *BUILT_IN)
        if entry_point.group == group
    }


def parse_tables(tables: Any, group: str, base: type[S], section: str) -> Any:
    """Return tables by name, for example all ``[sources.NAME]``, as the settings of their kinds.

    Raises ValueError, in one line, if a kind is unknown or cannot be loaded, or a key is wrong.
    """
    if not isinstance(tables, Mapping):
        return tables  # the caller's model says what is wrong
    return {name: _parse_table(table, group, base, f"[{section}] {name}") for name, table in tables.items()}


def _parse_table(table: Any, group: str, base: type[S], place: str) -> Any:
    if not isinstance(table, Mapping):
        return table
    kinds = find_kinds(group)
    if "kind" not in table:
        raise ValueError(f"{place}.kind: missing, choose from {', '.join(sorted(kinds))}")
    kind = table["kind"]
    if not isinstance(kind, str) or kind not in kinds:
        raise ValueError(f"{place}.kind: {kind!r} is unknown, choose from {', '.join(sorted(kinds))}")
    try:
        model = kinds[kind].load()
    except Exception as error:  # another package's
        raise ValueError(f"{place}.kind: {kind!r} cannot be loaded ({type(error).__name__}: {error})") from None
    if not (isinstance(model, type) and issubclass(model, base)):
        raise ValueError(f"{place}.kind: {kind!r} is no subclass of {base.__name__}, correct {kinds[kind].value}")
    try:
        return model.model_validate(table)
    except ValidationError as error:
        text = describe_error(error, model)
        raise ValueError(f"{place}{'.' if error.errors()[0]['loc'] else ': '}{text}") from None
