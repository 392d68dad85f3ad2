"""The command that writes a monitor as source text for a drive, thin: parse, call, print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from servoscope.cli.app import app
from servoscope.cli.exit import print_json
from servoscope.cli.options import JsonOption


@app.command()
def export(
    baseline: Annotated[Path, typer.Argument(metavar="BASELINE", help="What learn wrote.")],
    c: Annotated[
        Path | None, typer.Option("--c", metavar="DIR", help="Folder for C99 source, header, self-test, Makefile.")
    ] = None,
    fmu: Annotated[
        Path | None, typer.Option("--fmu", metavar="FILE", help="Co-simulation unit of FMI 3.0 around the C.")
    ] = None,
    st: Annotated[
        Path | None, typer.Option("--st", metavar="DIR", help="Folder for a function block in Structured Text.")
    ] = None,
    name: Annotated[
        str, typer.Option(metavar="PREFIX", help="What files and names of the source begin with.")
    ] = "servo_monitor",
    only_coefficients: Annotated[
        bool,
        typer.Option("--only-coefficients", help="Without the sequential test and the stages that u goes through."),
    ] = False,
    precision: Annotated[
        Literal["double", "single"], typer.Option(help="Of the C; single is for cores without double.")
    ] = "double",
    point: Annotated[str | None, typer.Option(metavar="NAME", help="Operating point, where there are several.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Write the monitor of a baseline for a drive or a simulator: the same results as on the server."""
    from servoscope.baseline.baseline import Baseline
    from servoscope.cli.render import results
    from servoscope.export import UNSEEN_MOTION, export_c, export_fmu, save_st

    if c is None and fmu is None and st is None:
        raise typer.BadParameter("say what to write: --c DIR, --fmu FILE or --st DIR")
    if precision == "single" and (fmu is not None or st is not None):
        raise typer.BadParameter("--precision single is for --c alone")
    learned = Baseline.load(baseline)
    if point is not None:
        learned = learned.at(point)
    summary: dict[str, Any] = {"files": []}
    notes = [UNSEEN_MOTION] if learned.limited_motion is not None else []
    if c is not None:
        made = export_c(learned, name, only_coefficients=only_coefficients, single=precision == "single")
        summary["files"] += map(str, made.save(c))
        summary |= {"state_bytes": made.state_bytes, "constant_bytes": made.constant_bytes}
        notes.append(
            f"{made.state_bytes} bytes of state, {made.constant_bytes} bytes of constants; check it with: "
            f"make -C {c} check"
        )
    if fmu is not None:
        summary["binary"] = export_fmu(learned, fmu, name, only_coefficients=only_coefficients)
        summary["files"].append(str(fmu))
        if not summary["binary"]:
            notes.append(f"{fmu} holds sources only: there is no C compiler here (cc, gcc or clang)")
    if st is not None:
        summary["files"].append(str(save_st(learned, st, name, only_coefficients=only_coefficients)))
    if as_json:
        print_json(summary, lines=False)
        return
    out = results.create_console()
    for path in summary["files"]:
        results.print_written_path(out, path)
    results.print_notes(out, notes, "blue", "-")
