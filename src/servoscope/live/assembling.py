"""From a service file to what runs: assets that go on where they were, sources, store."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from servoscope.baseline import Baseline
from servoscope.errors import BaselineError, ConfigError
from servoscope.live.announcing import Announcer
from servoscope.live.asset import Asset, Following
from servoscope.live.block import Block, Resume
from servoscope.live.checking import check
from servoscope.live.checkpoint import Counted, unpack
from servoscope.live.config import Config
from servoscope.live.mqtt.outlet import MqttOutlet, MqttOutletSettings
from servoscope.live.mqtt.source import MqttSettings, MqttSource
from servoscope.live.opcua.outlet import OpcuaOutlet
from servoscope.live.opcua.settings import OpcuaSettings
from servoscope.live.opcua.source import OpcuaSource
from servoscope.live.outlet import Outlet
from servoscope.live.replay import Replay
from servoscope.live.source import Source
from servoscope.monitor import Monitor
from servoscope.store import Store

__all__ = ["Assembly", "assemble", "rehearse"]


@dataclass(frozen=True)
class Assembly:
    """What a service is made of; sources are open, and go on behind what was counted.

    `anew` are those that begin with a new state.
    """

    assets: dict[str, Asset]
    announcer: Announcer
    sources: dict[str, Source]
    outlets: dict[str, Outlet]
    store: Store
    anew: tuple[str, ...] = ()


def assemble(config: Config, anew: Collection[str] = ()) -> Assembly:
    """Open what a service file names.

    Parameters
    ----------
    config
        The service file.
    anew
        Assets that begin with a new state, behind the samples that were counted; the service's name for its own.

    Raises
    ------
    ServoscopeError
        If a baseline, a recording, the store or a saved state cannot be used; nothing is left open.
    """
    known = [*config.assets, config.name]
    if strange := set(anew) - set(known):
        raise ConfigError(f"--anew {min(strange)}: no such asset, choose from {', '.join(known)}")
    assets = _assets(config)
    check(config, assets)
    sources, outlets = _sources(config, assets), _outlets(config)
    store = Store.open(config.store.url, config.folder, write=True)
    try:
        store.claim([config.name, *assets])
        rows = store.checkpoints([config.name, *assets])
        announcer = Announcer(config.name, config.alarms, config.actions)
        if config.name in anew and config.name in rows:
            announcer.begin(rows[config.name]["sequence"])
        elif config.name in rows:
            announcer.resume(rows[config.name]["state"])
        for name, asset in assets.items():
            if name in anew and name in rows:
                asset.begin(Counted(**rows[name]["status"]["counted"]))
            elif name in rows:
                window = [Block.unpack(name, *one) for one in store.recent(name)]
                asset.resume(unpack(rows[name]["state"], name), window)
        for name, source in sources.items():
            own = [each for each, settings in config.assets.items() if settings.source == name]
            source.open({each: _resumption(assets[each]) for each in own if assets[each].progress is not None})
        for outlet in outlets.values():
            outlet.open({name: row["status"] for name, row in rows.items()})
    except BaseException:
        store.close()
        raise
    return Assembly(assets, announcer, sources, outlets, store, tuple(name for name in known if name in anew))


def rehearse(config: Config) -> None:
    """Read all that a service file names but the store.

    Raises
    ------
    ServoscopeError
        If something cannot be used.
    """
    assets = _assets(config)
    check(config, assets)
    _sources(config, assets)
    _outlets(config)


def _resumption(asset: Asset) -> Resume:
    assert asset.progress is not None, "the caller has looked"
    counted = asset.progress.counted
    return Resume(counted.sequence, counted.began, counted.stream, counted.t)


def _assets(config: Config) -> dict[str, Asset]:
    how = Following(config.diagnosis, config.quality, config.alarms, config.store.residual_every_s)
    files: dict[Path, Baseline] = {}
    shared: dict[tuple[Path, str | None], tuple[Baseline, Monitor]] = {}
    assets = {}
    for name, settings in config.assets.items():
        path, point = config.folder / settings.baseline, settings.point
        if path not in files:
            try:
                files[path] = Baseline.load(path)
            except BaselineError as error:
                raise ConfigError(f"[assets] {name}.baseline: {error}") from None
        if (path, point) not in shared:
            try:
                baseline = files[path] if point is None else files[path].at(point)
            except BaselineError as error:
                raise ConfigError(f"[assets] {name}.point: {path.name}: {error}") from None
            try:
                shared[path, point] = baseline, Monitor(baseline)
            except BaselineError:
                points = ", ".join(baseline.points)
                raise ConfigError(f"[assets] {name}.point: missing, {path.name} has {points}: choose one") from None
        assets[name] = Asset(name, *shared[path, point], how, settings.group)
    for asset in {id(one.baseline): one for one in assets.values()}.values():
        asset.warm()
    return assets


def _sources(config: Config, assets: dict[str, Asset]) -> dict[str, Source]:
    sources: dict[str, Source] = {}
    for name, settings in config.sources.items():
        own = {each: one for each, one in config.assets.items() if one.source == name}
        if isinstance(settings, MqttSettings):
            sources[name] = MqttSource(settings, frozenset(own), config.folder, f"{config.name}.{name}")
            continue
        if isinstance(settings, OpcuaSettings):
            nodes = {
                each: (one.nodes, assets[each].baseline.loop.sample_rate)
                for each, one in own.items()
                if one.nodes is not None
            }
            sources[name] = OpcuaSource(settings, nodes, config.folder)
            continue
        tapes = {
            each: (tuple(config.folder / file for file in one.files or ()), assets[each].baseline.loop)
            for each, one in own.items()
        }
        sources[name] = Replay(settings, tapes)
    return sources


def _outlets(config: Config) -> dict[str, Outlet]:
    return {
        name: MqttOutlet(settings, config.folder, f"{config.name}.{name}")
        if isinstance(settings, MqttOutletSettings)
        else OpcuaOutlet(settings, config.folder)
        for name, settings in config.outlets.items()
    }
