"""The command that says how a size grows and until when it stays within a limit, thin: parse, call, print."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servoscope.cli.app import app
from servoscope.cli.arguments import parse_time
from servoscope.cli.exit import print_json
from servoscope.cli.options import JsonOption
from servoscope.cli.output_paths import check_output

if TYPE_CHECKING:
    from servoscope.prognosis.series import SizeSeries

PICTURES = (".svg", ".png", ".pdf")


@app.command()
def trend(
    source: Annotated[
        str, typer.Argument(metavar="SIZES", help="CSV file with a header row; or service file or store, with --asset.")
    ],
    limit: Annotated[
        str,
        typer.Option(metavar="X", help="Value at which to stop; or tracking or stability, where the loop loses that."),
    ],
    value: Annotated[
        str | None, typer.Option(metavar="NAME", help="Column with the size; in a store, name of the fault.")
    ] = None,
    asset: Annotated[str | None, typer.Option(metavar="NAME", help="Asset, where sizes come from a store.")] = None,
    time: Annotated[str, typer.Option(metavar="NAME", help="Column with dates, or seconds.")] = "time",
    std: Annotated[str | None, typer.Option(metavar="NAME", help="Column with the standard deviation.")] = None,
    interval: Annotated[
        tuple[str, str] | None, typer.Option(metavar="LOW HIGH", help="Columns with the ends of the 95 % interval.")
    ] = None,
    covariate: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Column of what moves the size without wear (temperature); repeatable."),
    ] = None,
    since: Annotated[
        str | None, typer.Option("--from", metavar="TIME", help="From this time on: after a repair, 2026-01-31T12:00.")
    ] = None,
    loop: Annotated[
        Path | None, typer.Option(metavar="LOOP", help="Loop file of --limit tracking or stability, for a file.")
    ] = None,
    coverage: Annotated[float, typer.Option(metavar="P", help="Probability of the intervals.")] = 0.9,
    as_json: JsonOption = False,
    plot: Annotated[Path | None, typer.Option(metavar="FILE.svg", help="Draw values, limit and forecast.")] = None,
) -> None:
    """Say how a size grows and when it will reach a limit, or that nothing can be said."""
    if not 0.0 < coverage < 1.0:
        raise typer.BadParameter(f"--coverage {coverage:g}: give a number between 0 and 1, such as 0.9")
    is_file = source.lower().endswith(".csv")
    check_output(plot, "--plot", PICTURES, [Path(source)] if is_file else [])
    begin = parse_time(since, "--from")

    from servoscope.prognosis.forecast import prognose
    from servoscope.prognosis.series import read_sizes

    if is_file:
        if value is None:
            raise typer.BadParameter(f"{source}: name the column with the size: --value NAME")
        series = read_sizes(
            Path(source), value, time=time, std=std, interval=interval, covariates=covariate or (), after=begin
        )
    else:
        from servoscope.cli.service import open_store
        from servoscope.service.store.series import query_sizes

        if asset is None:
            raise typer.BadParameter(f"{source}: name the asset: --asset NAME")
        series = query_sizes(open_store(source, [asset]), asset, value, begin)
    prognosis = prognose(series, _find_limit(limit, loop, series, source, asset), coverage)
    if as_json:
        print_json(prognosis.model_dump(mode="json", exclude={"headline", "reasons"}), lines=False)
    else:
        from servoscope.cli.render import results

        out = results.create_console()
        out.print(prognosis.summary, highlight=False)
        results.print_notes(out, prognosis.explanation, "blue", "-")
    if plot is not None:
        from servoscope.cli.render import results
        from servoscope.report.trend_figure import write_trend_figure

        write_trend_figure(plot, series, prognosis)
        results.print_written_path(results.create_console(stderr=as_json), plot)


def _find_limit(text: str, path: Path | None, series: SizeSeries, source: str, asset: str | None) -> float:
    """Return the limit that was given, or at which the loop no longer tracks or loses its margin of stability."""
    if text not in ("tracking", "stability"):
        try:
            return float(text)
        except ValueError:
            raise typer.BadParameter(f"--limit {text}: give a number, tracking or stability") from None

    from servoscope.baseline.baseline import Baseline
    from servoscope.design.operating_limits import operating_limits
    from servoscope.models.loop import Loop

    if path is not None:
        loop = Loop.load(path)
    elif asset is not None and source.endswith(".toml"):
        from servoscope.service.config import ServiceFile

        config = ServiceFile.load(source)
        if asset not in config.assets:
            raise typer.BadParameter(f"--asset {asset}: is not in {source}, give the loop file, --loop loop.toml")
        path = config.folder / config.assets[asset].baseline
        loop = Baseline.load(path).loop
    else:
        raise typer.BadParameter(f"--limit {text}: give the loop file, --loop loop.toml")
    rows = [limit for limit in operating_limits(loop, [series.name]) if limit.kind == text]
    if not rows:
        raise typer.BadParameter(f"--value {series.name}: is no fault of {path}")
    side = rows[0].side(series.value[-1])
    if side is None:
        raise typer.BadParameter(f"--limit {text}: {series.name} does not take it from this loop, give a number")
    return side
