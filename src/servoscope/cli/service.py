"""The commands of the service: run it, watch it, print its history, back up its store, replay recordings to it."""

from __future__ import annotations

import os
import signal
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from servoscope.cli.app import app
from servoscope.cli.arguments import parse_time
from servoscope.cli.exit import EXIT_INTERRUPTED, print_json
from servoscope.cli.options import JsonOption
from servoscope.cli.output_paths import check_output
from servoscope.core.errors import ConfigError, ObsoleteSettingWarning, StoreError
from servoscope.core.messages import count_words, say
from servoscope.core.settings_errors import suggest_name

if TYPE_CHECKING:
    from rich.console import Group

    from servoscope.service.config import ServiceFile
    from servoscope.service.store import Store


ConfigArgument = Annotated[Path, typer.Argument(metavar="CONFIG", help="Service file (TOML).")]
StoreArgument = Annotated[
    str, typer.Argument(metavar="STORE", help="Service file, SQLite file, or URL of a PostgreSQL database.")
]
AssetOption = Annotated[list[str] | None, typer.Option(metavar="NAME", help="Only this asset; repeatable.")]

EXPORTS = (".csv", ".parquet", ".pq", ".json")
DEFAULT_ROWS = 50
HistoryKind = Literal["diagnoses", "alarms", "audit", "residuals", "deliveries"]
COLUMNS: dict[HistoryKind, tuple[str, ...]] = {
    "diagnoses": ("t", "asset", "grounds", "summary"),
    "alarms": ("t", "asset", "alarm", "after", "who", "cause"),
    "audit": ("at", "who", "asset", "what", "document"),
    "residuals": ("t", "asset", "statistic", "level"),
    "deliveries": ("created", "sink", "subject", "attempts", "due", "outcome"),
}


@app.command()
def run(
    config: ConfigArgument,
    anew: Annotated[
        list[str] | None,
        typer.Option(metavar="ASSET", help="Begin with a new state behind the samples that were counted; repeatable."),
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="Read the service file and what it names, and stop.")] = False,
    online: Annotated[
        bool, typer.Option("--online", help="With --check: connect to all sources, and tell how each asset is heard.")
    ] = False,
    listen_s: Annotated[
        float, typer.Option("--for", metavar="S", min=0.1, help="With --online: listen for so long at most, in s.")
    ] = 10.0,
    worker: Annotated[int | None, typer.Option("--worker", hidden=True)] = None,
) -> None:
    """Follow assets until stopped: what their sources say goes to the store, alarms go out; logs on stderr.

    SIGHUP reads the service file again: what has not changed in it goes on without losing a block.
    """
    # nothing has begun yet that would have to be ended; an exception may be lost in the middle of an import
    signal.signal(signal.SIGTERM, lambda *_: os._exit(0))
    signal.signal(signal.SIGINT, lambda *_: os._exit(EXIT_INTERRUPTED))
    from servoscope.service import log
    from servoscope.service.build import build_components, check_service_file
    from servoscope.service.config import ServiceFile

    with warnings.catch_warnings():
        if check:
            warnings.simplefilter("error", ObsoleteSettingWarning)
        try:
            settings = ServiceFile.load(config)
        except ObsoleteSettingWarning as obsolete:
            raise ConfigError(f"{config}: {obsolete}") from None
    if online and not check:
        raise ConfigError("--online: give it together with --check, which follows nothing")
    if check:
        with prefix_file_name(config):
            lines = check_service_file(settings)
        counts = {"asset": len(settings.assets), "source": len(settings.sources)}
        counted = ", ".join(count_words(count, noun) for noun, count in counts.items())
        typer.echo(say("cli.usable_file", path=str(config), counted=counted))
        for line in lines:
            typer.echo(line)
        if online:
            commission(settings, listen_s)
        return
    log.set_up_logging(settings.service.log)
    from servoscope.service.health import serve_health
    from servoscope.service.process_supervisor import ProcessSupervisor, call_at_end_of_stdin
    from servoscope.service.service import Service
    from servoscope.service.workers import WorkerPool

    service: Service | WorkerPool
    settings = settings.shard(worker)
    with prefix_file_name(config):
        if settings.service.workers > 1 and worker is None:
            service = WorkerPool(settings, config, anew or ())
        else:
            service = Service(settings, build_components(settings, anew or ()))
        server = serve_health(service.health_report(), settings.service.listen) if settings.service.listen else None
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: service.stop())
    if worker is not None:
        call_at_end_of_stdin(service.stop)
    if worker is not None or not sys.stderr.isatty():  # a terminal that is closed ends what runs in it
        signal.signal(signal.SIGHUP, lambda *_: service.reload(config))
    pages = None
    if settings.web is not None:  # in a process of their own, so that they hold up no samples
        check_web_extra()
        pages = ProcessSupervisor("pages", lambda: ["serve", str(config), "--with-parent"])
    try:
        if pages is not None:
            pages.start()
        # its parent then knows where it answers, and that a signal does not end it
        address = "-" if server is None else f"127.0.0.1:{server.server_address[1]}"
        service.run(lambda: typer.echo(address) if worker is not None else None)
    finally:
        if pages is not None:
            pages.stop()
        if server is not None:
            server.shutdown()


@app.command()
def watch(
    store: StoreArgument,
    asset: AssetOption = None,
    every: Annotated[float, typer.Option(metavar="S", min=0.1, help="Time between two looks, in s.")] = 1.0,
    once: Annotated[bool, typer.Option("--once", help="Look once and stop.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Show assets as they are now: verdict, since when, residuals, alarms; read from the store."""
    from servoscope.cli.render import history, results

    opened, out = open_store(store, asset or ()), results.create_console()

    def page() -> Group:
        try:
            return history.status_page(opened.statuses(asset), out.width)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise StoreError(f"{store}: holds a damaged status ({error!r}), restore a backup of the store") from None

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
    store: StoreArgument,
    kind: Annotated[HistoryKind, typer.Option(help="What to tell.")] = "diagnoses",
    asset: AssetOption = None,
    since: Annotated[
        str | None, typer.Option("--from", metavar="TIME", help="From this time on: 2026-01-31T12:00 (UTC), or 8h ago.")
    ] = None,
    until: Annotated[str | None, typer.Option("--to", metavar="TIME", help="Before this time.")] = None,
    last: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help=f"Only the newest N; on a terminal {DEFAULT_ROWS} by default."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="FILE", help="Write to FILE.csv, FILE.parquet or FILE.json."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Tell what happened, in the order of time, or export it."""
    check_output(output, "-o", EXPORTS, [])
    span = parse_time(since, "--from"), parse_time(until, "--to")

    from servoscope.cli.render import history, results
    from servoscope.service.store.queries import query_history, with_time_text

    shown = last if last is not None or as_json or output is not None else DEFAULT_ROWS
    opened = open_store(store, asset or ())
    rows = query_history(opened, kind, assets=asset or (), span=span, last=shown)
    if output is not None:
        export_rows(output, rows)
        results.print_written_path(results.create_console(stderr=True), output)
    elif as_json:
        for row in rows:
            print_json(with_time_text(row), lines=True)
    else:
        results.create_console().print(history.row_table(rows, COLUMNS[kind]))


def commission(settings: ServiceFile, seconds: float) -> None:
    """Print how each asset is heard; exit with 1 if one is not as its loop needs it."""
    from servoscope.cli.render import history, results
    from servoscope.service.commissioning import listen

    rows = listen(settings, seconds)
    results.create_console().print(history.commissioning_table(rows))
    if any(row.reception.state != "followed" for row in rows):
        raise typer.Exit(1)


@contextmanager
def prefix_file_name(config: Path) -> Iterator[None]:
    """Put the name of the service file before an error in it."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{config}: {error}") from None


def check_web_extra() -> None:
    """Raise ConfigError if something is missing of what the pages need."""
    for module in ("fastapi", "uvicorn", "argon2"):
        if find_spec(module) is None:
            raise ConfigError(f"[web]: {module} is missing, pip install 'servoscope[web]'")


def parse_store_address(text: str) -> tuple[str, Path | None]:
    """Return where a store is, and the folder that this is relative to: by a service file or by itself."""
    if not text.endswith(".toml"):
        return text, None
    from servoscope.service.config import ServiceFile

    config = ServiceFile.load(text)
    return config.store.url, config.folder


def open_store(text: str, assets: Sequence[str] = ()) -> Store:
    """Open a store for reading, by a service file or by itself; a locked one is waited for.

    Raises StoreError if it lacks one of the assets: an empty answer would look as if all were well.
    """
    from servoscope.service.store import Store

    store = Store.open(*parse_store_address(text), lock_timeout_s=5.0)
    known = store.statuses() if assets else {}
    for name in assets:
        if name not in known:
            raise StoreError(f"{name}: no such asset in {store.name}, {suggest_name(name, known)}")
    return store


def export_rows(path: Path, rows: list[Any]) -> None:
    """Write rows to a file."""
    import json

    import numpy as np

    from servoscope.core.files import atomic_write
    from servoscope.service.store.queries import rows_to_columns, with_time_text
    from servoscope.signals.writers import write_table

    if path.suffix.lower() == ".json":
        lines = [json.dumps(with_time_text(row), allow_nan=False) for row in rows]
        atomic_write(path, ("[\n" + ",\n".join(lines) + "\n]\n").encode())
    else:
        write_table(path, {name: np.array(column, dtype=object) for name, column in rows_to_columns(rows).items()})


@app.command()
def publish(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="What is sent, and where to (TOML).")],
) -> None:
    """Send recordings to an MQTT broker, as if measured now, until the service has all of them; logs on stderr."""
    from servoscope.service import log
    from servoscope.service.mqtt.replay_client import ReplayClient, ReplayClientSettings

    log.set_up_logging("info")
    publisher = ReplayClient(ReplayClientSettings.load(config))
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: publisher.stop())
    publisher.run()


store_app = typer.Typer(no_args_is_help=True, help="Back up a history, and restore it.")
app.add_typer(store_app, name="store")


@store_app.command()
def backup(
    store: StoreArgument,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="File to write; it must not exist yet.")],
) -> None:
    """Write all that a store holds at this moment into a file, which is a store itself; services may go on."""
    from servoscope.service.store.copy import copy_store

    with closing(open_store(store)) as opened:
        _print_counts(file, copy_store(opened, str(file.absolute())))


@store_app.command()
def restore(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="What backup has written.")], store: StoreArgument
) -> None:
    """Bring a backup into a store that has no history yet: a new SQLite file, or an empty PostgreSQL database."""
    from servoscope.service.store.copy import copy_store
    from servoscope.service.store.engine import display_url, parse_store_url

    url, folder = parse_store_address(store)
    with closing(open_store(str(file))) as opened:
        counts = copy_store(opened, url, folder)
    _print_counts(display_url(parse_store_url(url, folder or Path())), counts)


def _print_counts(where: str | Path, counts: dict[str, int]) -> None:
    rows, states = sum(counts.values()), counts.get("checkpoints", 0)
    typer.echo(f"{where}: {count_words(rows, 'row', 'en')}, {count_words(states, 'saved_state', 'en')}")
