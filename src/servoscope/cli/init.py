"""The command that begins: a loop file from one log."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from servoscope.cli import arguments
from servoscope.cli.app import app
from servoscope.cli.options import ColumnsOption, CommentOption, HeaderRowOption, SkipOption
from servoscope.cli.output_paths import check_output


@app.command()
def init(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="A log of the healthy machine at work.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="LOOP", help="Loop file to write.")] = Path(
        "loop.toml"
    ),
    columns: ColumnsOption = None,
    header_row: HeaderRowOption = None,
    skip: SkipOption = 0,
    comment: CommentOption = None,
    yes: Annotated[bool, typer.Option("--yes", help="Take what is proposed; ask nothing.")] = False,
) -> None:
    """Look at a log, propose a loop file with the evidence for each line, write it, and inspect the log with it."""
    check_output(output, "-o", (".toml",), [log])

    from rich.table import Table

    from servoscope.cli.render import results
    from servoscope.core.errors import OutputError, ServoscopeError
    from servoscope.core.files import atomic_write
    from servoscope.core.messages import render
    from servoscope.learning import inspection
    from servoscope.learning.proposal import propose_columns, propose_loop
    from servoscope.report.page import say
    from servoscope.signals import readers

    asks = not yes and sys.stdin.isatty() and sys.stdout.isatty()
    if output.exists() and not yes:
        raise OutputError(f"{output}: exists; name another file with -o, or replace it with --yes")
    reader = arguments.RecordingReader.from_options(
        None, columns, None, None, (None, None), (header_row, skip, comment)
    )
    out = results.create_console()
    mapping = reader.columns
    if mapping is None:
        channels = readers.list_channels(log, reader.text)
        if asks:
            results.print_channels(out, log, channels)
        try:
            mapping = propose_columns(log, channels).model_copy(update={"text": reader.text})
        except ServoscopeError as error:
            if not asks:
                raise
            out.print(str(error))
        if asks and (mapping is None or not typer.confirm(say("init.confirm_columns"), default=True)):
            mapping = arguments.parse_mapping(typer.prompt(say("init.ask_columns")), mapping)
    assert mapping is not None, "it was proposed, or asked for"
    proposal = propose_loop(log, mapping)
    table = Table(show_edge=False, box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for name in ("setting", "proposed", "why"):
        table.add_column(name, overflow="fold")
    for line in proposal.lines:
        mark = " ?" if line.doubtful else ""
        table.add_row(f"{line.section}.{line.key}".lstrip("."), line.value + mark, render(line.why))
    out.print(table)
    if any(line.doubtful for line in proposal.lines):
        results.print_notes(out, [say("init.doubtful")])
        if asks:
            typer.confirm(say("init.confirm"), default=True, abort=True)
    atomic_write(output, proposal.to_toml(log.name).encode())
    results.print_written_path(out, output)
    results.print_inspection(out, inspection.inspect(readers.read(log, proposal.loop), proposal.loop))
    results.print_notes(out, [say("init.next", loop=str(output), log=str(log))], "green", "-")
