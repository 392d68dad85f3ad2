"""Where results go: names of output files, refused before any work if they cannot be written."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import typer

from servoscope.errors import OutputError
from servoscope.output import make_folder

__all__ = ["RECORDINGS", "REPORTS", "TRACES", "Outputs", "check_output", "stem_of"]

REPORTS, TRACES, RECORDINGS = (".html", ".htm"), (".parquet", ".pq"), (".csv", ".parquet", ".pq")


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
            make_folder(self.wanted)
            found = self.wanted / f"{free}{self.suffix}"
        else:
            found = self.wanted.with_name(free + self.wanted.suffix)
        if any(_same(found, each) for each in self.inputs):
            raise OutputError(f"{found}: is an input and would be overwritten, name another folder")
        return found
