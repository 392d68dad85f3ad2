"""Progress on stderr: bars on a terminal; elsewhere a line now and then."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from rich.console import Console
    from rich.progress import Progress, ProgressColumn

LINE_INTERVAL_S = 10.0  # until the first line where stderr is no terminal: what takes less says nothing
MAX_INTERVAL_FACTOR = 60.0  # times as long is the longest silence between two lines: a stream may run for months


class StepProgress:
    """A progress bar over some parts, each in so many steps, or lines instead of it; made by `show_steps`."""

    def __init__(self, bar: Progress | None, parts: int, label: int) -> None:
        self._bar, self._each = bar, label
        self._task = bar.add_task("", total=parts * label) if bar is not None else None
        self._part, self._steps_done, self._part_name, self._step, self._share = -1, 0, "", "", 0.0

    def begin(self, part: str) -> None:
        """Go on to the next part."""
        self._part, self._steps_done, self._part_name, self._step, self._share = self._part + 1, 0, part, "", 0.0
        self._show()

    def advance(self, step: str) -> None:
        """Go on to the next step of the part."""
        self._steps_done, self._step, self._share = min(self._steps_done + 1, self._each), step, 0.0
        self._show()

    def count_rows(self, _: str, rows: int, share: float) -> None:
        """Say how many rows of a file are read, and which share of it, where that is known."""
        known = math.isfinite(share)
        self._share = share if known and not self._steps_done else 0.0
        self._step = f"{rows:,} rows".replace(",", " ") + (f", {share:.0%}" if known else "")
        self._show()

    @contextmanager
    def pause(self) -> Iterator[None]:
        """Take the bar away while something else is printed."""
        if self._bar is None:
            yield
            return
        self._bar.stop()
        try:
            yield
        finally:
            self._bar.start()

    def describe(self) -> str:
        """Return what goes on."""
        return ": ".join(filter(None, (self._part_name, self._step)))

    def _show(self) -> None:
        if self._bar is not None and self._task is not None:
            done = self._part * self._each + self._steps_done + self._share
            self._bar.update(self._task, completed=done, description=self.describe())


@contextmanager
def show_steps(parts: int, label: int) -> Iterator[StepProgress]:
    """Show a progress bar on stderr, if that is a terminal, and take it away again at the end; else lines.

    While a file is read, it shows how many rows of it.
    """
    from rich.progress import SpinnerColumn

    from servoscope.signals.readers.table import watch_reading

    with _bar(SpinnerColumn()) as bar:
        steps = StepProgress(bar, parts, label)
        with nullcontext() if bar is not None else _lines(steps.describe), watch_reading(steps.count_rows):
            yield steps


@contextmanager
def show_count() -> Iterator[Callable[[str, int, int], None]]:
    """Show how many of many are done on stderr, and on a terminal how long the rest will take."""
    from rich.progress import MofNCompleteColumn, TimeRemainingColumn

    with _bar(after=(MofNCompleteColumn(), TimeRemainingColumn())) as bar:
        task = bar.add_task("") if bar is not None else None
        now = ""

        def show(what: str, done: int, total: int) -> None:
            nonlocal now
            now = f"{what}: {done} of {total}"
            if bar is not None and task is not None:
                bar.update(task, description=what, completed=done, total=total)

        with nullcontext() if bar is not None else _lines(lambda: now):
            yield show


@contextmanager
def show_spinner(what: str) -> Iterator[None]:
    """Show on stderr that something goes on."""
    console = _terminal()
    with console.status(what) if console is not None else _lines(lambda: what):
        yield


@contextmanager
def _lines(describe: Callable[[], str]) -> Iterator[None]:
    """Write what goes on to stderr as lines, ever more rarely, from a thread: a step may take long."""
    ended, begin = threading.Event(), time.monotonic()

    def write() -> None:
        wait = LINE_INTERVAL_S
        with suppress(OSError, ValueError):  # nobody reads it any more
            while not ended.wait(wait):
                wait = min(2.0 * wait, MAX_INTERVAL_FACTOR * LINE_INTERVAL_S)
                print(f"{describe() or 'working'}, {time.monotonic() - begin:.0f} s", file=sys.stderr, flush=True)

    writer = threading.Thread(target=write, name="servoscope-progress", daemon=True)
    writer.start()
    try:
        yield
    finally:
        ended.set()
        writer.join()


def _terminal() -> Console | None:
    from rich.console import Console

    console = Console(stderr=True, highlight=False)
    return console if console.is_terminal else None


def _bar(*before: ProgressColumn, after: tuple[ProgressColumn, ...] = ()) -> AbstractContextManager[Progress | None]:
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    console = _terminal()
    if console is None:
        return nullcontext()
    columns = (*before, TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn(), *after)
    # Results go to stdout, which may be a file: it must not be drawn into the bar's console.
    return Progress(*columns, console=console, transient=True, redirect_stdout=False)
