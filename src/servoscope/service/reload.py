"""A service file that is read again while the service runs: what it leaves as it was goes on untouched."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from servoscope.core.errors import ServoscopeError
from servoscope.service.assets.asset import Asset
from servoscope.service.build import (
    ServiceComponents,
    build_assets,
    build_publisher,
    build_source,
    check_actions,
    open_source,
    source_assets,
)
from servoscope.service.config import ServiceFile
from servoscope.service.log import log
from servoscope.service.notifications import Notifier
from servoscope.service.resumption import resume_assets
from servoscope.service.sources.inbox import Inbox

Changes = dict[str, list[str]]  # names: assets added, removed, changed and begun anew; sources and outlets opened


def reload_components(
    config: ServiceFile, before: ServiceFile, running: ServiceComponents, commit: Callable[[], None]
) -> tuple[ServiceComponents, Changes]:
    """Change from what runs by the file `before` to what `config` names.

    `commit` stores all that is in hand. Until all that may fail has succeeded, nothing is closed: after a
    ServoscopeError what runs can go on. An asset whose baseline has changed begins with a new state, behind the samples
    that were counted.
    """
    before.check_fixed(config)
    assets = build_assets(config)
    if not config.is_shard:  # the whole file was checked
        check_actions(config, assets)
    kept = [name for name in assets if name in running.assets]
    same = [name for name in kept if _identity(config, assets, name) == _identity(before, running.assets, name)]
    assets |= {name: running.assets[name] for name in same}  # their states and windows stay where they are
    sources = _keep_sources(config, assets, before, running)
    publishers = {
        name: running.publishers[name] if before.outlets.get(name) == outlet else build_publisher(config, name)
        for name, outlet in config.outlets.items()
    }
    commit()
    store, new = running.store, {name: asset for name, asset in assets.items() if asset is not running.assets.get(name)}
    try:
        store.acquire_lock([config.name, *assets])
        rows = store.checkpoints([config.name, *assets])
        store.take_over(config.name, new)
        assets, groups, anew, left_out = resume_assets(
            config, assets, store, rows, (), running.assets, running.groups.layers
        )
        if left_out:
            config, new = config.without(left_out), {name: new[name] for name in new if name in assets}
            sources = _keep_sources(config, assets, before, running)
        notifier = Notifier(config.name, config.alarms, config.actions)
        notifier.resume(running.notifier.checkpoint()["state"])
    except ServoscopeError:
        store.acquire_lock([config.name, *running.assets])
        raise
    changed = [name for name in new if name in running.assets]
    for name in changed:
        new[name].reception = running.assets[name].reception
    for source in running.sources.values():
        if source not in sources.values():
            source.close()
    for publisher in running.publishers.values():
        if publisher not in publishers.values():
            publisher.close()
    opened = [name for name, source in sources.items() if source is not running.sources.get(name)]
    for name in opened:
        open_source(config, name, sources[name], assets)
    outlets = [name for name, publisher in publishers.items() if publisher is not running.publishers.get(name)]
    for name in outlets:
        try:
            publishers[name].open({asset_name: row["status"] for asset_name, row in rows.items()})
        except ServoscopeError as error:  # an address in use, for example: no reason to follow nothing
            log("error", "outlet cannot be opened", outlet=name, why=str(error))
    changes = {
        "added": [name for name in new if name not in running.assets],
        "removed": [name for name in running.assets if name not in assets],
        "changed": changed,
        "anew": list(anew),
        "opened": [*opened, *outlets],
    }
    return ServiceComponents(assets, groups, notifier, sources, publishers, store, anew, left_out), changes


def _keep_sources(
    config: ServiceFile, assets: Mapping[str, Asset], before: ServiceFile, running: ServiceComponents
) -> dict[str, Inbox]:
    """Return the sources of a service file: those that run and are as they were, and new ones, not yet open."""
    return {
        name: running.sources[name]
        if name in running.sources
        and _source_identity(config, assets, name) == _source_identity(before, running.assets, name)
        else build_source(config, assets, name)
        for name in config.sources
    }


def _identity(config: ServiceFile, assets: Mapping[str, Asset], name: str) -> tuple[Any, ...]:
    """Return all on which it depends how an asset is followed."""
    settings, asset = config.assets[name], assets[name]
    return asset.policy, settings.group, settings.source, asset.machine.to_json()


def _source_identity(config: ServiceFile, assets: Mapping[str, Asset], name: str) -> tuple[Any, ...]:
    """Return all on which a source depends."""
    own = {
        asset_name: (asset.loop.hash(), *asset[1:]) for asset_name, asset in source_assets(config, assets, name).items()
    }
    return config.sources[name], own
