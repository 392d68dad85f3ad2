"""The command that puts a machine into a service file."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Annotated

import typer

from servoscope.cli.app import app
from servoscope.cli.service import prefix_file_name
from servoscope.core.messages import say

REPLAY = '[sources.recordings]\nkind = "replay"\nspeed = 0.0  # as fast as possible\n'


@app.command()
def add(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="Service file (TOML); made where there is none.")],
    asset: Annotated[str, typer.Argument(metavar="ASSET", help="What the machine is called.")],
    baseline: Annotated[Path, typer.Argument(metavar="BASELINE", help="What `learn` wrote for it.")],
    source: Annotated[
        str | None, typer.Option(metavar="NAME", help="Source in CONFIG that its samples come from.")
    ] = None,
    file: Annotated[
        list[Path] | None, typer.Option(metavar="LOG", help="Log to replay, without --source; repeatable.")
    ] = None,
    point: Annotated[str | None, typer.Option(metavar="NAME", help="Operating point of the baseline.")] = None,
    group: Annotated[str | None, typer.Option(metavar="NAME", help="Line or hall that it belongs to.")] = None,
) -> None:
    """Write a machine into a service file, behind what is there, and check all that the file names."""
    from servoscope.core.errors import ConfigError
    from servoscope.core.files import atomic_write
    from servoscope.core.settings import parse_toml, read_toml_text
    from servoscope.service.build import check_service_file
    from servoscope.service.config import ServiceFile

    if (source is None) == (file is None):
        raise typer.BadParameter("give --source, or --file for each log, and not both")
    text = read_toml_text(config, ServiceFile.kind_of_file, ConfigError) if config.exists() else ""
    there = parse_toml(text, config, ConfigError)
    if asset in there.get("assets", {}):
        raise ConfigError(f"{config}: has an asset {asset!r} already, give this one another name")
    sources = there.get("sources", {})
    if source is not None and source not in sources:
        known = f"there are {', '.join(sources)}" if sources else "it has none"
        raise ConfigError(
            f"{config}: no source {source!r}, {known}: write its table [sources.{source}], or give --file"
        )
    if file and "recordings" not in sources:
        text += f"\n{REPLAY}"
    values = {
        "baseline": _relative(baseline, config),
        "source": source or "recordings",
        "files": [_relative(log, config) for log in file or ()],
        "point": point,
        "group": group,
    }
    rows = [f"{key} = {json.dumps(value, ensure_ascii=False)}\n" for key, value in values.items() if value]
    key = asset if re.fullmatch(r"[\w-]+", asset, re.ASCII) else json.dumps(asset)
    text = "".join([text.rstrip("\n"), "\n\n" if text else "", f"[assets.{key}]\n", *rows]).lstrip("\n")
    settings = ServiceFile.parse(text, config)
    with prefix_file_name(config):
        check_service_file(settings)
    atomic_write(config, text.encode())
    typer.echo(say("add.next", config=str(config), asset=asset))


def _relative(path: Path, config: Path) -> str:
    """Return a path as a service file names it: seen from its folder."""
    return Path(os.path.relpath(path, config.absolute().parent)).as_posix()
