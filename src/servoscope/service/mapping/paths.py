"""Where things are in a message: paths into its tree of tables and lists, and patterns of texts with names."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

NAME = re.compile(r"\{(\w+)\}")  # in a pattern: a part of a text, or a key of a table, that has a name
MAX_TEXT_CHARS = 500  # of a text that a pattern matches: no name of a plant is longer
MAX_ROWS = 50_000  # of a message that are read: 1 MiB has 35 000 samples, one each
ASSET, SIGNAL = "asset", "signal"  # names that mean something; what others hold does not matter


MISSING = object()  # where nothing is: not even null


class TextPattern:
    """A text with names, ``plant/{line}/{asset}``; a name stands for what holds no ``/``, and is not empty.

    Where a level can be read in several ways, ``{asset}.{signal}`` for a.b.c, the text between two names is found as
    far to the right as possible: asset is a.b. The expression has no name twice in a level, so that nothing of it can
    be read in two ways, and the levels that have are searched once, from their end: the time is proportional to the
    length of the text.
    """

    def __init__(self, text: str) -> None:
        self.text, self.names = text, frozenset(NAME.findall(text))
        seen, levels = set[str](), list[str]()
        self._shared = dict[int, list[str]]()  # by level with several names: text, name, text, name, ..., text
        for k, level in enumerate(text.split("/")):
            parts = NAME.split(level)
            if len(parts) > 3:
                self._shared[k] = parts
                levels.append("[^/]+")
                continue
            name = "".join(f"(?P={part})" if part in seen else f"(?P<{part}>[^/]+)" for part in parts[1:2])
            seen.update(parts[1:2])
            levels.append(re.escape(parts[0]) + name + re.escape("".join(parts[2:])))
        self._regex = re.compile("/".join(levels))

    def match(self, text: str) -> dict[str, str] | None:
        """Return what the names stand for; None where the text is another one, or longer than `MAX_TEXT_CHARS`."""
        match = self._regex.fullmatch(text) if len(text) <= MAX_TEXT_CHARS else None
        if match is None:
            return None
        names = match.groupdict()
        if self._shared:
            levels = text.split("/")
            if not all(_match_level(parts, levels[k], names) for k, parts in self._shared.items()):
                return None
        return names

    def filters(self, values: Mapping[str, frozenset[str]]) -> set[str]:
        """Return the topics to subscribe to: with the `values` of names that have some, and any level for others."""
        patterns = {self.text}
        for name in self.names:
            choices = values.get(name, {f"{{{name}}}"})
            patterns = {text.replace(f"{{{name}}}", value) for text in patterns for value in choices}
        return {"/".join("+" if NAME.search(level) else level for level in text.split("/")) for text in patterns}


def _match_level(parts: list[str], level: str, values: dict[str, str]) -> bool:
    """Add what the names of a level stand for; return whether it fits."""
    first, last = parts[0], parts[-1]
    start, end = len(first), len(level) - len(last)
    if not (start < end and level.startswith(first) and level.endswith(last)):
        return False
    for k in range(len(parts) - 2, 1, -2):
        at = level.rfind(parts[k - 1], start + 1, end - 1)
        if at < 0:
            return False
        value, end = level[at + len(parts[k - 1]) : end], at
        if values.setdefault(parts[k], value) != value:
            return False
    return values.setdefault(parts[1], level[start:end]) == level[start:end]


def split_path(path: str) -> tuple[str | int, ...]:
    """Return the steps of a path, ``values.0``: keys of tables, and numbers of elements; empty: the thing itself."""
    return tuple(int(step) if step.isdecimal() else step for step in path.split(".")) if path else ()


def find(tree: Any, path: tuple[str | int, ...]) -> Any:
    """Return what is at a path; MISSING where nothing is."""
    for step in path:
        if isinstance(tree, dict):
            tree = tree.get(step if isinstance(step, str) else str(step), MISSING)
        elif isinstance(tree, list) and isinstance(step, int) and step < len(tree):
            tree = tree[step]
        else:
            return MISSING
    return tree


class RowPath:
    """Where the rows of a message are: a path whose steps may be ``*``, all elements, or ``{name}``, all keys.

    A list at its end is a list of rows.
    """

    def __init__(self, path: str) -> None:
        self._steps = path.split(".") if path else []
        self.names = frozenset(NAME.findall(path))

    def rows(self, tree: Any) -> Iterator[tuple[list[Any], dict[str, str]]]:
        """Yield each row with all that encloses it, itself first, and what the names stand for."""
        yield from self._walk(tree, 0, [tree], {})

    def _walk(
        self, tree: Any, depth: int, around: list[Any], names: dict[str, str]
    ) -> Iterator[tuple[list[Any], dict[str, str]]]:
        if depth == len(self._steps):
            if isinstance(tree, list):
                for element in tree:
                    yield [element, *around], names
            elif tree is not MISSING:
                yield around, names
            return
        step = self._steps[depth]
        name = NAME.fullmatch(step)
        if name or step == "*":
            entries = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
            for key, element in entries:
                bound = {**names, name[1]: str(key)} if name else names
                yield from self._walk(element, depth + 1, [element, *around], bound)
        else:
            element = find(tree, split_path(step))
            if element is not MISSING:
                yield from self._walk(element, depth + 1, [element, *around], names)


def find_around(around: list[Any], path: tuple[str | int, ...]) -> Any:
    """Return what is at a path in a row, or else in what encloses it."""
    for tree in around:
        if (value := find(tree, path)) is not MISSING:
            return value
    return MISSING
