"""The command ``fleet``, thin: parse, call, print."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servoscope.cli import arguments
from servoscope.cli.app import app
from servoscope.cli.arguments import Engines
from servoscope.cli.options import AsJson, ColumnsText
from servoscope.cli.shell import FAULT, print_json

if TYPE_CHECKING:
    from servoscope.fleet import Plan

WINDOW = 120.0  # s; as in servoscope.fleet, which is imported late


@app.command()
def fleet(
    lake: Annotated[str, typer.Argument(metavar="LAKE", help="Folder or URL of Parquet, or a table of files (CSV).")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for results, to be gone on with.")],
    loop: Annotated[Path | None, typer.Option(metavar="LOOP", help="Loop file, to learn baselines with.")] = None,
    baselines: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Or a baseline for all, or a folder with NAME.json for each.")
    ] = None,
    baseline_by: Annotated[
        str, typer.Option(metavar="KEY", help="One baseline per asset, or per group of this key.")
    ] = "asset",
    healthy_days: Annotated[int, typer.Option(metavar="N", min=1, help="Days to learn from, the first ones.")] = 1,
    groups: Annotated[
        Path | None, typer.Option(metavar="FILE.csv", help="Table of groups: asset, supply, site, ...")
    ] = None,
    partition: Annotated[
        str, typer.Option(metavar="ASSET,DAY", help="How the folders call asset and day.")
    ] = "asset,day",
    columns: ColumnsText = None,
    window: Annotated[float, typer.Option(metavar="S", min=1.0, help="Seconds that a diagnosis sees.")] = WINDOW,
    engine: Annotated[Engines, typer.Option(help="local: this machine's cores; spark: a cluster's.")] = Engines.local,
    jobs: Annotated[int | None, typer.Option(metavar="N", min=1, help="Processes; else one per core.")] = None,
    master: Annotated[str | None, typer.Option(metavar="URL", help="Spark's master, if no session says.")] = None,
    as_json: AsJson = False,
    fail_on_fault: Annotated[bool, typer.Option("--fail-on-fault", help="Exit with 3 if an asset is ill.")] = False,
) -> None:
    """Learn and diagnose a whole fleet from its recordings: who is ill, what is common, what changed."""
    if (loop is None) == (baselines is None):
        raise typer.BadParameter("give --loop to learn baselines, or --baselines, and not both")
    keys = tuple(part.strip() for part in partition.split(","))
    if len(keys) != 2 or not all(keys):
        raise typer.BadParameter(f"--partition {partition!r}: write two names, as in asset,day")

    from servoscope.cli import terminal
    from servoscope.cli.progress import counted
    from servoscope.fleet import Lake, Plan, run
    from servoscope.fleet.lake import groups_of
    from servoscope.loop import Loop

    settings = Loop.load(loop) if loop is not None else None
    found = Lake.open(lake, (keys[0], keys[1]), groups_of(groups) if groups is not None else None)
    plan = Plan(
        lake=found,
        output=output,
        loop=settings,
        baselines=baselines,
        by=baseline_by,
        healthy=healthy_days,
        columns=arguments.columns_from(columns, settings.columns if settings is not None else None),
        window_s=window,
    )
    with counted() as tell:
        known = run(plan, _engine(engine, jobs, master), tell)
    if as_json:
        print_json(known.to_dict(), lines=False)
    else:
        from servoscope.cli import fleets

        fleets.fleet(terminal.console(), known)
        terminal.written(terminal.console(), output / "report.html")
    if fail_on_fault and (known.count("fault") or known.accepted):
        raise typer.Exit(FAULT)
