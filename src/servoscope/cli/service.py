"""The commands of the service: run it, watch it, ask its history."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servoscope.cli.app import app
from servoscope.cli.moments import moment
from servoscope.cli.options import AsJson
from servoscope.cli.outputs import check_output
from servoscope.cli.shell import print_json
from servoscope.complaints import instead
from servoscope.errors import ConfigError, StoreError

if TYPE_CHECKING:
    from rich.console import Group

    from servoscope.store import Store

ConfigFile = Annotated[Path, typer.Argument(metavar="CONFIG", help="Service file (TOML).")]
StoreText = Annotated[
    str, typer.Argument(metavar="STORE", help="Service file, SQLite file, or URL of a PostgreSQL database.")
]
OfAsset = Annotated[list[str] | None, typer.Option(metavar="NAME", help="Only this asset; repeatable.")]

EXPORTS = (".csv", ".parquet", ".pq", ".json")
SHOWN = 50


class Kinds(StrEnum):
    """What ``history`` can tell."""

    diagnoses = "diagnoses"
    alarms = "alarms"
    audit = "audit"
    residuals = "residuals"
    deliveries = "deliveries"


COLUMNS = {
    Kinds.diagnoses: ("t", "asset", "grounds", "summary"),
    Kinds.alarms: ("t", "asset", "alarm", "after", "who", "cause"),
    Kinds.audit: ("at", "who", "asset", "what", "document"),
    Kinds.residuals: ("t", "asset", "statistic", "level"),
    Kinds.deliveries: ("created", "sink", "told", "attempts", "due", "outcome"),
}


@app.command()
def run(
    config: ConfigFile,
    anew: Annotated[
        list[str] | None,
        typer.Option(metavar="ASSET", help="Begin with a new state behind the samples that were counted; repeatable."),
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="Read the service file and what it names, and stop.")] = False,
) -> None:
    """Follow assets until stopped: what their sources say goes to the store, alarms go out; logs on stderr."""
    from servoscope.live import logs
    from servoscope.live.assembling import assemble, rehearse
    from servoscope.live.config import Config

    settings = Config.load(config)
    if check:
        with naming(config):
            rehearse(settings)
        found = {"asset": len(settings.assets), "source": len(settings.sources)}
        counted = ", ".join(f"{count} {name}{'s' * (count > 1)}" for name, count in found.items())
        typer.echo(f"{config}: {counted}; all can be used")
        return
    logs.set_up(settings.service.log)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))  # nothing is in hand yet
    from servoscope.live.service import Service
    from servoscope.live.serving import serve
    from servoscope.web.beside import Beside

    with naming(config):
        service = Service(settings, assemble(settings, anew or ()))
        server = serve(service, settings.service.listen) if settings.service.listen else None
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: service.stop())
    pages = Beside(config) if settings.web is not None else None
    try:
        if pages is not None:
            pages.start()
        service.run()
    finally:
        if pages is not None:
            pages.stop()
        if server is not None:
            server.shutdown()


@app.command()
def watch(
    store: StoreText,
    asset: OfAsset = None,
    every: Annotated[float, typer.Option(metavar="S", min=0.1, help="Time between two looks, in s.")] = 1.0,
    once: Annotated[bool, typer.Option("--once", help="Look once and stop.")] = False,
    as_json: AsJson = False,
) -> None:
    """Show assets as they are now: verdict, since when, residuals, alarms; read from the store."""
    from servoscope.cli import terminal, watching
    from servoscope.store.history import standing

    opened, out = open_store(store), terminal.console()

    def page() -> Group:
        statuses = opened.statuses(asset)
        of = {name: row["status"] for name, row in statuses.items()}
        ill = {name: said["since"] for name, said in of.items() if said.get("verdict") == "fault"}
        return watching.page(statuses, standing(opened, ill), out.width)

    known(opened, asset or ())
    if as_json:
        print_json(list(opened.statuses(asset).values()), lines=False)
    elif once:
        out.print(page())
    else:
        from rich.live import Live

        with Live(console=out, auto_refresh=False) as live:
            while True:
                live.update(page(), refresh=True)
                time.sleep(every)


@app.command()
def history(
    store: StoreText,
    kind: Annotated[Kinds, typer.Option(help="What to tell.")] = Kinds.diagnoses,
    asset: OfAsset = None,
    since: Annotated[
        str | None, typer.Option("--from", metavar="TIME", help="From this time on: 2026-01-31T12:00 (UTC), or 8h ago.")
    ] = None,
    until: Annotated[str | None, typer.Option("--to", metavar="TIME", help="Before this time.")] = None,
    last: Annotated[
        int | None, typer.Option(metavar="N", min=1, help=f"Only the newest N; on a terminal {SHOWN} by default.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="FILE", help="Write to FILE.csv, FILE.parquet or FILE.json."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Tell what happened, in the order of time, or export it."""
    check_output(output, "-o", EXPORTS, [])
    span = moment(since, "--from"), moment(until, "--to")

    from servoscope.cli import terminal, watching
    from servoscope.store.history import history as rows_of
    from servoscope.store.history import plain

    shown = last if last is not None or as_json or output is not None else SHOWN
    opened = open_store(store)
    known(opened, asset or ())
    rows = rows_of(opened, kind, assets=asset or (), span=span, last=shown)
    if output is not None:
        export(output, rows)
        terminal.written(terminal.console(stderr=True), output)
    elif as_json:
        for row in rows:
            print_json(plain(row), lines=True)
    else:
        terminal.console().print(watching.rows(rows, COLUMNS[kind]))


@contextmanager
def naming(config: Path) -> Iterator[None]:
    """Put the name of the service file before what is wrong in it."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{config}: {error}") from None


def open_store(text: str) -> Store:
    """Open a store for reading, by a service file or by itself; a locked one is waited for."""
    from servoscope.store import Store

    if text.endswith(".toml"):
        from servoscope.live.config import Config

        config = Config.load(text)
        return Store.open(config.store.url, config.folder, patience=5.0)
    return Store.open(text, patience=5.0)


def known(store: Store, assets: Sequence[str]) -> None:
    """Refuse assets that the store knows nothing of: an empty answer would look like peace."""
    there = store.statuses() if assets else {}
    for name in assets:
        if name not in there:
            raise StoreError(f"{name}: no such asset in {store.name}, {instead(name, there)}")


def export(path: Path, rows: list[Any]) -> None:
    """Write rows to a file."""
    import json

    import numpy as np

    from servoscope.output import atomic_write
    from servoscope.store.history import plain, spread
    from servoscope.writers import write_table

    if path.suffix.lower() == ".json":
        lines = [json.dumps(plain(row), allow_nan=False) for row in rows]
        atomic_write(path, ("[\n" + ",\n".join(lines) + "\n]\n").encode())
    else:
        write_table(path, {name: np.array(column, dtype=object) for name, column in spread(rows).items()})
