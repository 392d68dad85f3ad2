"""The parts of a service that runs, which its loop, its housekeeping and its metrics share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from servoscope.service.actions.dispatcher import OutboxDispatcher
from servoscope.service.alarms import AlarmSource
from servoscope.service.assets.asset import Asset
from servoscope.service.assets.reception import ReceptionClock, ReceptionLog
from servoscope.service.assets.records import StepResult
from servoscope.service.build import ServiceComponents
from servoscope.service.clock import SteadyClock
from servoscope.service.config import ServiceFile
from servoscope.service.log import log
from servoscope.service.publishers.base import AlarmCommand
from servoscope.service.writer import StoreWriter


class ServiceParts:
    """What a service file names, which a reload may change, and what the service has beside it.

    `monotonic`: returns the time by which turns and silences are measured [s].
    """

    def __init__(self, config: ServiceFile, components: ServiceComponents, monotonic: Callable[[], float]) -> None:
        self._take_components(config, components)
        self.writer = StoreWriter(self.store, config.name, config.service.buffer)
        self.clock = SteadyClock(monotonic)
        self.dispatcher = OutboxDispatcher(self.store, config.name, config.actions, self.clock, config.folder)
        self._listening = ReceptionClock(monotonic())
        self._receptions = {name: ReceptionLog(heard_before=asset.heard) for name, asset in self.assets.items()}
        self._reload_from: Path | None = None
        self.layers, self.last_turn = components.groups.layers, monotonic()  # a service that hangs is not alive

    def _take_components(self, config: ServiceFile, components: ServiceComponents) -> None:
        self.config, self._components = config.without(components.left_out), components
        self.sources, self.store, self._publishers = components.sources, components.store, components.publishers
        self.assets, self.notifier, self._groups = components.assets, components.notifier, components.groups
        # those of which a full diagnosis may be pending, in order
        self._awaiting = {name: None for name, asset in self.assets.items() if asset.pending_diagnoses}

    def reload(self, path: Path) -> None:
        """Change to what the service file says now, soon; for a signal's handler or another thread."""
        self._reload_from = path

    def note_refusal(self, name: str, why: str) -> None:
        """Note that something of an asset came and could not be used."""
        self._receptions[name].refuse(self._listening.seconds, why)

    def handle_result(self, asset: Asset, result: StepResult) -> None:
        """Store and announce what a step of an asset has led to."""
        self.writer.add(asset.name, result.rows)
        if not result.transitions or asset.state is None:
            return
        now, examination = self.clock.now(), asset.state.examination
        for transition in result.transitions:
            words = {name: str(getattr(transition, name)) for name in ("asset", "alarm", "before", "after")}
            log("info", "alarm", **words, cause=transition.cause, who=transition.who, t=transition.time)
            if transition.alarm == "fault" and transition.event == "clear":
                rows = self.notifier.accommodate_fault(asset.name, None, transition.time, now)
                self.writer.add(self.config.name, rows)
        details = {"diagnosis": examination.summary, "onset": examination.onset}
        self.writer.add(self.config.name, self.notifier.notify(result.transitions, details, now))

    def store_requests(self) -> None:
        """Store what operators have commanded at the systems that show alarms; it is executed like other commands."""
        for publisher in self._publishers.values():
            for request in getattr(publisher, "take_requests", list[AlarmCommand])():
                words = request.who, request.asset, request.alarm, request.command
                self.store.add_command(*words, reason=request.reason, for_s=request.for_s)

    @property
    def troubles(self) -> dict[AlarmSource, Mapping[str, str]]:
        """What is wrong, in words, by its kind and name; empty: nothing."""
        # a publisher of another package may say nothing
        outlets = {name: str(getattr(publisher, "trouble", "")) for name, publisher in self._publishers.items()}
        sources = {name: outlets.get(name, "") or source.trouble for name, source in self.sources.items()}
        backlogs = {name: source.transport.backlog for name, source in self.sources.items()}
        return {
            "connection": outlets | sources,
            "left_out": self._components.left_out,
            "backlog": {name: backlog.trouble for name, backlog in backlogs.items() if backlog},
        }
