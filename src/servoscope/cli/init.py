"""The command that begins: a loop file from one log."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servoscope.cli import arguments
from servoscope.cli.app import app
from servoscope.cli.exit import FailureCounter
from servoscope.cli.options import ReadingOptions, with_reading_options
from servoscope.cli.output_paths import check_output

if TYPE_CHECKING:
    from rich.console import Console

    from servoscope.models.loop import Columns


@app.command()
@with_reading_options("where", "by", "from_s", "to_s")
def init(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="A log of the healthy machine at work.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="LOOP", help="Loop file to write.")] = Path(
        "loop.toml"
    ),
    *,
    reading: ReadingOptions,
    yes: Annotated[bool, typer.Option("--yes", help="Take what is proposed; ask nothing.")] = False,
) -> None:
    """Look at a log, propose a loop file with the evidence for each line, write it, and inspect the log with it."""
    check_output(output, "-o", (".toml",), [log])

    from servoscope.cli.render import results
    from servoscope.core.errors import OutputError, ServoscopeError
    from servoscope.learning.proposal import propose_columns
    from servoscope.report.page import say
    from servoscope.signals import readers
    from servoscope.signals.readers.axes import find_axes

    asks = not yes and sys.stdin.isatty() and sys.stdout.isatty()
    reader = arguments.RecordingReader.from_options(None, reading)
    out = results.create_console()
    mapping = reader.columns
    axes = [reading.axis]
    if mapping is None:
        channels = readers.list_channels(log, reader.text)
        if asks:
            results.print_channels(out, log, channels)
        axes = [reading.axis] if reading.axis is not None else [*find_axes([each.name for each in channels])] or [None]
    targets = [_axis_file(output, axis) if len(axes) > 1 else output for axis in axes]
    for target in targets:
        if target.exists() and not yes:
            raise OutputError(f"{target}: exists; name another file with -o, or replace it with --yes")
    if len(axes) > 1:
        results.print_notes(out, [say("init.axes", axes=[str(axis) for axis in axes])])
    failures = FailureCounter()
    for axis, target in zip(axes, targets, strict=True):
        with failures.catch():
            chosen = mapping
            if chosen is None:
                try:
                    chosen = propose_columns(log, channels, axis)
                except ServoscopeError as error:
                    if not asks:
                        raise
                    out.print(str(error))
                if asks and (chosen is None or not typer.confirm(say("init.confirm_columns"), default=True)):
                    chosen = arguments.parse_mapping(typer.prompt(say("init.ask_columns")), chosen)
            assert chosen is not None, "it was proposed, or asked for"
            changes = {"text": reader.text or chosen.text, "resample": reading.resample or chosen.resample}
            _propose(out, log, chosen.model_copy(update=changes), target, asks)
    failures.exit_if_any()


def _axis_file(output: Path, axis: str | None) -> Path:
    """Return the loop file of one axis of several."""
    return output.with_name(f"{output.stem}-{axis}{output.suffix}")


def _propose(out: Console, log: Path, columns: Columns, output: Path, asks: bool) -> None:
    """Print the proposal for a log with its evidence, write it, and inspect the log with it."""
    from servoscope.cli.render import results
    from servoscope.core.files import atomic_write
    from servoscope.core.messages import render
    from servoscope.learning import inspection
    from servoscope.learning.proposal import propose_loop
    from servoscope.report.page import say
    from servoscope.signals import readers

    proposal = propose_loop(log, columns)
    lines = [
        (f"{line.section}.{line.key}".lstrip("."), line.value + " ?" * line.doubtful, render(line.why))
        for line in proposal.lines
    ]
    results.print_table(out, ("setting", "proposed", "why"), lines, words=3)
    if any(line.doubtful for line in proposal.lines):
        results.print_notes(out, [say("init.doubtful")])
        if asks:
            typer.confirm(say("init.confirm"), default=True, abort=True)
    atomic_write(output, proposal.to_toml(log.name).encode())
    results.print_written_path(out, output)
    found = inspection.inspect(readers.read(log, proposal.loop), proposal.loop)
    results.print_inspection(out, found)
    if found.verdict == "not usable":
        results.print_notes(out, [say("init.not_usable", loop=str(output))])
    else:
        results.print_command(
            out,
            say("init.next"),
            f"servoscope learn {shlex.quote(str(output))} {shlex.quote(str(log))} -o baseline.json",
        )
