"""Which columns of a file may be t, r, u and y, by their names: a proposal for the user to check."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

# Words in names, the most telling first; the order of the letters decides which signal chooses first.
WORDS = {
    "t": ("t", "time", "timestamp", "zeit", "seconds", "elapsed", "datetime", "date"),
    "r": ("r", "ref", "reference", "setpoint", "set", "soll", "target", "desired", "demand", "qg"),
    "u": (
        *("u", "input", "control", "valve", "servo", "stell", "torque", "current", "voltage", "force", "pwm"),
        *("effort", "vir"),
    ),
    "y": (
        *("y", "output", "ist", "actual", "measured", "feedback", "position", "pos", "angle", "speed", "velocity"),
        *("encoder", "displacement", "qm"),
    ),
}
COMMAND = ("command", "cmd")  # what the controller commands where there is a reference besides, else the reference
FIELDS = {"t": "time", "r": "reference", "u": "input", "y": "output"}
UNITS = ("ms", "us", "ns", "min", "s")


def guess_columns(names: Sequence[str]) -> dict[str, str]:
    """Return the likeliest column for t, r, u and y, each column once; without those that no name suggests."""
    parts = {name: {part.casefold() for part in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)} for name in names}
    has_reference = any(parts[name] & set(WORDS["r"]) and not parts[name] & set(COMMAND) for name in names)
    heir = "u" if has_reference else "r"
    words = {**WORDS, heir: (*WORDS[heir][:2], *COMMAND, *WORDS[heir][2:])}
    found: dict[str, str] = {}
    for whole in (True, False):  # a name that is the word comes before one that only contains it
        for letter in [each for each in words if each not in found]:
            left = [name for name in names if name not in found.values()]
            matches = (
                name
                for word in words[letter]
                for name in left
                if (name.casefold() == word if whole else word in parts[name])
            )
            if (match := next(matches, None)) is not None:
                found[letter] = match
    return {letter: found[letter] for letter in WORDS if letter in found}


def guess_mapping(names: Sequence[str]) -> dict[str, Any]:
    """Return the guess as the fields of `Columns`, None where no name suggests one, with the unit of the time."""
    found = guess_columns(names)
    unit = next((unit for unit in UNITS if re.search(rf"[\[(_ /]{unit}[\])]?$", found.get("t", ""))), "s")
    return {**{field: found.get(letter) for letter, field in FIELDS.items()}, "time_unit": unit, "segment": []}
