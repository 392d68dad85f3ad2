"""The command ``servoscope`` itself; its commands stand in `commands` and `unrecorded`."""

from __future__ import annotations

import atexit
import gc
import sys
import warnings
from collections.abc import Iterator
from typing import Annotated, Any

import typer

from servoscope.cli.examples import EXAMPLES
from servoscope.cli.exit import CommandGroup
from servoscope.core.cache_folders import replace_library_warnings
from servoscope.core.errors import ObsoleteSettingWarning, OutputError
from servoscope.core.messages import say, set_language

_format_library_warning = warnings.formatwarning

GARBAGE = 200_000  # new objects before cycles are looked for: loading code makes very many, and no garbage

CONTEXT = {"help_option_names": ["-h", "--help"]}

GROUPS = {
    "Begin": ("demo", "tutorial", "init", "inspect", "docs", "help"),
    "Judge recordings": ("assess", "learn", "baseline", "calibrate-load", "diagnose", "verify"),
    "Follow machines for months": (
        "add",
        "run",
        "watch",
        "history",
        "trend",
        "alarms",
        "relearn",
        "store",
        "serve",
        "users",
        "publish",
        "fleet",
    ),
    "Before deployment, and in the drive": ("simulate", "design", "export"),
    "Check servoscope itself": ("reproduce",),
}

app = typer.Typer(
    cls=CommandGroup,
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
    warnings.formatwarning = _format_warning
    app(prog_name="servoscope")


def _format_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
) -> str:
    if issubclass(category, ObsoleteSettingWarning):
        return f"servoscope: warning: {message}\n"
    return _format_library_warning(message, category, filename, lineno, line)


def _print_version(wanted: bool) -> None:
    if wanted:
        from servoscope import __version__

        typer.echo(f"servoscope {__version__}")
        raise typer.Exit


def _choose_language(name: str | None) -> None:
    if name is not None:
        try:
            set_language(name)
        except ValueError as error:
            raise typer.BadParameter(str(error)) from None


@app.callback()
def servoscope(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
    language: Annotated[
        str | None,
        typer.Option(
            callback=_choose_language, is_eager=True, metavar="en|de", help="Language of results and reports."
        ),
    ] = None,
) -> None:
    """Say from r, u and y of a servo loop whether its actuator is healthy; if not, what changed, and when."""


@app.command("help")
def show_help(
    context: typer.Context,
    command: Annotated[str | None, typer.Argument(metavar="COMMAND", help="Command; none: all of them.")] = None,
) -> None:
    """Show what servoscope can do, or what one command does."""
    whole = context.find_root()
    shown = whole if command is None else _context_of(whole, command)
    typer.echo(shown.get_help())


@app.command("docs")
def show_docs() -> None:
    """Open the documentation that came with this installation in the browser; off a terminal, print where it is."""
    import webbrowser
    from functools import partial
    from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
    from pathlib import Path

    page = Path(__file__).parent.parent / "site" / "index.html"
    if not page.is_file():
        raise OutputError(say("docs.missing"))
    typer.echo(str(page))
    if sys.stdout.isatty():  # over HTTP: browsers refuse to load from files what the excerpts of a search are made of
        with ThreadingHTTPServer(
            ("127.0.0.1", 0), partial(SimpleHTTPRequestHandler, directory=str(page.parent))
        ) as server:
            webbrowser.open(f"http://127.0.0.1:{server.server_port}/")
            server.serve_forever()


def _context_of(whole: Any, name: str) -> Any:
    subcommand = whole.command.get_command(whole, name) if isinstance(whole.command, CommandGroup) else None
    if subcommand is None:
        known = ", ".join(command for group in GROUPS.values() for command in group)
        raise typer.BadParameter(f"{name!r} is no command; there are {known}")
    return type(whole)(subcommand, info_name=name, parent=whole)


def iter_commands(group: typer.Typer, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the commands of the application by their names, those of its groups as "users add"."""
    for info in group.registered_commands:
        info.name = info.name or (info.callback.__name__ if info.callback is not None else "")
        yield f"{prefix}{info.name}", info
    for inner in group.registered_groups:
        if inner.typer_instance is not None:
            yield from iter_commands(inner.typer_instance, f"{prefix}{inner.name} ")


def group_commands() -> None:
    """Put each command into its group, in the order in which they are met, and an example into its help."""
    for name, info in iter_commands(app):
        info.epilog = f"Example: {EXAMPLES[name]}"
    panels = {name: panel for panel, names in GROUPS.items() for name in names}
    order = list(panels)
    for info in app.registered_commands:
        info.rich_help_panel = panels[info.name or ""]
    for group in app.registered_groups:
        group.rich_help_panel = panels[str(group.name)]
    app.registered_commands.sort(key=lambda info: order.index(info.name or ""))
