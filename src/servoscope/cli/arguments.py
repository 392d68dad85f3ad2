"""What the options of the command line mean: times, recordings, operating points, mappings, faults."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from servoscope.core.errors import ServoscopeError

if TYPE_CHECKING:
    from servoscope.cli.options import ReadingOptions
    from servoscope.models.loop import Columns, Loop, TextLayout
    from servoscope.signals import Recording
    from servoscope.signals.readers import ChannelInfo
    from servoscope.simulation import FaultEvent


UNITS = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}


def parse_duration(text: str, option: str) -> float:
    """Read ``90s``, ``30min``, ``8h`` or ``7d``; return it in s; typer.BadParameter if it is none of these."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(s|min|h|d)", text.strip())
    if match is None or not float(match[1]) > 0.0:
        raise typer.BadParameter(f"{option} {text!r}: write a number and s, min, h or d, as in 8h")
    return float(match[1]) * UNITS[match[2]]


def parse_time(text: str | None, option: str) -> float | None:
    """Read a date and time after ISO 8601, UTC unless it says otherwise, or how long ago; return UTC s."""
    if text is None:
        return None
    from servoscope.prognosis.series import parse_date

    try:
        return parse_date(text)
    except ValueError:
        try:
            return time.time() - parse_duration(text, option)
        except typer.BadParameter:
            raise typer.BadParameter(
                f"{option} {text!r}: write a date or time, as in 2026-01-31T12:00, or how long ago, as in 8h"
            ) from None


MAX_SIMULATED_SAMPLES = 10_000_000  # of a simulation, which holds all of them at once


def parse_healthy(texts: Sequence[str]) -> list[tuple[str, Path]]:
    """Read recordings to learn from: ``warm=c.csv`` is c.csv at the operating point warm, ``c.csv`` is at none.

    A file whose whole name exists is taken as it is.
    """
    healthy = []
    for text in texts:
        named = re.fullmatch(r"(\w[\w-]*)=(.+)", text)
        point, path = (named[1], Path(named[2])) if named and not Path(text).exists() else ("", Path(text))
        healthy += [(point, file) for file in expand_files([path])]
    without = [path for point, path in healthy if not point]
    if 0 < len(without) < len(healthy):
        raise typer.BadParameter(
            f"{without[0]}: name the operating point of each recording, as in cold=a.csv, or of none"
        )
    return healthy


def parse_labelled(texts: Sequence[str], points: Sequence[str]) -> list[tuple[str, str, Path]]:
    """Read ``--fault`` of ``learn``: point, name and file; ``backlash@warm=a.csv`` is one at the point warm."""
    labelled = []
    for text in texts:
        named = re.fullmatch(r"(\w[\w-]*)(?:@(\w[\w-]*))?=(.+)", text)
        if named is None:
            raise typer.BadParameter(f"--fault {text!r}: write NAME=FILE, as in backlash=worn.csv")
        name, point, file = named[1], named[2] or "", Path(named[3])
        if point not in points:
            where = f"at one of {', '.join(points)}, as in {name}@{points[0]}={file}" if any(points) else "at no point"
            raise typer.BadParameter(f"--fault {text!r}: the healthy recordings are {where}")
        labelled.append((point, name, file))
    return labelled


def parse_conditions(texts: Sequence[str]) -> dict[str, str]:
    """Read ``--where``: ``["load=20,run=1-5"]`` is {"load": "20", "run": "1-5"}; ``run=1,3`` is one."""
    conditions: dict[str, str] = {}
    for text in texts:
        column = ""
        for part in text.split(","):
            name, equals, value = part.partition("=")
            if equals:
                column = name.strip()
                conditions[column] = value.strip()
            elif column:
                conditions[column] += f",{part.strip()}"
            if not column or not conditions[column]:
                raise typer.BadParameter(f"--where {text!r}: write COLUMN=VALUE, as in load=20,run=1-5")
    return conditions


def parse_mapping(text: str | None, base: Columns | None = None) -> Columns | None:
    """Read ``--columns``; keys that it does not name stay as in `base`. None stays None."""
    if text is None:
        return None
    from servoscope.signals.readers.columns import parse_columns

    try:
        return parse_columns(text, base)
    except ServoscopeError as error:
        raise typer.BadParameter(f"--{error}; as in --columns 't=Time, r=Ref, u=2 * Current, y=Pos'") from None


def _row_time(rate: float) -> str:
    """Return what ``--rate`` means as the time column."""
    if not 0.0 < rate < math.inf:
        raise typer.BadParameter(f"--rate {rate:g}: give the rate of the rows in Hz, above 0")
    return f"row/{rate:.12g}"


UNBOUNDED = (-math.inf, math.inf)


@dataclass(frozen=True)
class RecordingReader:
    """How a command reads recordings: the loop, and what the options say; `changes`: of columns, whatever they are."""

    loop: Loop | None
    columns: Columns | None
    where: dict[str, str]
    by: str | None
    span: tuple[float, float]
    text: TextLayout | None = None
    changes: dict[str, object] = field(default_factory=dict)
    axis: str | None = None

    @classmethod
    def from_options(cls, loop: Loop | None, reading: ReadingOptions) -> RecordingReader:
        """Read the options; typer.BadParameter if one of them cannot be read."""
        from servoscope.models.loop import Columns, TextLayout

        base = loop.columns if loop is not None else None
        mapping = parse_mapping(reading.columns, base)
        given = reading.header_row is not None or reading.skip or reading.comment
        text = (
            TextLayout(header_row=reading.header_row, skip_rows=reading.skip, comment=reading.comment or None)
            if given
            else None
        )
        changes: dict[str, object] = {"text": text} if text is not None else {}
        if reading.resample:
            changes |= {"resample": True}
        if reading.rate is not None:
            changes |= {"time": _row_time(reading.rate)}
        if changes and (mapping is not None or base is not None):
            mapping = (mapping or base or Columns()).model_copy(update=changes)
        span = reading.from_s, reading.to_s
        start, end = (bound if bound is not None else limit for bound, limit in zip(span, UNBOUNDED, strict=True))
        if not start < end:
            raise typer.BadParameter(f"--from {start:g} must be before --to {end:g}")
        where = parse_conditions(reading.where or ())
        return cls(loop, mapping, where, reading.by, (start, end), text, changes, reading.axis)

    def read(self, path: Path) -> list[Recording]:
        """Return the recordings in a file: one, or one per value of the column in ``--by``."""
        from servoscope.models.loop import Columns
        from servoscope.signals import readers

        columns = self.columns
        if columns is None and self.axis is not None:
            from servoscope.learning.proposal import propose_columns

            columns = propose_columns(path, readers.list_channels(path, self.text), self.axis)
        if columns is None and self.changes:  # nobody says where the signals stand
            columns = Columns()
        if columns is not None:
            columns = columns.model_copy(update=self.changes)
        parts = readers.read_parts(path, self.loop, columns=columns, where=self.where, by=self.by)
        if self.span == UNBOUNDED:
            return parts
        return [part.part(*self.span) for part in parts]

    def expects_several(self, paths: Sequence[Path]) -> bool:
        """Return whether several recordings are to be expected."""
        return len(paths) > 1 or self.by is not None

    def unmapped_channels(self, path: Path) -> list[ChannelInfo]:
        """Return a file's columns if it lacks one of t, r, u, y and nobody gave a mapping; else none."""
        from servoscope.signals import readers

        if self.loop is not None or self.columns is not None or self.axis is not None:
            return []
        channels = readers.list_channels(path, self.text)
        return channels if {"t", "r", "u", "y"} - {channel.name for channel in channels} else []


def expand_files(paths: Sequence[Path]) -> list[Path]:
    """Return the recordings that are meant by files, folders, patterns and archives."""
    from servoscope.signals import readers
    from servoscope.signals.readers.archives import expand_paths

    return expand_paths(paths, readers.readable_suffixes())


def expand_baselines(paths: Sequence[Path]) -> list[Path]:
    """Return the baselines that are meant by files, folders and patterns."""
    from servoscope.signals.readers.archives import expand_paths

    return expand_paths(paths, (".json",), "baselines")


def parse_fault_events(texts: Sequence[str]) -> list[FaultEvent]:
    """Read ``--fault``."""
    from servoscope.simulation import FaultEvent

    try:
        return [FaultEvent.parse(text) for text in texts]
    except ServoscopeError as error:
        raise typer.BadParameter(f"--{error}") from None


def check_reference(text: str) -> None:
    """Refuse a ``--reference`` that is neither a known kind nor looks like a file.

    Raises typer.BadParameter if so.
    """
    from servoscope.simulation.references import REFERENCE_KINDS

    if text not in REFERENCE_KINDS and not Path(text).suffix and not Path(text).exists():
        raise typer.BadParameter(f"--reference {text}: choose from {', '.join(REFERENCE_KINDS)}, or name a file")


def check_length(duration_s: float, sample_rate: float) -> None:
    """Refuse a ``--duration`` that has no samples, or more than a machine's memory is sure to hold."""
    samples = duration_s * sample_rate
    if not 0.5 < samples <= MAX_SIMULATED_SAMPLES:  # not a number is refused too
        most = MAX_SIMULATED_SAMPLES / sample_rate
        raise typer.BadParameter(f"--duration {duration_s:g}: give more than 0 s and at most {most:g} s")
