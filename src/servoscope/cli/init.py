"""The command that begins: a loop file from logs."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servoscope.cli import arguments, arm
from servoscope.cli.app import app
from servoscope.cli.exit import FailureCounter
from servoscope.cli.options import ReadingOptions, with_reading_options
from servoscope.cli.output_paths import check_output
from servoscope.cli.progress import show_steps
from servoscope.core.errors import OutputError, ServoscopeError
from servoscope.core.messages import render, say

if TYPE_CHECKING:
    from rich.console import Console

    from servoscope.models.loop import Columns

MAX_LISTED_PLANTS = 6


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
    urdf: Annotated[Path | None, typer.Option(metavar="FILE", help="Of a robot arm: its URDF.")] = None,
) -> None:
    """Look at logs, compare plants, propose a loop file with the evidence for each line, write it, inspect the logs."""
    logs = arguments.expand_files(logs)
    check_output(output, "-o", (".toml",), logs)
    if urdf is not None:
        arm.refuse_options(reading.given())
        arm.write_proposal(logs, urdf, output, yes)
        return

    from servoscope.cli.render import results
    from servoscope.learning.proposal import PART_ROWS, propose_columns
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
            with read_part(PART_ROWS) as part:
                _propose(out, logs, chosen.model_copy(update=reader.changes), target, asks, reader.where)
            cut = [say("init.part", log=name, rows=count) for name, count in part.cut.items()]
            results.print_notes(out, cut, "blue", "-")
    failures.exit_if_any()


def _axis_file(output: Path, axis: str | None) -> Path:
    """Return the loop file of one axis of several."""
    return output.with_name(f"{output.stem}-{axis}{output.suffix}")


def _propose(out: Console, logs: list[Path], columns: Columns, output: Path, asks: bool, where: dict[str, str]) -> None:
    """Print the proposal for logs with its evidence, write it, and inspect the logs with it."""
    from servoscope.cli.render import results
    from servoscope.learning import inspection
    from servoscope.learning.proposal import propose_loop
    from servoscope.signals import readers

    with show_steps(1, 1) as steps:
        steps.begin(logs[0].name)
        proposal = propose_loop(logs, columns, where)
    lines = [
        (f"{line.section}.{line.key}".lstrip("."), line.value + " ?" * line.doubtful, render(line.why))
        for line in proposal.lines
    ]
    results.print_table(out, ("setting", "proposed", "why"), lines, words=3)
    compared = [(plant.words, f"{100.0 * plant.explained:.2f} %") for plant in proposal.candidates[:MAX_LISTED_PLANTS]]
    results.print_table(out, ("plant", "explained of u"), compared)
    notes = [say("init.compared", count=len(proposal.candidates)), *map(render, proposal.notes)]
    if any(line.doubtful for line in proposal.lines):
        notes.append(say("init.doubtful"))
    results.print_notes(out, notes)
    if asks and any(line.doubtful for line in proposal.lines):
        typer.confirm(say("init.confirm"), default=True, abort=True)
    proposal.save(output)
    results.print_written_path(out, output)
    usable = []
    for log in logs:
        try:
            with show_steps(1, 1) as steps:
                steps.begin(log.name)
                inspected = inspection.inspect(readers.read(log, proposal.loop, where=where), proposal.loop)
        except ServoscopeError:  # the notes say why
            continue
        results.print_inspection(out, inspected)
        usable += [log] * (inspected.verdict != "not usable")
    if usable:
        learned = " ".join(shlex.quote(str(log)) for log in usable)
        if where:
            learned += " --where " + shlex.quote(",".join(f"{column}={value}" for column, value in where.items()))
        results.print_command(
            out, say("init.next"), f"servoscope learn {shlex.quote(str(output))} {learned} -o baseline.json"
        )
    else:
        results.print_notes(out, [say("init.not_usable", loop=str(output))])
