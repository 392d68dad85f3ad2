"""What the words on the command line mean in time: moments and durations."""

from __future__ import annotations

import re
import time
from datetime import UTC, datetime

import typer

__all__ = ["duration", "moment"]

UNITS = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}


def duration(text: str, option: str) -> float:
    """Read ``90s``, ``30min``, ``8h`` or ``7d``; return it in s.

    Raises
    ------
    typer.BadParameter
        If it is none of these.
    """
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(s|min|h|d)", text.strip())
    if found is None or not float(found[1]) > 0.0:
        raise typer.BadParameter(f"{option} {text!r}: write a number and s, min, h or d, as in 8h")
    return float(found[1]) * UNITS[found[2]]


def moment(text: str | None, option: str) -> float | None:
    """Read a date and time after ISO 8601, UTC unless it says otherwise, or how long ago; return UTC s.

    Raises
    ------
    typer.BadParameter
        If it is neither.
    """
    if text is None:
        return None
    try:
        found = datetime.fromisoformat(text)
    except ValueError:
        try:
            return time.time() - duration(text, option)
        except typer.BadParameter:
            raise typer.BadParameter(
                f"{option} {text!r}: write a date or time, as in 2026-01-31T12:00, or how long ago, as in 8h"
            ) from None
    return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp()
