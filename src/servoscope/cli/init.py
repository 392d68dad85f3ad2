"""The command that begins: a loop file from logs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from servoscope.cli import arguments, arm, machines
from servoscope.cli.app import app
from servoscope.cli.exit import FailureCounter
from servoscope.cli.options import ReadingOptions, with_reading_options
from servoscope.cli.output_paths import check_output
from servoscope.cli.progress import show_steps
from servoscope.core.errors import OutputError, ServoscopeError
from servoscope.core.messages import say

if TYPE_CHECKING:
    from rich.console import Console

    from servoscope.learning.loop_proposal import LoopProposal


@app.command()
@with_reading_options("by", "from_s", "to_s")
def init(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG", help="Logs of the healthy machine at work.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="LOOP", help="Loop file to write.")] = Path(
        "loop.toml"
    ),
    *,
    reading: ReadingOptions,
    yes: Annotated[bool, typer.Option("--yes", help="Take what is proposed; ask nothing.")] = False,
    kind: Annotated[
        Literal["axis", "cylinder", "polynomial"] | None, typer.Option(help="Kind of the plant, where it is known.")
    ] = None,
    details: Annotated[bool, typer.Option("--details", help="Print all evidence: reasons, plants, logs.")] = False,
    urdf: Annotated[Path | None, typer.Option(metavar="FILE", help="Of a robot arm: its URDF.")] = None,
) -> None:
    """Look at logs, compare plants, propose a loop file with the evidence for each line, write it, inspect the logs."""
    logs = arguments.expand_files(logs)
    check_output(output, "-o", (".toml",), logs)
    if urdf is not None:
        machines.refuse_options("arm", reading.given())
        arm.write_proposal(logs, urdf, output, yes)
        return

    from servoscope.cli.render import results
    from servoscope.learning.proposal import PART_ROWS, propose_columns, propose_loop
    from servoscope.signals import readers
    from servoscope.signals.readers.axes import axes_of, moving_axes
    from servoscope.signals.readers.table import read_part

    log, asks = logs[0], not yes and sys.stdin.isatty() and sys.stdout.isatty()
    reader = arguments.RecordingReader.from_options(None, reading)
    out = results.create_console()
    with read_part(PART_ROWS), show_steps(1, 1) as steps:
        steps.begin(log.name)
        channels = readers.list_channels(log, reader.text)
    if asks and reading.columns is None:
        results.print_channels(out, log, channels, reading.rate)
    axes = [reading.axis] if reading.axis is not None or reading.columns is not None else []
    several = [] if axes else [*axes_of(channels)]
    moving = [*moving_axes(channels)] if several else []
    axes = axes or list[str | None](moving) or [None]
    targets = [_axis_file(output, axis) if len(axes) > 1 or moving else output for axis in axes]
    for target in targets:
        if target.exists() and not yes:
            raise OutputError(f"{target}: exists; name another file with -o, or replace it with --yes")
    if several:
        results.print_notes(out, [say("init.axes", axes=moving)] if moving else [])
        if resting := [axis for axis in several if axis not in moving]:
            results.print_notes(out, [say("init.axes_at_rest", axes=resting)])
    failures = FailureCounter()
    for axis, target in zip(axes, targets, strict=True):
        with failures.catch():
            chosen = None
            try:
                chosen = propose_columns(log, channels, axis, reading.columns)
            except ServoscopeError as error:
                if not asks or reading.columns is not None:
                    raise
                out.print(str(error))
            open_question = asks and reading.columns is None
            if open_question and (chosen is None or not typer.confirm(say("init.confirm_columns"), default=True)):
                chosen = propose_columns(log, channels, axis, typer.prompt(say("init.ask_columns")))
            assert chosen is not None, "it was proposed, or asked for"
            with read_part(PART_ROWS) as part, show_steps(1, 1) as steps:
                steps.begin(log.name)
                columns = chosen.model_copy(update=reader.changes)
                proposal = propose_loop(logs, columns, reader.where, kind=kind)
            _print_and_save(out, proposal, target, asks, details, reader.where)
            cut = [say("init.part", log=name, rows=count) for name, count in part.cut.items()]
            results.print_notes(out, cut, "blue", "-")
    failures.exit_if_any()


def _axis_file(output: Path, axis: str | None) -> Path:
    """Return the loop file of one axis of several."""
    return output.with_name(f"{output.stem}-{axis}{output.suffix}")


def _print_and_save(
    out: Console, proposal: LoopProposal, output: Path, asks: bool, details: bool, where: dict[str, str]
) -> None:
    """Print the proposal with what is in doubt, write it, and print the next command."""
    from servoscope.cli.render import proposal as rendered
    from servoscope.cli.render import results

    if details:
        rendered.print_details(out, proposal)
    rendered.print_proposal(out, proposal)
    if asks and any(line.doubtful for line in proposal.lines):
        typer.confirm(say("init.confirm"), default=True, abort=True)
    proposal.save(output)
    results.print_written_path(out, output)
    rendered.print_next(out, proposal, output, where)
