"""The commands ``baseline ...`` and ``relearn``, and ``learn --add``: history, comparison and renewal of baselines."""

from __future__ import annotations

import getpass
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from servoscope.cli.app import app
from servoscope.cli.arguments import RecordingReader, parse_healthy, parse_time
from servoscope.cli.exit import print_json
from servoscope.cli.options import JsonOption, ReadingOptions, ReasonOption, UserOption
from servoscope.cli.progress import show_steps

if TYPE_CHECKING:
    from servoscope.baseline.baseline import Baseline

baseline_app = typer.Typer(no_args_is_help=True, help="What became of a baseline, and what differs between two.")
app.add_typer(baseline_app, name="baseline")

BaselineArgument = Annotated[Path, typer.Argument(metavar="BASELINE", help="Baseline file (JSON).")]
AfterOption = Annotated[
    Literal["repair", "tool", "product", "season"] | None,
    typer.Option(help="With --add: what was done before. All but a season replace the earlier recordings."),
]


def add_recordings(
    path: Path | None,
    texts: Sequence[str],
    reading: ReadingOptions,
    as_json: bool,
    after: Literal["repair", "tool", "product", "season"] | None,
    why: str,
    who: str | None,
    accept_change: bool,
    *,
    accept_delay: bool,
    force: bool,
) -> None:
    """Learn a baseline anew with further recordings, and print what differs; None: other options do not go with it."""
    if path is None:
        raise typer.BadParameter("--add goes with -b BASELINE, and with neither -o nor the options of other recordings")
    from servoscope.baseline.baseline import Baseline
    from servoscope.cli.render import results
    from servoscope.diagnosis.relearn import relearn
    from servoscope.signals import Recording

    before, named = Baseline.load(path), parse_healthy(list(texts))
    reader = RecordingReader.from_options(before.loop, reading)
    recordings: dict[str, list[Recording | Path]] = {point: [] for point, _ in named}
    with show_steps(len(named) + 1, 8) as steps:
        for point, file in named:
            steps.begin(file.name)
            recordings[point] += reader.read(file)
        steps.begin("learning")
        folders = [file.parent for _, file in named]
        learned = relearn(
            path,
            recordings,
            steps.advance,
            after=after,
            who=who or getpass.getuser(),
            why=why,
            accept_change=accept_change,
            accept_delay=accept_delay,
            force=force,
            folders=folders,
        )
    print_difference(before, learned, as_json)
    if not as_json:
        results.print_notes(results.create_console(), learned.notes)
        results.print_written_path(results.create_console(), path)


def print_difference(
    before: Baseline, after: Baseline, as_json: bool, extra: Mapping[str, object] | None = None
) -> None:
    """Print what moved between two baselines, and what each of them can detect; `extra`: in the JSON too."""
    from servoscope.baseline.comparison import compare_baselines
    from servoscope.cli.render import results
    from servoscope.report.format_values import format_percent

    differences = compare_baselines(before, after)
    if as_json:
        points = [difference.to_dict() for difference in differences]
        revision = after.revision.model_dump(mode="json")
        print_json(
            {"before": before.hash, "after": after.hash, "revision": revision, "points": points, **(extra or {})},
            lines=False,
        )
        return
    out = results.create_console()
    for difference in differences:
        if difference.point:
            results.print_title(out, difference.point, "")
        moves = [
            (
                row.name,
                f"{row.before:.4g}",
                f"{row.after:.4g}",
                _signed(row.change),
                "" if row.certain else "within its scatter",
            )
            for row in difference.moves
        ]
        results.print_table(out, ("parameter", "before", "after", "change", ""), moves)
        sizes = [
            (row.name, *("never" if size is None else format_percent(size) for size in (row.before, row.after)))
            for row in difference.detectable
        ]
        results.print_table(out, ("fault", "detected from, before", "after"), sizes)


def _signed(change: float | None) -> str:
    return "" if change is None else f"{100.0 * change:+.1f} %"


@baseline_app.command("log")
def print_log(path: BaselineArgument, as_json: JsonOption = False) -> None:
    """List the baselines of a file: when each was learned, by whom, why, and from what."""
    from servoscope.baseline.history import read_history
    from servoscope.cli.render import results
    from servoscope.core.messages import FORMATS

    rows = [
        {
            **baseline.revision.model_dump(mode="json"),
            "hash": baseline.hash,
            "sources": [source.name for point in baseline.per_point for source in point.sources],
        }
        for baseline in read_history(path).values()
    ]
    if as_json:
        print_json(rows, lines=False)
        return
    header = ("number", "when", "kind", "who", "why", "recordings")
    cells = [
        (
            str(row["number"]),
            FORMATS["utc"](row["at"]) if row["at"] is not None else "",
            *(row[key] for key in ("kind", "who", "why")),
            str(len(row["sources"])),
        )
        for row in rows
    ]
    results.print_table(results.create_console(), header, cells, 5)


@baseline_app.command()
def diff(before: BaselineArgument, after: BaselineArgument, as_json: JsonOption = False) -> None:
    """Say what moved between two baselines, and which changes each of them can detect."""
    from servoscope.baseline.baseline import Baseline

    print_difference(Baseline.load(before), Baseline.load(after), as_json)


@baseline_app.command()
def back(path: BaselineArgument, who: UserOption = None, why: ReasonOption = "", as_json: JsonOption = False) -> None:
    """Put the baseline in force that the present one was made from; the present one is kept."""
    from servoscope.baseline.baseline import Baseline
    from servoscope.baseline.history import step_back

    before = Baseline.load(path)
    print_difference(before, step_back(path, who or getpass.getuser(), why), as_json)


@app.command()
def relearn(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="Service file (TOML).")],
    asset: Annotated[str, typer.Argument(metavar="ASSET", help="Whose baseline.")],
    since: Annotated[
        str | None,
        typer.Option("--since", metavar="TIME", help="Learn from what came since: 2026-01-31T12:00 (UTC), or 8h ago."),
    ] = None,
    until: Annotated[str | None, typer.Option("--to", metavar="TIME", help="And before this time.")] = None,
    after: AfterOption = None,
    why: ReasonOption = "",
    who: UserOption = None,
    accept_change: Annotated[
        bool, typer.Option("--accept-change", help="Learn although the stretch is a fault, and note it.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Put it in force; otherwise only a preview is printed.")] = False,
    back: Annotated[bool, typer.Option("--back", help="Put the earlier baseline in force again instead.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Learn an asset's baseline anew from the samples that the store keeps: a preview, and with --yes in force."""
    from servoscope.baseline.baseline import Baseline
    from servoscope.cli.render import results
    from servoscope.cli.service import open_store
    from servoscope.diagnosis.relearn import relearn as learn_anew
    from servoscope.service import renewal
    from servoscope.service.assets.status import AssetStatus
    from servoscope.service.config import ServiceFile

    settings, store = ServiceFile.load(config), open_store(str(config), [asset])
    status = AssetStatus.model_validate(store.statuses([asset])[asset]["status"])
    t, who, path = status.position.t, who or getpass.getuser(), settings.baseline_file(asset)
    before = Baseline.load(path)
    if back:
        print_difference(before, renewal.go_back(settings, store, asset, who, why, t), as_json)
        return
    noted = renewal.learning_progress(settings, store, asset, status, before)
    begin = parse_time(since, "--since") if since is not None else noted.since
    stretch = renewal.stored_stretch(settings, store, asset, before, begin, parse_time(until, "--to"))
    with show_steps(1, 8) as steps:
        steps.begin(stretch.name)
        learned = learn_anew(
            path,
            {settings.assets[asset].point or "": [stretch]},
            steps.advance,
            after=after or noted.after,
            who=who,
            why=why,
            accept_change=accept_change,
            leave_out=True,
            save=False,
        )
    judged = renewal.judge_again(store, asset, before, learned, t)
    print_difference(before, learned, as_json, {"judged": judged._asdict()})
    out = results.create_console(stderr=as_json)
    if not as_json:
        results.print_facts(
            out, [("past values beyond the limit", f"{judged.before} before, {judged.after} after, of {judged.values}")]
        )
        results.print_notes(out, [*learned.notes, *renewal.offers(learned, status, settings.diagnosis.kept_s)])
    if yes:
        results.print_written_path(out, renewal.put_in_force(settings, store, asset, learned, stretch, t))
