"""From a service file to what runs: assets that continue where they were, sources, publishers, store."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from servoscope.core.errors import BaselineError, ConfigError, LoopError
from servoscope.core.settings_errors import suggest_name
from servoscope.design.operating_limits import LimitKind, OperatingLimit, operating_limits
from servoscope.diagnosis.monitor import Monitor
from servoscope.machines.kinds import load_machine
from servoscope.machines.protocol import Machine
from servoscope.service.actions import CommandSettings, EmailSettings, WebhookSettings
from servoscope.service.actions.settings import SINKS, Sink
from servoscope.service.assets.asset import Asset, AssetPolicy
from servoscope.service.assets.examination import compile_examination
from servoscope.service.assets.groups import AssetGroups
from servoscope.service.assets.outlook import AssetLimits
from servoscope.service.assets.records import TableRow
from servoscope.service.assets.window_asset import WindowAsset
from servoscope.service.config import ServiceFile
from servoscope.service.notifications import Notifier
from servoscope.service.publishers.base import StatusPublisher
from servoscope.service.resumption import resume_assets
from servoscope.service.sources.block import ResumePosition
from servoscope.service.sources.inbox import Inbox
from servoscope.service.sources.message import SourceAsset
from servoscope.service.store import Store
from servoscope.service.store.engine import parse_store_url


@dataclass(frozen=True)
class ServiceComponents:
    """The parts of a service; sources and publishers are open."""

    assets: dict[str, Asset]
    groups: AssetGroups
    notifier: Notifier
    sources: dict[str, Inbox]
    publishers: dict[str, StatusPublisher]
    store: Store
    # those that begin with a new state, and the rows that the one before owes
    restarted: Mapping[str, list[TableRow]] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)  # assets that cannot be followed, and why


def build_components(config: ServiceFile, restarted: Collection[str] = ()) -> ServiceComponents:
    """Open what a service file names.

    Assets in `restarted` begin with a new state, behind the samples that were counted; so does the service itself,
    under its name. An asset whose saved state cannot be used is left out. Raises ServoscopeError if a baseline, a
    recording, the store or the service's own state cannot be used; nothing is left open.
    """
    known = [*config.assets, config.name]
    check_restarted(restarted, known)
    assets = build_assets(config)
    if not config.is_shard:  # the whole file was checked
        check_actions(config, assets)
    sources, publishers = _build_sources(config, assets), _build_publishers(config)
    store = Store.open(config.store.url, config.folder, write=True, has_lock=config.is_shard)
    try:
        store.acquire_lock([config.name, *assets])
        rows = store.checkpoints([config.name, *assets])
        notifier = Notifier(config.name, config.alarms, config.actions)
        if config.name in restarted and config.name in rows:
            notifier.begin(rows[config.name]["sequence"])
        elif config.name in rows:
            notifier.resume(rows[config.name]["state"])
        store.take_over(config.name, assets)
        assets, groups, anew, left_out = resume_assets(config, assets, store, rows, restarted)
        if left_out:
            config = config.without(left_out)
            sources = _build_sources(config, assets)
        for name, source in sources.items():
            open_source(config, name, source, assets)
        for publisher in publishers.values():
            publisher.open({name: row["status"] for name, row in rows.items()})
    except BaseException:
        store.close()
        raise
    if config.name in restarted:
        anew[config.name] = []
    return ServiceComponents(assets, groups, notifier, sources, publishers, store, anew, left_out)


def check_restarted(names: Collection[str], known: Collection[str]) -> None:
    """Raise ConfigError unless all that is to begin with a new state is known."""
    if strange := set(names) - set(known):
        raise ConfigError(f"--anew {min(strange)}: no such asset, choose from {', '.join(known)}")


def build_visit(config: ServiceFile) -> tuple[dict[str, Asset], dict[str, Inbox]]:
    """Return the assets and sources of a service file, these as visitors: a service that runs loses nothing to them."""
    sources = {name: settings.for_visit() for name, settings in config.sources.items()}
    visit = config.model_copy(update={"name": f"{config.name}.check", "sources": sources})
    assets = build_assets(config)
    return assets, _build_sources(visit, assets)


def check_service_file(config: ServiceFile) -> list[str]:
    """Read all that a service file names but the store; return what sources would do, line by line.

    Raises ServoscopeError if something cannot be used.
    """
    assets = build_assets(config)
    check_actions(config, assets)
    sources = _build_sources(config, assets)
    _build_publishers(config)
    return [f"[sources] {name}: {line}" for name, source in sources.items() for line in source.transport.preview()]


def open_source(config: ServiceFile, name: str, source: Inbox, assets: Mapping[str, Asset]) -> None:
    """Open a source of a service that runs; beside a store in a file it may note what must survive the process."""
    url, client = parse_store_url(config.store.url, config.folder), config.client_names()["sources", name]
    prefix = f"{url.database}." if url.get_backend_name() == "sqlite" else ""  # else: in the folder where it runs
    source.state_file = Path(f"{prefix}{client}.in-hand")
    source.open(resume_positions(config, name, assets))


def resume_positions(config: ServiceFile, source: str, assets: Mapping[str, Asset]) -> dict[str, ResumePosition]:
    """Return where the assets of a source, by its name, go on."""
    own = {name: asset.state for name, asset in assets.items() if config.assets[name].source == source and asset.heard}
    counted = {name: state.position for name, state in own.items() if state is not None}
    return {name: ResumePosition(at.sequence, at.began, at.stream, at.t) for name, at in counted.items()}


def build_assets(config: ServiceFile) -> dict[str, Asset]:
    """Return the assets of a service file, without a state; raises ConfigError if a baseline cannot be used."""
    policy = AssetPolicy(
        config.diagnosis,
        config.quality,
        config.alarms,
        config.store.residual_every_s,
        config.prognosis,
        assets=len(config.assets),
    )
    files: dict[Path, Machine] = {}
    shared: dict[tuple[Path, str | None], tuple[Machine, Monitor | None]] = {}
    resolved: dict[object, AssetLimits] = {}
    assets = dict[str, Asset]()
    for name, settings in config.assets.items():
        path, point = config.baseline_file(name), settings.point
        if path not in files:
            try:
                files[path] = load_machine(path)
            except BaselineError as error:
                raise ConfigError(f"[assets] {name}.baseline: {error}") from None
        if (path, point) not in shared:
            shared[path, point] = _follow_point(files[path], point, name, path.name)
        machine, monitor = shared[path, point]
        _check_carried(config, name, machine)
        faults = machine.fault_words
        if settings.limits is None:
            limits = {fault: limit for fault, limit in config.prognosis.limits.items() if fault in faults}
        else:
            limits = settings.limits
            _check_names(f"[assets] {name}.limits", f"fault of {name}", limits, faults)
        asked = path, point, frozenset(limits.items())
        if asked not in resolved:  # many assets are of one loop
            resolved[asked] = _resolve_limits(machine, limits, name)
        policy = replace(policy, limits=resolved[asked], pause_s=config.sources[settings.source].pause_s)
        place = settings.group, settings.source
        if monitor is None:
            assets[name] = WindowAsset(name, machine, policy, *place)
        else:
            assets[name] = Asset(name, machine, monitor, policy, *place)
    known = [fault for asset in assets.values() for fault in asset.machine.fault_words]
    _check_names("[prognosis] limits", "fault", config.prognosis.limits, known)
    for asset in {id(asset.machine): asset for asset in assets.values()}.values():
        asset.compile_kernels()
    kinds = {
        monitor.lane_key or machine.kind: machine.loop_baseline
        for machine, monitor in shared.values()
        if monitor is not None
    }
    for baseline in filter(None, kinds.values()):
        compile_examination(baseline)  # one of each kind: its kernels are those of all others
    return assets


def _follow_point(learned: Machine, point: str | None, asset: str, file: str) -> tuple[Machine, Monitor | None]:
    """Return the machine at an operating point, and what follows it; raises ConfigError if it has no such point."""
    try:
        machine = learned if point is None else learned.at(point)
    except BaselineError as error:
        raise ConfigError(f"[assets] {asset}.point: {file}: {error}") from None
    try:
        return machine, machine.follower()
    except BaselineError as error:
        if points := ", ".join(machine.points):
            raise ConfigError(f"[assets] {asset}.point: missing, {file} has {points}: choose one") from None
        raise ConfigError(f"[assets] {asset}.baseline: {file}: {error}") from None


def _check_carried(config: ServiceFile, name: str, machine: Machine) -> None:
    """Raise ConfigError if an asset's source does not carry what its baseline depends on."""
    asset = config.assets[name]
    source, key = config.sources[asset.source], config.sources[asset.source].asset_key
    apart = asset.nodes is not None and asset.nodes.block is None
    apart |= (payload := getattr(source, "payload", None)) is not None and payload.has_signal_names
    if apart and machine.needs_channels_alone:
        raise ConfigError(
            f"[assets] {name}: needs all signals of its machine in one message, which source {asset.source} lacks"
        )
    address = getattr(asset, key) if key else None
    lacking = [channel for channel in machine.channels if not source.carries(channel, address)]
    if lacking:
        where = (
            f"[assets.{name}] nodes.covariates"
            if key == "nodes"
            else f"[sources.{asset.source}.payload] fields.covariates"
        )
        raise ConfigError(
            f"[assets] {name}.baseline: {Path(asset.baseline).name} depends on {', '.join(lacking)}, which source "
            f"{asset.source} does not carry: name it under {where}, or learn operating points for it"
        )


def _resolve_limits(machine: Machine, limits: Mapping[str, float | LimitKind], asset: str) -> AssetLimits:
    """Return limits with what a loop loses in place of its name; raises ConfigError where no size takes that."""
    resolved: dict[str, float | OperatingLimit] = {}
    for fault, limit in limits.items():
        if not isinstance(limit, str):
            resolved[fault] = limit
            continue
        if (baseline := machine.loop_baseline) is None:
            raise ConfigError(f'limits of {asset}: {fault} = "{limit}": known of loops alone, give a number')
        try:
            operating_limit = next(
                operating_limit
                for operating_limit in operating_limits(baseline.loop, [fault])
                if operating_limit.kind == limit
            )
        except LoopError as error:
            raise ConfigError(f'limits of {asset}: {fault} = "{limit}": {error}') from None
        if operating_limit.up is None and operating_limit.down is None:
            raise ConfigError(
                f'limits of {asset}: {fault} = "{limit}": no size of {fault} takes that from this loop, give a number'
            )
        resolved[fault] = operating_limit
    return resolved


def source_assets(config: ServiceFile, assets: Mapping[str, Asset], source: str) -> dict[str, SourceAsset]:
    """Return what a source is told of its assets."""
    key = config.sources[source].asset_key
    own = {name: assets[name].machine for name, asset in config.assets.items() if asset.source == source}
    return {
        name: SourceAsset(
            machine.carrier,
            getattr(config.assets[name], key) if key else None,
            config.service.ahead_s,
            machine.channels,
            alone=machine.needs_channels_alone,
        )
        for name, machine in own.items()
    }


def build_source(config: ServiceFile, assets: Mapping[str, Asset], name: str) -> Inbox:
    """Return a source, not yet open; raises ServoscopeError if something that it names cannot be used."""
    client = config.client_names()["sources", name]
    return config.sources[name].create(client, source_assets(config, assets, name), config.folder)


def _build_sources(config: ServiceFile, assets: Mapping[str, Asset]) -> dict[str, Inbox]:
    return {name: build_source(config, assets, name) for name in config.sources}


def build_publisher(config: ServiceFile, name: str) -> StatusPublisher:
    """Return an outlet, not yet open; raises ServoscopeError if something that it names cannot be used."""
    return config.outlets[name].create(config.client_names()["outlets", name], config.folder)


def _build_publishers(config: ServiceFile) -> dict[str, StatusPublisher]:
    return {name: build_publisher(config, name) for name in config.outlets}


def check_actions(config: ServiceFile, assets: Mapping[str, Asset]) -> None:
    """Check what actions name: assets, alarms, faults, programs and secrets.

    Raises ConfigError if one of them does not exist: alarms would not be sent, which would go unnoticed.
    """
    for kind in SINKS:
        for name, sink in getattr(config.actions, kind).items():
            where = f"[actions] {kind}.{name}"
            _check_names(f"{where}.assets", "asset", sink.assets or (), [*assets, config.name])
            _check_names(f"{where}.alarms", "alarm", sink.alarms or (), config.alarms.definitions)
            _check_sink(where, sink, config.folder)
    for name, fault_tolerance_settings in config.actions.tolerance.items():
        where = f"[actions] tolerance.{name}"
        _check_names(f"{where}.assets", "asset", fault_tolerance_settings.assets, assets)
        for asset in fault_tolerance_settings.assets:
            machine = assets[asset].machine
            learned = machine.loop_baseline.learned if machine.loop_baseline is not None else ()
            faults = [*machine.fault_words, *(fault.name for fault in learned)]
            _check_names(f"{where}.fault", f"fault of {asset}", [fault_tolerance_settings.fault], faults)


def _check_sink(where: str, sink: Sink, folder: Path) -> None:
    if isinstance(sink, WebhookSettings | EmailSettings):
        try:
            sink.load_secret(folder)
        except ConfigError as error:
            key = "secret_env" if sink.secret_env is not None else "secret_file"
            raise ConfigError(f"{where}.{key}: {error}") from None
        if sink.has_certificates:
            sink.create_tls_context(folder, where)
    elif isinstance(sink, CommandSettings) and shutil.which(program := sink.program(folder)) is None:
        raise ConfigError(f"{where}.argv: there is no program {program} that can be run, give its path")


def _check_names(where: str, kind: str, names: Collection[str], known: Collection[str]) -> None:
    for name in names:
        if name not in known:
            raise ConfigError(f"{where}: there is no {kind} {name!r}, {suggest_name(name, known)}")
