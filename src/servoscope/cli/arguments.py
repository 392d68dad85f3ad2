"""What the words on the command line mean: row conditions, column mappings, faults, names of output files."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from servoscope.errors import OutputError, RecordingError, ServoscopeError

if TYPE_CHECKING:
    from servoscope.baseline import Baseline
    from servoscope.loop import Columns, Loop
    from servoscope.readers import ChannelInfo
    from servoscope.recording import Recording
    from servoscope.simulation import FaultEvent

__all__ = [
    "Outputs",
    "Source",
    "check_length",
    "check_output",
    "check_reference",
    "columns_from",
    "conditions",
    "fault_events",
    "no_mapping",
    "provenance",
    "stem_of",
]

MOST_SAMPLES = 10_000_000  # of a simulation, which holds all of them at once


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


def check_output(
    path: Path | None, option: str, suffixes: Sequence[str], inputs: Iterable[Path], *, folder: bool = False
) -> None:
    """Refuse an output that would overwrite an input or cannot be written, before any work is done.

    Parameters
    ----------
    path
        What the option says; None: it was not given.
    option
        The option, for messages.
    suffixes
        Endings that the file may have; empty: any.
    inputs
        Files that the command reads.
    folder
        Whether a folder will do as well.

    Raises
    ------
    typer.BadParameter
        If it has another suffix, or is one of the inputs.
    OutputError
        If its folder does not exist.
    """
    if path is None:
        return
    if any(_same(path, each) for each in inputs):
        raise typer.BadParameter(f"{option} {path}: is an input and would be overwritten, give another name")
    try:
        is_folder = path.is_dir()
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from None
    if folder and (is_folder or not path.suffix):
        return
    if suffixes and path.suffix.lower() not in suffixes:
        raise typer.BadParameter(f"{option} {path}: end the name in {' or '.join(suffixes)}")
    if not path.parent.is_dir():
        raise OutputError(f"{path}: cannot be written, there is no folder {path.parent}; make it first")


def _same(one: Path, other: Path) -> bool:
    try:
        return one.samefile(other)
    except OSError:
        return False


def stem_of(path: Path, recording: str) -> str:
    """Return what a recording's files are called: ``x`` for x.csv, ``x-run-6`` for its part x.csv[run=6]."""
    part = re.sub(r"[^\w.+]+", "-", recording.removeprefix(path.name)).strip("-")
    return f"{path.stem}-{part}" if part else path.stem


class Outputs:
    """Where the results on one or several recordings go; no two of them get one name.

    Parameters
    ----------
    wanted
        What the user asked for: a file, which is kept for a single recording and gets each one's name before
        its suffix for several (``report-x.html``); a folder, or a name without suffix, which gets one file
        per recording.
    suffix
        Of the files in a folder, for example ``.html``.
    many
        Whether several recordings are to be expected.
    inputs
        Files that must not be overwritten.
    """

    def __init__(self, wanted: Path, suffix: str, many: bool, inputs: Sequence[Path]) -> None:
        self.wanted, self.suffix, self.many, self.inputs = wanted, suffix, many, tuple(inputs)
        self._in_folder = wanted.is_dir() or not wanted.suffix
        self._used: set[str] = set()

    @classmethod
    def of(cls, wanted: Path | None, suffix: str, many: bool, inputs: Sequence[Path]) -> Outputs | None:
        """Return where results go; None if none are wanted."""
        return None if wanted is None else cls(wanted, suffix, many, inputs)

    def path(self, stem: str) -> Path:
        """Return the file for the next recording; makes the folder if there is to be one.

        Raises
        ------
        OutputError
            If the folder cannot be made, or the file is an input.
        """
        if not self._in_folder and not self.many:
            return self.wanted
        name = free = stem if self._in_folder else f"{self.wanted.stem}-{stem}"
        number = 1
        while free.casefold() in self._used:  # some file systems do not tell upper from lower case
            number += 1
            free = f"{name}-{number}"
        self._used.add(free.casefold())
        if self._in_folder:
            try:
                self.wanted.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise OutputError(f"{self.wanted}: cannot be made a folder ({error.strerror or error})") from None
            found = self.wanted / f"{free}{self.suffix}"
        else:
            found = self.wanted.with_name(free + self.wanted.suffix)
        if any(_same(found, each) for each in self.inputs):
            raise OutputError(f"{found}: is an input and would be overwritten, name another folder")
        return found


def no_mapping(path: Path) -> RecordingError:
    """Return the error that asks for a mapping."""
    example = "--columns 't=..., r=..., u=..., y=...'"
    return RecordingError(f"{path.name}: lacks a column t, r, u or y: say which they are, {example}, or give --loop")


def provenance(baseline: Baseline, file: Path, recording: Path) -> dict[str, str]:
    """Return where a diagnosis comes from, line by line, for its report."""
    from datetime import UTC, datetime

    from servoscope import __version__

    sources = [source.name for source in baseline.sources]
    more = f" and {len(sources) - 5} more" if len(sources) > 6 else ""
    return {
        "recording": str(recording),
        "baseline": f"{file} ({baseline.hash})",
        "learned from": ", ".join(sources if not more else sources[:5]) + more,
        "threshold": f"{baseline.limit:.4g}",
        "made with": f"servoscope {__version__}",
        "made at": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
    }
