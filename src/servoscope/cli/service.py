"""The commands of the service: `run` keeps assets followed."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Annotated

import typer

from servoscope.cli.app import app

ConfigFile = Annotated[Path, typer.Argument(metavar="CONFIG", help="Service file (TOML).")]


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
        rehearse(settings)
        typer.echo(f"{config}: {len(settings.assets)} assets, {len(settings.sources)} sources; all can be used")
        return
    logs.set_up(settings.service.log)
    from servoscope.live.service import Service
    from servoscope.live.serving import serve

    service = Service(settings, assemble(settings, anew or ()))
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: service.stop())
    server = serve(service, settings.service.listen) if settings.service.listen else None
    try:
        service.run()
    finally:
        if server is not None:
            server.shutdown()
