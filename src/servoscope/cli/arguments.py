"""What the words on the command line mean: operating points, row conditions, column mappings, faults."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from servoscope.errors import RecordingError, ServoscopeError

if TYPE_CHECKING:
    from servoscope.loop import Columns, Loop
    from servoscope.readers import ChannelInfo
    from servoscope.recording import Recording
    from servoscope.simulation import FaultEvent

__all__ = [
    "Engines",
    "Rigs",
    "Source",
    "check_length",
    "check_reference",
    "columns_from",
    "conditions",
    "fault_events",
    "healthy",
    "labelled",
    "no_mapping",
]

MOST_SAMPLES = 10_000_000  # of a simulation, which holds all of them at once


class Engines(StrEnum):
    """What carries the work of ``fleet``."""

    local = "local"
    spark = "spark"


class Rigs(StrEnum):
    """What ``simulate`` can simulate."""

    linear = "linear"
    nonlinear = "nonlinear"


def healthy(texts: Sequence[str]) -> list[tuple[str, Path]]:
    """Read recordings to learn from: ``warm=c.csv`` is c.csv at the operating point warm, ``c.csv`` is at none.

    A file whose whole name exists is taken as it is.

    Raises
    ------
    typer.BadParameter
        If some have an operating point and others have none.
    """
    found = []
    for text in texts:
        named = re.fullmatch(r"(\w[\w-]*)=(.+)", text)
        found.append((named[1], Path(named[2])) if named and not Path(text).exists() else ("", Path(text)))
    without = [path for point, path in found if not point]
    if 0 < len(without) < len(found):
        raise typer.BadParameter(
            f"{without[0]}: name the operating point of each recording, as in cold=a.csv, or of none"
        )
    return found


def labelled(texts: Sequence[str], points: Sequence[str]) -> list[tuple[str, str, Path]]:
    """Read ``--fault`` of ``learn``: operating point, name and file; ``backlash@warm=a.csv`` is one at the point warm.

    Raises
    ------
    typer.BadParameter
        If a text cannot be read, or its point is none of `points`.
    """
    found = []
    for text in texts:
        named = re.fullmatch(r"(\w[\w-]*)(?:@(\w[\w-]*))?=(.+)", text)
        if named is None:
            raise typer.BadParameter(f"--fault {text!r}: write NAME=FILE, as in backlash=worn.csv")
        name, point, file = named[1], named[2] or "", Path(named[3])
        if point not in points:
            where = f"at one of {', '.join(points)}, as in {name}@{points[0]}={file}" if any(points) else "at no point"
            raise typer.BadParameter(f"--fault {text!r}: the healthy recordings are {where}")
        found.append((point, name, file))
    return found


def conditions(texts: Sequence[str]) -> dict[str, str]:
    """Read ``--where``: ``["load=20,run=1-5"]`` is {"load": "20", "run": "1-5"}; ``run=1,3`` is one.

    Raises
    ------
    typer.BadParameter
        If a text does not begin with a column and ``=``.
    """
    found: dict[str, str] = {}
    for text in texts:
        column = ""
        for part in text.split(","):
            name, equals, value = part.partition("=")
            if equals:
                column = name.strip()
                found[column] = value.strip()
            elif column:
                found[column] += f",{part.strip()}"
            if not column or not found[column]:
                raise typer.BadParameter(f"--where {text!r}: write COLUMN=VALUE, as in load=20,run=1-5")
    return found


def columns_from(text: str | None, base: Columns | None = None) -> Columns | None:
    """Read ``--columns``; keys that it does not name stay as in `base`. None stays None.

    Raises
    ------
    typer.BadParameter
        If it cannot be read.
    """
    if text is None:
        return None
    from servoscope.readers.columns import parse_columns

    try:
        return parse_columns(text, base)
    except ServoscopeError as error:
        raise typer.BadParameter(f"--{error}; as in --columns 't=Time, r=Ref, u=2 * Current, y=Pos'") from None


EVERYTHING = (-math.inf, math.inf)


@dataclass(frozen=True)
class Source:
    """How one command reads recordings: the loop, ``--columns``, ``--where``, ``--by``, ``--from``, ``--to``."""

    loop: Loop | None
    columns: Columns | None
    where: dict[str, str]
    by: str | None
    span: tuple[float, float]

    @classmethod
    def of(
        cls,
        loop: Loop | None,
        columns: str | None,
        where: Sequence[str] | None,
        by: str | None,
        span: tuple[float | None, float | None],
    ) -> Source:
        """Read the options.

        Raises
        ------
        typer.BadParameter
            If one of them cannot be read.
        """
        mapping = columns_from(columns, loop.columns if loop is not None else None)
        start, end = (bound if bound is not None else limit for bound, limit in zip(span, EVERYTHING, strict=True))
        if not start < end:
            raise typer.BadParameter(f"--from {start:g} must be before --to {end:g}")
        return cls(loop, mapping, conditions(where or ()), by, (start, end))

    def read(self, path: Path) -> list[Recording]:
        """Return the recordings in a file: one, or one per value of the column in ``--by``.

        Raises
        ------
        RecordingError, LoopError
            If the file cannot be used.
        """
        from servoscope import readers

        parts = readers.read_parts(path, self.loop, columns=self.columns, where=self.where, by=self.by)
        if self.span == EVERYTHING:
            return parts
        return [part.part(*self.span) for part in parts]

    def many(self, paths: Sequence[Path]) -> bool:
        """Return whether several recordings are to be expected."""
        return len(paths) > 1 or self.by is not None

    def unmapped(self, path: Path) -> list[ChannelInfo]:
        """Return a file's columns if it lacks one of t, r, u, y and nobody gave a mapping; else none."""
        from servoscope import readers

        if self.loop is not None or self.columns is not None:
            return []
        found = readers.channels(path)
        return found if {"t", "r", "u", "y"} - {channel.name for channel in found} else []


def fault_events(texts: Sequence[str]) -> list[FaultEvent]:
    """Read ``--fault``.

    Raises
    ------
    typer.BadParameter
        If one of them cannot be read.
    """
    from servoscope.simulation import FaultEvent

    try:
        return [FaultEvent.parse(text) for text in texts]
    except ServoscopeError as error:
        raise typer.BadParameter(f"--{error}") from None


def check_reference(text: str) -> None:
    """Refuse a ``--reference`` that is neither a known kind nor looks like a file.

    Raises
    ------
    typer.BadParameter
        If so.
    """
    from servoscope.simulation.references import KINDS

    if text not in KINDS and not Path(text).suffix and not Path(text).exists():
        raise typer.BadParameter(f"--reference {text}: choose from {', '.join(KINDS)}, or name a file")


def check_length(duration_s: float, sample_rate: float) -> None:
    """Refuse a ``--duration`` that has no samples, or more than a machine's memory is sure to hold.

    Raises
    ------
    typer.BadParameter
        If so.
    """
    samples = duration_s * sample_rate
    if not 0.5 < samples <= MOST_SAMPLES:  # not a number is refused too
        most = MOST_SAMPLES / sample_rate
        raise typer.BadParameter(f"--duration {duration_s:g}: give more than 0 s and at most {most:g} s")


def no_mapping(path: Path) -> RecordingError:
    """Return the error that asks for a mapping."""
    example = "--columns 't=..., r=..., u=..., y=...'"
    return RecordingError(f"{path.name}: lacks a column t, r, u or y: say which they are, {example}, or give --loop")
