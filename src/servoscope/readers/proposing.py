"""Which columns of a file might be time, r, u and y: a proposal from their names, for people to confirm."""

from __future__ import annotations

import re
from collections.abc import Sequence

__all__ = ["propose"]

# words in names, the most telling first; the order of the letters decides who chooses first
WORDS = {
    "t": ("t", "time", "zeit", "timestamp", "seconds", "elapsed"),
    "r": ("r", "ref", "reference", "setpoint", "set", "soll", "target", "desired", "demand"),
    "u": ("u", "input", "control", "valve", "servo", "stell", "torque", "current", "voltage", "command", "cmd"),
    "y": ("y", "output", "ist", "actual", "measured", "feedback", "position", "pos", "angle", "speed", "velocity"),
}


def propose(names: Sequence[str]) -> dict[str, str]:
    """Return the likeliest column for t, r, u and y; without those for which no name speaks."""
    found: dict[str, str] = {}
    for letter, words in WORDS.items():
        ranked = []
        for order, name in enumerate(names):
            parts = re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name)
            inside = {part.casefold() for part in parts} | {name.casefold()}
            rank = next((k for k, word in enumerate(words) if word in inside), None)
            if rank is not None and name not in found.values():
                ranked.append((rank, order, name))
        if ranked:
            found[letter] = min(ranked)[2]
    return found
