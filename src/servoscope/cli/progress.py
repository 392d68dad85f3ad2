"""Progress bars on stderr, if that is a terminal, and what is compiled meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress

__all__ = ["Steps", "counted", "on_compiling", "progress", "waiting"]


class Steps:
    """A progress bar over some parts, each in so many steps, or none; made by `progress`."""

    def __init__(self, bar: Progress | None, parts: int, each: int) -> None:
        self._bar, self._each = bar, each
        self._task = bar.add_task("", total=parts * each) if bar is not None else None
        self._part, self._done, self._what, self._step = -1, 0, "", ""

    def begin(self, what: str) -> None:
        """Go on to the next part."""
        self._part, self._done, self._what, self._step = self._part + 1, 0, what, ""
        self._show()

    def tell(self, step: str) -> None:
        """Go on to the next step of the part."""
        self._done, self._step = min(self._done + 1, self._each), step
        self._show()

    def compiling(self) -> None:
        """Say why this takes longer than it will the next time."""
        self._show(" (compiling, once)")

    @contextmanager
    def paused(self) -> Iterator[None]:
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
            text = ": ".join(filter(None, (self._what, self._step))) + more
            self._bar.update(self._task, completed=self._part * self._each + self._done, description=text)


@contextmanager
def progress(parts: int, each: int) -> Iterator[Steps]:
    """Show a progress bar on stderr, if that is a terminal, and take it away again at the end."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    err = Console(stderr=True, highlight=False)
    if not err.is_terminal:
        yield Steps(None, parts, each)
        return
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TimeElapsedColumn(),
    )
    # Results go to stdout, which may be a file: it must not be drawn into the bar's console.
    with Progress(*columns, console=err, transient=True, redirect_stdout=False) as bar:
        steps = Steps(bar, parts, each)
        with on_compiling(steps.compiling):
            yield steps


@contextmanager
def counted() -> Iterator[Callable[[str, int, int], None]]:
    """Show how many of many are done, and how long the rest will take, on stderr if that is a terminal."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    err = Console(stderr=True, highlight=False)
    if not err.is_terminal:
        yield lambda *_: None
        return
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=err, transient=True, redirect_stdout=False) as bar:
        task = bar.add_task("")

        def tell(what: str, done: int, total: int) -> None:
            bar.update(task, description=what, completed=done, total=total)

        yield tell


@contextmanager
def waiting(what: str) -> Iterator[None]:
    """Show that something goes on, on stderr if that is a terminal."""
    from rich.console import Console

    err = Console(stderr=True, highlight=False)
    if not err.is_terminal:
        yield
        return
    with err.status(what):
        yield


@contextmanager
def on_compiling(tell: Callable[[], None]) -> Iterator[None]:
    """Call `tell` whenever machine code is made that was not in the cache yet."""
    from numba.core.event import Event, Listener, install_listener

    class Told(Listener):  # type: ignore[misc]  # numba has no complete types
        def on_start(self, event: Event) -> None:
            tell()

        def on_end(self, event: Event) -> None:
            """Nothing to say."""

    with install_listener("numba:compile", Told()):
        yield
