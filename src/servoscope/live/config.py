"""The service file: assets, sources, store, alarms and actions of one `servoscope run`, read and checked at once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, PrivateAttr, ValidationError, model_validator

from servoscope.access import WebSettings
from servoscope.actions import ActionSettings
from servoscope.alarms import AlarmSettings
from servoscope.complaints import describe
from servoscope.errors import ConfigError
from servoscope.live.mqtt.outlet import MqttOutletSettings
from servoscope.live.mqtt.source import MqttSettings
from servoscope.live.opcua.outlet import OpcuaOutletSettings
from servoscope.live.opcua.settings import Nodes, OpcuaSettings
from servoscope.live.replay import ReplaySettings
from servoscope.live.settings import Address, Name, Seconds
from servoscope.quality import QualitySettings
from servoscope.settings import NotNegative, Settings, Word, parsed, text_of

__all__ = ["AssetSettings", "Config", "DiagnosisSettings", "ServiceSettings", "StoreSettings"]

Paths = Annotated[tuple[Word, ...], Field(min_length=1)]
Outlet = Annotated[MqttOutletSettings | OpcuaOutletSettings, Field(discriminator="kind")]
Source = Annotated[ReplaySettings | MqttSettings | OpcuaSettings, Field(discriminator="kind")]


class ServiceSettings(Settings):
    """How the service runs; every key has a default.

    Parameters
    ----------
    listen
        Address of health and metrics, ``host:port``; empty: none.
    commit_every_s
        How long results wait for company before they are stored together [s]; 0: each block for itself.
    buffer
        How many blocks may wait for a store that is full, locked or down; then the sources are stopped.
    stop_within_s
        How long a stop waits for such a store [s].
    log
        What is logged, at least.
    """

    listen: Address = "127.0.0.1:9464"
    commit_every_s: Annotated[NotNegative, Field(le=3600.0)] = 0.5
    buffer: Annotated[int, Field(strict=True, ge=1)] = 10_000
    stop_within_s: NotNegative = 10.0
    log: Literal["debug", "info", "warning", "error"] = "info"


class StoreSettings(Settings):
    """Where history goes, and for how long.

    Parameters
    ----------
    url
        A file for SQLite, relative to the service file, or ``postgresql://user@host/database``.
    residual_every_s
        Time between two stored residuals of an asset [s].
    residual_days
        How long they are kept; diagnoses, alarms and audit are kept for ever.
    """

    url: Word = "history.sqlite"
    residual_every_s: Seconds = 60.0
    residual_days: Seconds = 400.0


class DiagnosisSettings(Settings):
    """How the last minutes are looked at; every key has a default.

    Parameters
    ----------
    window_s
        Length of the window [s].
    every_s
        Time between two examinations, where nothing happens [s].
    after_s
        From a new fault to the full diagnosis of the window around it [s].
    """

    window_s: Seconds = 120.0
    every_s: Seconds = 600.0
    after_s: Seconds = 10.0


class AssetSettings(Settings):
    """One asset.

    Parameters
    ----------
    baseline
        What `learn` wrote; relative to the service file.
    point
        Operating point of it; needed where it has several.
    source
        Name of the source that its samples come from.
    files
        What a source of kind ``replay`` replays for it, one recording after the other.
    nodes
        Where a source of kind ``opcua`` finds it.
    group
        What people know it to belong to: a line, a hall.
    """

    baseline: Word
    point: Word | None = None
    source: Word
    files: Paths | None = None
    nodes: Nodes | None = None
    group: Annotated[str, Field(strict=True, max_length=100)] = ""


class Config(Settings):
    """A service file.

    Parameters
    ----------
    name
        What the service is called in alarms and messages.
    service, store, diagnosis, quality, alarms, actions, web
        The sections of these names; each may be left out. Without ``[web]`` there are no pages.
    sources, outlets, assets
        Tables by name: ``[sources.NAME]``, ``[outlets.NAME]``, ``[assets.NAME]``.
    """

    name: Name = "servoscope"
    service: ServiceSettings = ServiceSettings()
    store: StoreSettings = StoreSettings()
    diagnosis: DiagnosisSettings = DiagnosisSettings()
    quality: QualitySettings = QualitySettings()
    alarms: AlarmSettings = Field(default_factory=lambda: AlarmSettings.model_validate({}))
    actions: ActionSettings = ActionSettings()
    web: WebSettings | None = None
    sources: Annotated[dict[Name, Source], Field(min_length=1)]
    outlets: dict[Name, Outlet] = Field(default_factory=dict)
    assets: Annotated[dict[Name, AssetSettings], Field(min_length=1)]
    _folder: Path = PrivateAttr(default=Path())

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for name, asset in self.assets.items():
            if asset.source not in self.sources:
                known = ", ".join(self.sources)
                raise ValueError(f"[assets] {name}.source: there is no source {asset.source!r}, only {known}")
            kind = self.sources[asset.source].kind
            for key, given, of, words in (
                ("files", asset.files, "replay", "recordings: files = [...]"),
                ("nodes", asset.nodes, "opcua", "nodes: nodes = { r = ..., u = ..., y = ... }"),
            ):
                if given is None and kind == of:
                    raise ValueError(f"[assets] {name}.{key}: missing, a source of kind {of} needs {words}")
                if given is not None and kind != of:
                    raise ValueError(f"[assets] {name}.{key}: leave it out, its source is of kind {kind}")
        if self.name in self.assets:
            raise ValueError(f"name: {self.name!r} is an asset's name too, call the service something else")
        return self

    @classmethod
    def load(cls, path: str | Path) -> Config:
        """Read a service file.

        Raises
        ------
        ConfigError
            If the file cannot be read, is not TOML, or a key in it is wrong.
        """
        path = Path(path)
        mapping = parsed(text_of(path, "service file", ConfigError), path, ConfigError)
        try:
            found = cls.model_validate(mapping)
        except ValidationError as error:
            raise ConfigError(f"{path}: {describe(error, cls)}") from None
        found._folder = path.absolute().parent
        return found

    @property
    def folder(self) -> Path:
        """What its paths are relative to."""
        return self._folder
