"""Progress bars on stderr, if that is a terminal, and what is compiled meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from rich.console import Console
    from rich.progress import Progress, ProgressColumn


class StepProgress:
    """A progress bar over some parts, each in so many steps, or none; made by `show_steps`."""

    def __init__(self, bar: Progress | None, parts: int, each: int) -> None:
        self._bar, self._each = bar, each
        self._task = bar.add_task("", total=parts * each) if bar is not None else None
        self._part, self._steps_done, self._part_name, self._step = -1, 0, "", ""

    def begin(self, part: str) -> None:
        """Go on to the next part."""
        self._part, self._steps_done, self._part_name, self._step = self._part + 1, 0, part, ""
        self._show()

    def advance(self, step: str) -> None:
        """Go on to the next step of the part."""
        self._steps_done, self._step = min(self._steps_done + 1, self._each), step
        self._show()

    def show_compilation(self) -> None:
        """Show why this takes longer than it will the next time."""
        self._show(" (compiling, once)")

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

    def _show(self, more: str = "") -> None:
        if self._bar is not None and self._task is not None:
            text = ": ".join(filter(None, (self._part_name, self._step))) + more
            self._bar.update(self._task, completed=self._part * self._each + self._steps_done, description=text)


@contextmanager
def show_steps(parts: int, each: int) -> Iterator[StepProgress]:
    """Show a progress bar on stderr, if that is a terminal, and take it away again at the end."""
    from rich.progress import SpinnerColumn

    with _bar(SpinnerColumn()) as bar:
        steps = StepProgress(bar, parts, each)
        if bar is None:
            yield steps
            return
        from servoscope.core.jit import on_compilation  # loads Numba: only where a bar is shown

        with on_compilation(steps.show_compilation):
            yield steps


@contextmanager
def show_count() -> Iterator[Callable[[str, int, int], None]]:
    """Show how many of many are done, and how long the rest will take, on stderr if that is a terminal."""
    from rich.progress import MofNCompleteColumn, TimeRemainingColumn

    with _bar(after=(MofNCompleteColumn(), TimeRemainingColumn())) as bar:
        task = bar.add_task("") if bar is not None else None

        def show(what: str, done: int, total: int) -> None:
            if bar is not None and task is not None:
                bar.update(task, description=what, completed=done, total=total)

        yield show


@contextmanager
def show_spinner(what: str) -> Iterator[None]:
    """Show that something goes on, on stderr if that is a terminal."""
    console = _terminal()
    with console.status(what) if console is not None else nullcontext():
        yield


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
