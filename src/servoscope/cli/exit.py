"""How a command ends and what it leaves on the standard streams: one-line errors, exit codes, JSON."""

from __future__ import annotations

import errno
import json
import os
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import requires
from typing import Any

import typer
import typer.core

from servoscope.core.errors import ServoscopeError
from servoscope.core.messages import say

EXIT_INPUT, EXIT_FAULT, EXIT_SUSPECT, EXIT_INTERRUPTED = 1, 3, 4, 130  # exit codes; 2 is the command line's
RAN = (0, EXIT_FAULT, EXIT_SUSPECT)  # codes of commands that did all that they were asked for


def find_extra(module: str) -> str | None:
    """Return the extra of servoscope that brings a module, the service's before others, or None."""
    needed = rf"{module.replace('_', '[-_]')}\W.*extra == '(\w+)'"
    extras = {matched[1] for line in requires("servoscope") or () if (matched := re.match(needed, line, re.IGNORECASE))}
    return min(extras - {"dev"}, key=lambda extra: (extra != "service", extra), default=None)


class CommandGroup(typer.core.TyperGroup):
    """Commands whose users' errors are one line and an exit code; other errors keep their traceback."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command by its name; of one that is gone, say what took its place."""
        if cmd_name == "explore":  # until 2.0
            raise ServoscopeError(say("init.explore"))
        return super().get_command(ctx, cmd_name)

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        try:
            result = super().invoke(ctx)
            sys.stdout.flush()
        except ServoscopeError as error:
            print_error(error)
            raise typer.Exit(EXIT_INPUT) from None
        except ModuleNotFoundError as error:
            module = str(error.name).partition(".")[0]
            if (extra := find_extra(module)) is None:
                raise
            print_error(f"{module} is missing, pip install 'servoscope[{extra}]'")
            raise typer.Exit(EXIT_INPUT) from None
        except KeyboardInterrupt:
            raise typer.Exit(EXIT_INTERRUPTED) from None
        except SystemError as error:
            cause: BaseException | None = error  # Ctrl-C in the middle of compiled code is the first of several causes
            while isinstance(cause, SystemError):
                cause = cause.__cause__
            if not isinstance(cause, KeyboardInterrupt):
                raise
            raise typer.Exit(EXIT_INTERRUPTED) from None
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EPIPE):
                raise
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or the exit would try once more
            if error.errno == errno.EPIPE:  # who reads, as head does, has seen enough
                raise typer.Exit from None
            print_error(f"cannot be written ({error.strerror})")
            raise typer.Exit(EXIT_INPUT) from None
        return result


class FailureCounter:
    """Counts the inputs that could not be used, so that the others go on."""

    def __init__(self) -> None:
        self.count = 0

    @contextmanager
    def catch(self) -> Iterator[None]:
        """Print the error of one input and go on behind the block."""
        try:
            yield
        except ServoscopeError as error:
            self.count += 1
            print_error(error)

    def exit_if_any(self) -> None:
        """End the command with exit code 1 if there was any failure."""
        if self.count:
            raise typer.Exit(EXIT_INPUT)


def exit_after(verdicts: Sequence[str]) -> None:
    """End the command with the exit code of the worst verdict, if one is a fault or suspect."""
    if "fault" in verdicts:
        raise typer.Exit(EXIT_FAULT)
    if "suspect" in verdicts:
        raise typer.Exit(EXIT_SUSPECT)


def print_error(what: object) -> None:
    """Print one line on stderr, whatever characters a file's name may have."""
    line = " ".join(f"servoscope: {what}".split())
    typer.echo("".join(c if c.isprintable() else "?" for c in line), err=True)


def print_json(value: object, *, lines: bool) -> None:
    """Print one object on stdout: one line of several, or an indented document."""
    typer.echo(json.dumps(value, indent=None if lines else 2, allow_nan=False))
