"""Where results go: names of output files, refused before any work if they cannot be written."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import typer

from servoscope.core.errors import OutputError
from servoscope.core.files import make_folder

REPORTS, TRACES, RECORDINGS = (".html", ".htm", ".pdf"), (".parquet", ".pq"), (".csv", ".parquet", ".pq")


def check_output(
    path: Path | None, option: str, suffixes: Sequence[str], inputs: Iterable[Path], *, folder: bool = False
) -> None:
    """Refuse an output that would overwrite an input or cannot be written, before any work is done.

    `path`: what the option says; None: it was not given; `suffixes`: endings that the file may have; empty: any;
    `inputs`: files that the command reads; `folder`: whether a folder will do as well; raises typer.BadParameter if
    it has another suffix, or is one of the inputs; raises OutputError if its folder does not exist.
    """
    if path is None:
        return
    if any(_is_same_file(path, source) for source in inputs):
        raise typer.BadParameter(f"{option} {path}: is an input and would be overwritten, give another name")
    try:
        is_folder = path.is_dir()
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from None
    if folder and (is_folder or not path.suffix):
        return
    if suffixes and path.suffix.lower() not in suffixes:
        raise typer.BadParameter(f"{option} {path}: end the name in {' or '.join(suffixes)}")
    if path.suffix.lower() == ".pdf":
        from servoscope.report.page import find_browser

        find_browser(path)
    if not path.parent.is_dir():
        raise OutputError(f"{path}: cannot be written, there is no folder {path.parent}; make it first")


def _is_same_file(path: Path, other: Path) -> bool:
    try:
        return path.samefile(other)
    except OSError:
        return False


def recording_stem(path: Path, recording: str) -> str:
    """Return what a recording's files are called: ``x`` for x.csv, ``x-run-6`` for its part x.csv[run=6]."""
    part = re.sub(r"[^\w.+]+", "-", recording.removeprefix(path.name)).strip("-")
    return f"{path.stem}-{part}" if part else path.stem


class OutputPaths:
    """Where the results on one or several recordings go; no two of them get one name.

    `target`: what the user asked for: a file, which is kept for a single recording and gets each one's name before
    its suffix for several (``report-x.html``); a folder, or a name without suffix, which gets one file per
    recording; `suffix`: of the files in a folder, for example ``.html``; `many`: whether several recordings are to
    be expected; `inputs`: files that must not be overwritten.
    """

    def __init__(self, target: Path, suffix: str, many: bool, inputs: Sequence[Path]) -> None:
        self.target, self.suffix, self.many, self.inputs = target, suffix, many, tuple(inputs)
        self._in_folder = target.is_dir() or not target.suffix
        self._used: set[str] = set()

    @classmethod
    def from_option(cls, target: Path | None, suffix: str, many: bool, inputs: Sequence[Path]) -> OutputPaths | None:
        """Return where results go; None without the option."""
        return None if target is None else cls(target, suffix, many, inputs)

    def write(
        self, log: Path, recording: str, write: Callable[..., object], *contents: object, stderr: bool = False
    ) -> None:
        """Let `write` write what belongs to a recording of a log, and say where; on stderr beside JSON."""
        from servoscope.cli.render import results

        target = self.path(recording_stem(log, recording))
        write(target, *contents)
        results.print_written_path(results.create_console(stderr=stderr), target)

    def path(self, stem: str) -> Path:
        """Return the file for the next recording; makes the folder if there is to be one.

        Raises OutputError if the folder cannot be made, or the file is an input.
        """
        if not self._in_folder and not self.many:
            return self.target
        name = free = stem if self._in_folder else f"{self.target.stem}-{stem}"
        number = 1
        while free.casefold() in self._used:  # some file systems do not tell upper from lower case
            number += 1
            free = f"{name}-{number}"
        self._used.add(free.casefold())
        if self._in_folder:
            make_folder(self.target)
            place = self.target / f"{free}{self.suffix}"
        else:
            place = self.target.with_name(free + self.target.suffix)
        if any(_is_same_file(place, path) for path in self.inputs):
            raise OutputError(f"{place}: is an input and would be overwritten, name another folder")
        return place
