"""The command that learns an asset's baseline anew from the store, thin: parse, call, print."""

from __future__ import annotations

import getpass
from pathlib import Path
from typing import Annotated

import typer

from servoscope.cli.app import app
from servoscope.cli.arguments import parse_time
from servoscope.cli.baseline import AfterOption, print_difference
from servoscope.cli.options import JsonOption, ReasonOption, UserOption
from servoscope.cli.progress import show_steps


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
