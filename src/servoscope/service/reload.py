"""A service file that is read again while the service runs: what it leaves as it was goes on untouched."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from servoscope.core.errors import ServoscopeError
from servoscope.service.assets.asset import Asset
from servoscope.service.assets.checkpoint import unpack_state
from servoscope.service.assets.groups import AssetGroups
from servoscope.service.build import (
    ServiceComponents,
    build_assets,
    build_publisher,
    build_source,
    check_actions,
    open_source,
    resume_assets,
    source_assets,
)
from servoscope.service.config import ServiceFile
from servoscope.service.log import log
from servoscope.service.notifications import Notifier


class Reload(NamedTuple):
    """What a service runs with from now on, and what has changed by it."""

    config: ServiceFile
    components: ServiceComponents
    changes: dict[str, list[str]]  # names: assets added, removed, changed and begun anew; sources and outlets opened


def reload_components(
    config: ServiceFile, before: ServiceFile, running: ServiceComponents, commit: Callable[[], None]
) -> Reload:
    """Change from what runs by the file `before` to what `config` names.

    `commit` stores all that is in hand. Until all that may fail has succeeded, nothing is closed: after a
    ServoscopeError what runs can go on. An asset whose baseline has changed begins with a new state, behind the samples
    that were counted.
    """
    before.check_fixed(config)
    assets = build_assets(config)
    if not config.is_shard:  # the whole file was checked
        check_actions(config, assets)
    for name, one in running.assets.items():
        if name in assets and _is_same(name, (before, one), (config, assets[name])):
            assets[name] = one
    sources = {
        name: running.sources[name]
        if name in running.sources
        and _source_identity(config, assets, name) == _source_identity(before, running.assets, name)
        else build_source(config, assets, name)
        for name in config.sources
    }
    publishers = {
        name: running.publishers[name] if before.outlets.get(name) == one else build_publisher(config, name)
        for name, one in config.outlets.items()
    }
    commit()
    store, new = running.store, {name: one for name, one in assets.items() if one is not running.assets.get(name)}
    try:
        store.acquire_lock([config.name, *assets])
        rows = store.checkpoints([config.name, *assets])
        resumed = {name: rows[name] for name in new if name in rows}
        anew = tuple(
            name
            for name, row in resumed.items()
            if unpack_state(row["state"], name).baseline != new[name].baseline.hash
        )
        groups = AssetGroups(assets, running.groups.layers)
        store.take_over(config.name, new)
        resume_assets(groups, new, store, resumed, anew)
        notifier = Notifier(config.name, config.alarms, config.actions)
        notifier.resume(running.notifier.checkpoint()["state"])
    except ServoscopeError:
        store.acquire_lock([config.name, *running.assets])
        raise
    for name, one in new.items():
        if name in running.assets:
            one.reception = running.assets[name].reception
    for source in running.sources.values():
        if source not in sources.values():
            source.close()
    for publisher in running.publishers.values():
        if publisher not in publishers.values():
            publisher.close()
    opened = [name for name, one in sources.items() if one is not running.sources.get(name)]
    for name in opened:
        open_source(config, name, sources[name], assets)
    outlets = [name for name, one in publishers.items() if one is not running.publishers.get(name)]
    for name in outlets:
        try:
            publishers[name].open({each: row["status"] for each, row in rows.items()})
        except ServoscopeError as error:  # an address in use, for example: no reason to follow nothing
            log("error", "outlet cannot be opened", outlet=name, why=str(error))
    changes = {
        "added": [name for name in new if name not in running.assets],
        "removed": [name for name in running.assets if name not in assets],
        "changed": [name for name in new if name in running.assets],
        "anew": list(anew),
        "opened": [*opened, *outlets],
    }
    components = ServiceComponents(assets, groups, notifier, sources, publishers, store, anew)
    return Reload(config, components, changes)


def _is_same(name: str, running: tuple[ServiceFile, Asset], new: tuple[ServiceFile, Asset]) -> bool:
    """Return whether an asset is followed as before, so that its state and its window can stay where they are."""

    def followed(config: ServiceFile, asset: Asset) -> tuple[Any, ...]:
        settings = config.assets[name]
        return asset.policy, settings.group, settings.source, asset.baseline.model_dump_json()

    return followed(*running) == followed(*new)


def _source_identity(config: ServiceFile, assets: Mapping[str, Asset], name: str) -> tuple[Any, ...]:
    """Return all on which a source depends."""
    own = {each: (one.loop.hash(), *one[1:]) for each, one in source_assets(config, assets, name).items()}
    return config.sources[name], own
