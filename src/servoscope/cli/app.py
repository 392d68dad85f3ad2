"""The command ``servoscope`` itself; its commands stand in `commands` and `unrecorded`."""

from __future__ import annotations

import atexit
import gc
import sys
from typing import Annotated

import typer

from servoscope.cli.exit import CommandGroup
from servoscope.core.cache_folders import replace_library_warnings

GARBAGE = 200_000  # new objects before cycles are looked for: loading code makes very many, and no garbage

CONTEXT = {"help_option_names": ["-h", "--help"]}

app = typer.Typer(
    cls=CommandGroup,
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings=CONTEXT,
)


def main() -> None:
    """Run the command line of this process."""
    gc.set_threshold(GARBAGE)  # a quarter of the time to a first result went into looking, here and at the end
    atexit.register(gc.freeze)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # a terminal without a sign for squared is no reason to stop
    replace_library_warnings()
    app(prog_name="servoscope")


def _print_version(wanted: bool) -> None:
    if wanted:
        from servoscope import __version__

        typer.echo(f"servoscope {__version__}")
        raise typer.Exit


@app.callback()
def servoscope(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Say from r, u and y of a servo loop whether its actuator is healthy; if not, what changed, and when."""
