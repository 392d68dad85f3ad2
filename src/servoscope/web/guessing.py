"""Which columns of a file may be t, r, u and y, by their names: a proposal that somebody looks at."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

__all__ = ["mapping"]

WORDS = {
    "time": ("t", "time", "timestamp", "zeit", "seconds", "elapsed", "datetime", "date"),
    "reference": ("r", "ref", "reference", "setpoint", "set", "target", "demand", "desired", "command", "qg", "soll"),
    "input": ("u", "input", "current", "torque", "voltage", "force", "pwm", "control", "vir", "valve", "effort"),
    "output": ("y", "output", "position", "pos", "angle", "measured", "actual", "encoder", "qm", "ist", "displacement"),
}
UNITS = ("ms", "us", "ns", "min", "s")


def mapping(columns: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a column for each signal, None where no name says so; each column once."""
    names = [str(column["name"]) for column in columns]
    found: dict[str, Any] = {}
    # what is that word comes before what only has it
    for whole in (True, False):
        for signal, words in WORDS.items():
            if found.get(signal) is None:
                left = [name for name in names if name not in found.values()]
                found[signal] = next((name for word in words for name in left if _is(name, word, whole)), None)
    time = found["time"] or ""
    unit = next((unit for unit in UNITS if re.search(rf"[\[(_ /]{unit}[\])]?$", time)), "s")
    return {**found, "time_unit": unit, "segment": []}


def _is(name: str, word: str, whole: bool) -> bool:
    if whole:
        return name.casefold() == word
    parts = re.split(r"[^a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).casefold())
    return word in parts
