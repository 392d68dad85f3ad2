"""The commands for arms alone: the proposal of a loop file from a URDF, and the calibration with a known load."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from servoscope.cli.app import app
from servoscope.cli.output_paths import check_output
from servoscope.core.errors import OutputError
from servoscope.core.files import atomic_write
from servoscope.core.messages import say


def write_proposal(logs: Sequence[Path], urdf: Path, output: Path, replace: bool) -> None:
    """Propose the loop file of an arm from a log and its URDF, write it, and print it."""
    from servoscope.cli.render import results
    from servoscope.machines.kinds import machine_class

    if output.exists() and not replace:
        raise OutputError(f"{output}: exists; name another file with -o, or replace it with --yes")
    arm: Any = machine_class("arm")
    text = arm.propose(logs[0], urdf, output.parent)
    atomic_write(output, text.encode())
    out = results.create_console()
    typer.echo(text)
    results.print_written_path(out, output)
    learn = shlex.join(["servoscope", "learn", str(output), *map(str, logs), "-o", "baseline.json"])
    results.print_command(out, say("init.next"), learn)


@app.command("calibrate-load")
def calibrate(
    baseline: Annotated[Path, typer.Argument(metavar="BASELINE", help="Of an arm, learned without the load.")],
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Log of moves with the load.")],
    mass: Annotated[float, typer.Option(metavar="KG", min=0.01, help="Mass of the load [kg].")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="LOOP", help="Loop file to write.")],
) -> None:
    """Find the drive gains of an arm from a load of known mass, and write its loop file with them."""
    check_output(output, "-o", (".toml",), [baseline, log])

    from servoscope.cli.render import results
    from servoscope.machines.kinds import machine_class

    arm: Any = machine_class("arm")
    text, rows, open_joints = arm.load(baseline).calibrate(log, mass)
    atomic_write(output, text.encode())
    out = results.create_console()
    results.print_table(out, ("joint", "drive gain"), rows)
    results.print_notes(out, [say("arm.gain_open", joints=open_joints)] if open_joints else [])
    results.print_written_path(out, output)
