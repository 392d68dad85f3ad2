"""What actions name must be there: refused at the start, not at the first alarm."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Mapping

from servoscope.actions import ActionSettings, CommandSettings, MessageSettings, WebhookSettings, secret_of
from servoscope.complaints import instead
from servoscope.errors import ConfigError
from servoscope.live.asset import Asset
from servoscope.live.config import Config

__all__ = ["check"]

KINDS = {WebhookSettings: "webhook", CommandSettings: "command", MessageSettings: "mqtt"}


def check(config: Config, assets: Mapping[str, Asset]) -> None:
    """Check what actions name: assets, alarms, faults, programs and secrets.

    Raises
    ------
    ConfigError
        If something of it is not there: then nobody would be told of an alarm, and nobody would notice.
    """
    settings = config.actions.beside(config.folder)
    for name, sink in settings.sinks.items():
        where = f"[actions] {KINDS[type(sink)]}.{name}"
        _known(f"{where}.assets", "asset", sink.assets or (), [*assets, config.name])
        _known(f"{where}.alarms", "alarm", sink.alarms or (), config.alarms.definitions)
        _usable(where, sink)
    _check_tolerance(settings, assets)


def _check_tolerance(settings: ActionSettings, assets: Mapping[str, Asset]) -> None:
    for name, one in settings.tolerance.items():
        where = f"[actions] tolerance.{name}"
        _known(f"{where}.assets", "asset", one.assets, assets)
        for asset in one.assets:
            baseline = assets[asset].baseline
            faults = [fault.name for fault in baseline.loop.plant.faults] + [fault.name for fault in baseline.learned]
            _known(f"{where}.fault", f"fault of {asset}", [one.fault], faults)


def _usable(where: str, sink: WebhookSettings | CommandSettings | MessageSettings) -> None:
    if isinstance(sink, WebhookSettings):
        try:
            secret_of(sink)
        except ValueError as error:
            key = "secret_env" if sink.secret_env is not None else "secret_file"
            raise ConfigError(f"{where}.{key}: {error}") from None
    elif isinstance(sink, CommandSettings) and shutil.which(sink.argv[0]) is None:
        raise ConfigError(f"{where}.argv: there is no program {sink.argv[0]} that can be run, give its path")


def _known(where: str, kind: str, names: Collection[str], known: Collection[str]) -> None:
    for name in names:
        if name not in known:
            raise ConfigError(f"{where}: there is no {kind} {name!r}, {instead(name, known)}")
