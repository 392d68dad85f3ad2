"""The command ``fleet``, thin: parse, call, print."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from servoscope.cli import arguments
from servoscope.cli.app import app
from servoscope.cli.arguments import Engines
from servoscope.cli.options import AsJson, ColumnsText
from servoscope.cli.shell import FAULT, print_json

if TYPE_CHECKING:
    from servoscope.fleet import Fleet

KAFKA = "kafka"  # in the place of LAKE, with --source kafka.bootstrap.servers=... --source subscribe=...
WINDOW = 120.0  # s; as in servoscope.fleet, which is imported late


@app.command()
def fleet(
    lake: Annotated[str, typer.Argument(metavar="LAKE", help="Folder or URL of Parquet, or a table of files (CSV).")],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for results, to be gone on with.")
    ],
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
    stream: Annotated[bool, typer.Option("--stream", help="Follow what comes into LAKE, with Spark.")] = False,
    assets: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Stream: how many share the false alarms; else the baselines."),
    ] = None,
    every: Annotated[
        float | None,
        typer.Option(metavar="S", min=0.0, help="Stream: seconds between batches; else what is there, once."),
    ] = None,
    late: Annotated[float, typer.Option(metavar="S", min=0.0, help="Stream: how late rows may be.")] = 10.0,
    checkpoint: Annotated[
        str | None, typer.Option(metavar="URL", help="Stream: else in the folder for results.")
    ] = None,
    store: Annotated[
        str | None, typer.Option(metavar="URL", help="Stream: SQLite file or URL that diagnoses go to as well.")
    ] = None,
    source: Annotated[
        list[str] | None, typer.Option(metavar="KEY=VALUE", help="Stream: options of Spark's source; repeatable.")
    ] = None,
    as_json: AsJson = False,
    fail_on_fault: Annotated[bool, typer.Option("--fail-on-fault", help="Exit with 3 if an asset is ill.")] = False,
) -> None:
    """Learn and diagnose a whole fleet from its recordings: who is ill, what is common, what changed."""
    if (loop is None) == (baselines is None):
        raise typer.BadParameter("give --loop to learn baselines, or --baselines, and not both")
    keys = tuple(part.strip() for part in partition.split(","))
    if len(keys) != 2 or not all(keys):
        raise typer.BadParameter(f"--partition {partition!r}: write two names, as in asset,day")

    asked = _Asked(
        lake, output, loop, baselines, baseline_by, healthy_days, groups, (keys[0], keys[1]), columns, window
    )
    if stream:
        known = _streamed(asked, master, _Stream(assets, every, late, checkpoint, tuple(source or ()), store))
    else:
        known = _examined(asked, engine, jobs, master)
    if as_json:
        print_json(known.to_dict(), lines=False)
    else:
        from servoscope.cli import fleets, terminal

        fleets.fleet(terminal.console(), known)
        terminal.written(terminal.console(), output / "report.html")
    if fail_on_fault and (known.count("fault") or known.accepted):
        raise typer.Exit(FAULT)


class _Stream(NamedTuple):
    assets: int | None
    every: float | None
    late: float
    checkpoint: str | None
    source: tuple[str, ...]
    store: str | None


class _Asked(NamedTuple):
    lake: str
    output: Path
    loop: Path | None
    baselines: Path | None
    by: str
    healthy: int
    groups: Path | None
    partition: tuple[str, str]
    columns: str | None
    window: float


def _examined(asked: _Asked, engine: Engines, jobs: int | None, master: str | None) -> Fleet:
    """Run over what is in the lake."""
    from servoscope.cli.progress import counted
    from servoscope.fleet import Lake, Plan, run
    from servoscope.fleet.lake import groups_of
    from servoscope.fleet.local import cores, local
    from servoscope.loop import Loop

    settings = Loop.load(asked.loop) if asked.loop is not None else None
    groups = groups_of(asked.groups) if asked.groups is not None else None
    plan = Plan(
        lake=Lake.open(asked.lake, asked.partition, groups),
        output=asked.output,
        loop=settings,
        baselines=asked.baselines,
        by=asked.by,
        healthy=asked.healthy,
        columns=arguments.columns_from(asked.columns, settings.columns if settings is not None else None),
        window_s=asked.window,
    )
    if engine is Engines.spark:
        from servoscope.fleet.spark import session, spark

        carry = spark(session(master))
    else:
        carry = local(jobs or cores())
    with counted() as tell:
        return run(plan, carry, tell)


def _streamed(asked: _Asked, master: str | None, how: _Stream) -> Fleet:
    """Follow what comes in: all there is, or on and on until interrupted; write the report at the end."""
    from servoscope.cli.progress import waiting
    from servoscope.fleet import Lake, sinks
    from servoscope.fleet.baselines import Baselines
    from servoscope.fleet.lake import groups_of
    from servoscope.fleet.spark import session
    from servoscope.fleet.streaming import follow

    path = asked.baselines
    if path is None:
        raise typer.BadParameter("--stream goes with --baselines: learn them from the lake first")
    assets = how.assets or (sum(1 for _ in path.glob("*.json")) if path.is_dir() else None)
    if assets is None:
        raise typer.BadParameter("--assets N: say how many assets share the budget of false alarms")
    known = Baselines.of(path, assets, asked.window).any().loop.columns
    columns = arguments.columns_from(asked.columns, known) or known
    options = dict(text.partition("=")[::2] for text in how.source)
    found = session(master)
    make = sinks.kafka if asked.lake == KAFKA else sinks.files
    frame = make(found, asked.lake, columns, options)
    followed = follow(frame, path, assets=assets, columns=columns, delay_s=how.late, by=asked.by, window_s=asked.window)
    query = sinks.start(followed, asked.output, checkpoint=how.checkpoint, every_s=how.every, store=how.store)
    with waiting("following the stream"):
        sinks.wait(query)
    groups = groups_of(asked.groups) if asked.groups is not None else {}
    if asked.lake != KAFKA:
        lake = Lake.open(asked.lake, asked.partition, groups)
        groups = {item.asset: dict(item.groups) for item in lake.items}
    return sinks.report(found, asked.output, groups, asked.lake)
