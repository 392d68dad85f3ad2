"""The command ``fleet``, thin: parse, call, print."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from servoscope.cli import arguments
from servoscope.cli.app import app
from servoscope.cli.exit import EXIT_FAULT, print_json
from servoscope.cli.options import ColumnsOption, JsonOption, with_options
from servoscope.cli.progress import show_count, show_spinner

if TYPE_CHECKING:
    from pyspark.sql import SparkSession

    from servoscope.fleet.tasks import Engine

KAFKA = "kafka"  # in the place of LAKE, with --source kafka.bootstrap.servers=... --source subscribe=...
WINDOW = 120.0  # s; as in servoscope.fleet, which is imported late: --help must not wait for it


@dataclass(frozen=True)
class StreamOptions:
    """How a stream is followed."""

    assets: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Stream: how many share the false alarms; else the baselines."),
    ] = None
    every: Annotated[
        float | None,
        typer.Option(metavar="S", min=0.0, help="Stream: seconds between batches; else what is there, once."),
    ] = None
    late: Annotated[float, typer.Option(metavar="S", min=0.0, help="Stream: how late rows may be.")] = 10.0
    checkpoint: Annotated[str | None, typer.Option(metavar="URL", help="Stream: else in the folder for results.")] = (
        None
    )
    store: Annotated[
        str | None, typer.Option(metavar="URL", help="Stream: SQLite file or URL that diagnoses go to as well.")
    ] = None
    source: Annotated[
        list[str] | None, typer.Option(metavar="KEY=VALUE", help="Stream: options of Spark's source; repeatable.")
    ] = None


@app.command()
@with_options("feed", StreamOptions)
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
    population: Annotated[
        list[Path] | None,
        typer.Option(metavar="BASELINE", help="Baseline of a like machine, folder or pattern of them; repeatable."),
    ] = None,
    groups: Annotated[
        Path | None, typer.Option(metavar="FILE.csv", help="Table of groups: asset, supply, site, ...")
    ] = None,
    partition: Annotated[
        str, typer.Option(metavar="ASSET,DAY", help="How the folders call asset and day.")
    ] = "asset,day",
    columns: ColumnsOption = None,
    window: Annotated[float, typer.Option(metavar="S", min=1.0, help="Seconds that a diagnosis sees.")] = WINDOW,
    engine: Annotated[
        Literal["local", "spark"], typer.Option(help="local: this machine's cores; spark: a cluster's.")
    ] = "local",
    jobs: Annotated[int | None, typer.Option(metavar="N", min=1, help="Processes; else one per core.")] = None,
    master: Annotated[str | None, typer.Option(metavar="URL", help="Spark's master, if no session says.")] = None,
    stream: Annotated[bool, typer.Option("--stream", help="Follow what comes into LAKE, with Spark.")] = False,
    *,
    feed: StreamOptions,
    as_json: JsonOption = False,
    fail_on_fault: Annotated[bool, typer.Option("--fail-on-fault", help="Exit with 3 if an asset is ill.")] = False,
) -> None:
    """Learn and diagnose a whole fleet from its recordings: who is ill, what is common, what changed."""
    if (loop is None) == (baselines is None):
        raise typer.BadParameter("give --loop to learn baselines, or --baselines, and not both")
    if population and loop is None:
        raise typer.BadParameter("--population goes with --loop: baselines that exist are taken as they are")
    keys = tuple(part.strip() for part in partition.split(","))
    if len(keys) != 2 or not all(keys):
        raise typer.BadParameter(f"--partition {partition!r}: write two names, as in asset,day")

    from servoscope.fleet import Lake, Plan, run
    from servoscope.fleet.lake import read_groups
    from servoscope.fleet.sinks import write_stream_report
    from servoscope.models.loop import Loop

    named = read_groups(groups) if groups is not None else {}
    if stream:
        if baselines is None:
            raise typer.BadParameter("--stream goes with --baselines: learn them from the lake first")
        session = _follow(feed, lake, output, baselines, baseline_by, columns, window, master)
        if lake != KAFKA:
            items = Lake.open(lake, (keys[0], keys[1]), named).items
            named = {item.asset: dict(item.groups) for item in items}
        result = write_stream_report(session, output, named, lake)
    else:
        settings = Loop.load(loop) if loop is not None else None
        plan = Plan(
            lake=Lake.open(lake, (keys[0], keys[1]), named),
            output=output,
            loop=settings,
            baselines=baselines,
            by=baseline_by,
            healthy=healthy_days,
            columns=arguments.parse_mapping(columns, settings.columns if settings is not None else None),
            window_s=window,
            population=tuple(arguments.expand_baselines(population or [])),
        )
        with show_count() as tell:
            result = run(plan, _engine(engine, jobs, master), tell)
    if as_json:
        print_json(result.to_dict(), lines=False)
    else:
        from servoscope.cli.render import fleet, results

        fleet.print_fleet(results.create_console(), result)
        results.print_written_path(results.create_console(), output / "report.html")
    if fail_on_fault and (result.count("fault") or result.accepted):
        raise typer.Exit(EXIT_FAULT)


def _engine(engine: Literal["local", "spark"], jobs: int | None, master: str | None) -> Engine:
    from servoscope.estimation.kernel.threads import core_count
    from servoscope.fleet.spark import session, spark
    from servoscope.fleet.tasks import local

    return spark(session(master)) if engine == "spark" else local(jobs or core_count())


def _follow(
    feed: StreamOptions,
    lake: str,
    output: Path,
    baselines: Path,
    by: str,
    columns: str | None,
    window: float,
    master: str | None,
) -> SparkSession:
    """Follow what comes in: all there is, or on and on until interrupted; return the session."""
    from servoscope.fleet import sinks
    from servoscope.fleet.baselines import Baselines
    from servoscope.fleet.spark import session
    from servoscope.fleet.streaming import follow

    count = feed.assets or (sum(1 for _ in baselines.glob("*.json")) if baselines.is_dir() else None)
    if count is None:
        raise typer.BadParameter("--assets N: say how many assets share the budget of false alarms")
    learned = Baselines.from_source(baselines, count, window).first().loop.columns
    mapping = arguments.parse_mapping(columns, learned) or learned
    spark = session(master)
    make = sinks.kafka_stream if lake == KAFKA else sinks.file_stream
    frame = make(spark, lake, mapping, dict(text.partition("=")[::2] for text in feed.source or ()))
    followed = follow(frame, baselines, assets=count, columns=mapping, delay_s=feed.late, by=by, window_s=window)
    query = sinks.start(followed, output, checkpoint=feed.checkpoint, every_s=feed.every, store=feed.store)
    with show_spinner("following the stream"):
        sinks.wait_for_stream(query)
    return spark
