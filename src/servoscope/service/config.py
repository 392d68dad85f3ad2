"""The service file: assets, sources, store, alarms and actions of one `servoscope run`, read and checked at once."""

from __future__ import annotations

import zlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, PrivateAttr, model_validator

from servoscope.core.errors import ConfigError
from servoscope.core.settings import NonEmptyStr, NonNegative, Settings, drop_obsolete
from servoscope.service.access import WebSettings
from servoscope.service.actions import ActionSettings
from servoscope.service.alarms import AlarmSettings
from servoscope.service.assets.outlook import PrognosisSettings, SizeLimit
from servoscope.service.config_types import Address, FileSettings, Name, Seconds
from servoscope.service.kinds import PUBLISHERS, SOURCES, parse_tables
from servoscope.service.network import NetworkSettings, apply_network
from servoscope.service.opcua.settings import OpcuaNodes
from servoscope.service.publishers.base import PublisherSettings
from servoscope.service.sources.settings import SourceSettings
from servoscope.signals.quality import QualitySettings

Paths = Annotated[tuple[NonEmptyStr, ...], Field(min_length=1)]


class ServiceSettings(Settings):
    """How the service runs; every key has a default."""

    listen: Address = "127.0.0.1:9464"  # address of health and metrics, ``host:port``; empty: none
    # how long results are gathered before they are stored together [s]; 0: each block for itself
    commit_every_s: Annotated[NonNegative, Field(le=3600.0)] = 0.5
    # among how many processes the assets are shared out; which has an asset depends on its name and this number alone
    workers: Annotated[int, Field(strict=True, ge=1, le=256)] = 1
    # how many blocks may wait for a store that is full, locked or down; then the sources are stopped
    buffer: Annotated[int, Field(strict=True, ge=1)] = 10_000
    stop_within_s: NonNegative = 10.0  # how long a stop waits for such a store [s]
    # how far time stamps may be ahead of the service's clock; what is further ahead is left out [s]
    ahead_s: Seconds = 60.0
    log: Literal["debug", "info", "warning", "error"] = "info"  # what is logged, at least


class StoreSettings(Settings):
    """Where history goes, and for how long."""

    # A file for SQLite, relative to the service file, or ``postgresql://user@host/database``
    url: NonEmptyStr = "history.sqlite"
    residual_every_s: Seconds = 60.0  # time between two stored residuals of an asset [s]
    residual_days: Seconds = 400.0  # how long they are kept
    # how long diagnoses, alarms, audit, commands and deliveries are kept; None: for ever
    event_days: Seconds | None = None
    size_days: Seconds = 7300.0  # how long sizes and coefficients are kept, thinned to one a day

    @model_validator(mode="before")
    @classmethod
    def _drop_network(cls, data: Any) -> Any:
        remedy = "is no setting any more: url names the server, and with ?sslmode=verify-full it proves its identity"
        return drop_obsolete(data, {"network": f"[store] network: {remedy}"})


class DiagnosisSettings(Settings):
    """How the last minutes are examined; every key has a default."""

    window_s: Seconds = 120.0  # length of the window [s]
    every_s: Seconds = 600.0  # time between two examinations, where nothing happens [s]
    after_s: Seconds = 10.0  # from a new fault to the full diagnosis of the window around it [s]
    keep_s: NonNegative = 0.0  # how long samples are kept, from which a baseline is relearned, at least `window_s` [s]

    @property
    def kept_s(self) -> float:
        """How long samples are kept [s]."""
        return max(self.window_s, self.keep_s)


class AssetSettings(Settings):
    """One asset."""

    baseline: NonEmptyStr  # what `learn` wrote; relative to the service file
    point: NonEmptyStr | None = None  # operating point of it; needed where it has several
    source: NonEmptyStr  # name of the source that its samples come from
    files: Paths | None = None  # what a source of kind ``replay`` replays for it, one recording after the other
    nodes: OpcuaNodes | None = None  # where a source of kind ``opcua`` finds it
    group: Annotated[str, Field(strict=True, max_length=100)] = ""  # what it belongs to: a line, a hall
    limits: dict[NonEmptyStr, SizeLimit] | None = None  # instead of those of ``[prognosis]``


def shard_number(asset: str, workers: int) -> int:
    """Return which of so many workers follows an asset: the same on every machine, and at every start."""
    return zlib.crc32(asset.encode()) % workers


class ServiceFile(FileSettings):
    """A service file."""

    kind_of_file: ClassVar[str] = "service file"

    name: Name = "servoscope"  # what the service is called in alarms and messages
    # service, store, network, diagnosis, prognosis, quality, alarms, actions, web: the sections of these names; each
    # may be left out. Without ``[web]`` there are no pages.
    service: ServiceSettings = ServiceSettings()
    store: StoreSettings = StoreSettings()
    network: NetworkSettings = NetworkSettings()
    diagnosis: DiagnosisSettings = DiagnosisSettings()
    prognosis: PrognosisSettings = PrognosisSettings()
    quality: QualitySettings = QualitySettings()
    alarms: AlarmSettings = Field(default_factory=lambda: AlarmSettings.model_validate({}))
    actions: ActionSettings = ActionSettings()
    web: WebSettings | None = None
    _shard: int | None = PrivateAttr(default=None)
    # sources, outlets, assets: tables by name: ``[sources.NAME]``, ``[outlets.NAME]``, ``[assets.NAME]``
    sources: Annotated[dict[Name, SourceSettings], Field(min_length=1)]
    outlets: dict[Name, PublisherSettings] = Field(default_factory=dict)
    assets: Annotated[dict[Name, AssetSettings], Field(min_length=1)]

    @model_validator(mode="before")
    @classmethod
    def _parse_kinds(cls, data: Any) -> Any:
        """Parse the tables whose keys depend on their kind, which may be another package's."""
        if not isinstance(data, Mapping):
            return data
        data = dict(data)
        if "sources" in data:
            data["sources"] = parse_tables(data["sources"], SOURCES, SourceSettings, "sources")
        if "outlets" in data:
            data["outlets"] = parse_tables(data["outlets"], PUBLISHERS, PublisherSettings, "outlets")
        return data

    @model_validator(mode="after")
    def _apply_network(self) -> Self:
        """Hand the rules of ``[network]`` to everything that connects to somebody."""
        update = {
            "sources": apply_network(self.sources, self.network),
            "outlets": apply_network(self.outlets, self.network),
            "actions": self.actions.with_network(self.network),
        }
        for name, value in update.items():
            object.__setattr__(self, name, value)  # frozen for everybody else
        return self

    @property
    def is_shard(self) -> bool:
        """Whether it is one of the parts that `shard` returns."""
        return self._shard is not None

    def shard_name(self, number: int) -> str:
        """Return what the service of a shard is called."""
        return f"{self.name}.{number}"

    def shard_numbers(self) -> set[int]:
        """Return which shards have assets."""
        return {shard_number(name, self.service.workers) for name in self.assets}

    def shard(self, number: int | None) -> Self:
        """Return the service file of one of the workers: its assets, their sources, no pages; None: all of it."""
        if number is None:
            return self
        workers, name = self.service.workers, self.shard_name(number)
        assets = {key: asset for key, asset in self.assets.items() if shard_number(key, workers) == number}
        used = {asset.source for asset in assets.values()}
        listen = "127.0.0.1:0" if self.service.listen else ""  # whom it tells the port asks it there
        update = {
            "name": name,
            "assets": assets,
            "sources": {key: source for key, source in self.sources.items() if key in used},
            "service": self.service.model_copy(update={"listen": listen}),
            "actions": self.actions.with_service_name(self.name, name),
            "web": None,
        }
        shard = self.model_copy(update=update)
        shard._shard = number
        return shard

    def without(self, left_out: Collection[str]) -> Self:
        """Return the service file without some assets, and without the sources of these alone."""
        assets = {key: asset for key, asset in self.assets.items() if key not in left_out}
        lost = {self.assets[key].source for key in left_out if key in self.assets}
        lost -= {asset.source for asset in assets.values()}
        sources = {key: source for key, source in self.sources.items() if key not in lost}
        return self.model_copy(update={"assets": assets, "sources": sources})

    def load_again(self, path: Path) -> Self:
        """Read the service file once more, and return the same part of it."""
        return type(self).load(path).shard(self._shard)

    def check_fixed(self, new: ServiceFile) -> None:
        """Refuse a change of what a service cannot change while it runs."""

        def fixed(file: ServiceFile) -> dict[str, Any]:
            return {
                "name": file.name,
                "[service] listen": file.service.listen,
                "[service] workers": file.service.workers,
                "[store] url": file.store.url,
                "[web]": file.web,
            }

        for place, value in fixed(self).items():
            if fixed(new)[place] != value:
                raise ConfigError(f"{place}: cannot be changed while the service runs, start it again")

    def relearned_file(self, asset: str) -> Path:
        """Return where the baseline of an asset is written that was relearned from the store."""
        path = self.folder / self.assets[asset].baseline
        return path.with_name(f"{path.stem}.{asset}.json")

    def baseline_file(self, asset: str) -> Path:
        """Return the baseline of an asset that is in force: the relearned one, or else that of the service file."""
        own = self.relearned_file(asset)
        return own if own.exists() else self.folder / self.assets[asset].baseline

    def client_names(self) -> dict[tuple[str, str], str]:
        """Return by what names sources and outlets are known outside, by section and name."""
        sources = {("sources", name): f"{self.name}.{name}" for name in self.sources}
        # not as a source of the same name: brokers give a session to one client only
        return sources | {("outlets", name): f"{self.name}.{name}.outlet" for name in self.outlets}

    def _check_identities(self) -> None:
        """Refuse two clients of one name: a broker throws out one for the other, and messages are lost."""
        places: dict[str, str] = {}
        for (section, name), client in self.client_names().items():
            settings: SourceSettings | PublisherSettings = getattr(self, section)[name]
            place, identity = f"[{section}] {name}", settings.identity(client)
            if identity and identity in places:
                raise ValueError(f"{place}: {identity} is that of {places[identity]} too, give each one of its own")
            places[identity] = place

    def _check_sharing(self) -> None:
        """Refuse what several processes cannot have at the same time."""
        for section, name in self.client_names():
            settings: SourceSettings | PublisherSettings = getattr(self, section)[name]
            if getattr(settings, "client", None) is not None:
                raise ValueError(f"[{section}] {name}.client: leave it out, each of several workers needs its own")
            if isinstance(settings, PublisherSettings) and settings.listens:
                raise ValueError(f"[outlets] {name}: one process has its address, so that [service] workers must be 1")
            if isinstance(settings, SourceSettings) and settings.is_exclusive:
                raise ValueError(f"[sources] {name}: one process moves its files, so that [service] workers must be 1")

    @model_validator(mode="after")
    def _check_consistency(self) -> Self:
        for name, asset in self.assets.items():
            if asset.source not in self.sources:
                known = ", ".join(self.sources)
                raise ValueError(f"[assets] {name}.source: there is no source {asset.source!r}, only {known}")
            source = self.sources[asset.source]
            for key in ("files", "nodes"):
                given = getattr(asset, key) is not None
                if not given and key == source.asset_key:
                    raise ValueError(
                        f"[assets] {name}.{key}: missing, a source of kind {source.kind} needs {source.asset_example}"
                    )
                if given and key != source.asset_key:
                    raise ValueError(f"[assets] {name}.{key}: leave it out, its source is of kind {source.kind}")
        self._check_identities()
        if self.service.workers > 1:
            self._check_sharing()
        if self.name in self.assets:
            raise ValueError(f"name: {self.name!r} is an asset's name too, call the service something else")
        return self
