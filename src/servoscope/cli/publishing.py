"""The command that sends recordings to an MQTT broker."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Annotated

import typer

from servoscope.cli.app import app


@app.command()
def publish(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="What is sent, and where to (TOML).")],
) -> None:
    """Send recordings to an MQTT broker, as if measured now, until the service has all of them; logs on stderr."""
    from servoscope.live import logs
    from servoscope.live.mqtt.publishing import Publisher, PublishSettings

    logs.set_up("info")
    publisher = Publisher(PublishSettings.load(config))
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: publisher.stop())
    publisher.run()
