"""What a service does beside its samples, about once a second: commands, deliveries, its own alarms, retention."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from servoscope.alarms import Command, Event
from servoscope.errors import AlarmError, StoreUnavailable
from servoscope.live.logs import log
from servoscope.live.refusals import Refusals
from servoscope.live.rows import Row
from servoscope.store import Row as Stored

if TYPE_CHECKING:
    from servoscope.live.service import Service

__all__ = ["Chores"]

RETENTION_EVERY_S = 3600.0
REFUSALS_EVERY_S = 60.0  # that a flood of bad messages is written down
DAY_S = 86400.0


class Chores:
    """Done by a service for itself.

    Parameters
    ----------
    service
        Whose chores they are.
    """

    def __init__(self, service: Service) -> None:
        self._of = service
        self._obeyed: set[int] = set()  # commands whose outcome is on its way to the store
        self._next_retention = 0.0
        self._refused = Refusals()
        self._next_refusals = 0.0

    def do(self) -> None:
        """Do what is due."""
        self._watch_itself()
        self._take_deliveries()
        self._take_refusals()
        try:
            if self._of.writer.unavailable_since is None:
                self._obey()
                self._retain()
        except StoreUnavailable as error:
            log("debug", "store unavailable", why=str(error))  # the next commit says so louder

    def _watch_itself(self) -> None:
        """Let the service's own alarms and the flood follow."""
        writer, announcer, now = self._of.writer, self._of.announcer, time.time()
        own = announcer.watch(writer.share, now)
        assets = [asset.progress.counted.t for asset in self._of.assets.values() if asset.progress is not None]
        writer.add(announcer.name, own.rows)
        writer.add(announcer.name, announcer.tell(own.transitions, {}, now))
        writer.add(announcer.name, announcer.pass_time(max(assets, default=0.0), now))

    def _take_deliveries(self) -> None:
        """Note how deliveries went."""
        for one in self._of.courier.delivered():
            log("info" if one.delivered else "warning", "delivery", key=one.key, sink=one.sink, outcome=one.detail)
            due = None if one.again is None else one.again.due
            row = {"attempts": one.attempt, "due": due, "outcome": one.detail}
            self._of.writer.batch.deliveries[one.key] = row

    def _take_refusals(self) -> None:
        """Note what came from outside and could not be used: at once, then once a minute."""
        for name, source in self._of.sources.items():
            for one in source.refused():
                self._of.metrics.refused(name, one)
                self._refused.add(one.asset or name, one.kind, one.why, one.number)
        now = time.monotonic()
        if now < self._next_refusals:
            return
        for one in self._refused.taken():
            self._next_refusals = now + REFUSALS_EVERY_S
            log("warning", "refused", of=one.asset, kind=one.kind, count=one.number, why=one.why)
            words = {"kind": one.kind, "count": one.number, "why": one.why}
            self._of.writer.add(one.asset, [Row("audit", {"who": "servoscope", "what": "refused", "document": words})])

    def _obey(self) -> None:
        """Carry out what operators have asked for."""
        waiting = self._of.store.waiting_commands()
        self._obeyed &= {command["id"] for command in waiting}
        for command in waiting:
            if command["id"] not in self._obeyed:
                self._obeyed.add(command["id"])
                self._carry_out(command)

    def _carry_out(self, command: Stored) -> None:
        service, name = self._of, command["asset"]
        asset, announcer = service.assets.get(name), service.announcer
        if asset is None and name != announcer.name:
            return  # another service on the same store follows it
        document = command["document"]
        now = time.time() if asset is None or asset.progress is None else asset.progress.counted.t
        until = None if document.get("for_s") is None else now + document["for_s"]
        asked = Command(Event(command["command"]), command["who"], document.get("why", ""), until)
        outcome = "done"
        try:
            if asset is not None:
                service.tell(asset, asset.obey(command["alarm"], asked))
                service.writer.stands(asset)
            else:
                own = announcer.obey(command["alarm"], asked, now)
                service.writer.add(name, own.rows)
                service.writer.add(name, announcer.tell(own.transitions, {}, now))
        except AlarmError as error:
            outcome = f"refused: {error}"
        words = {"alarm": command["alarm"], "asked": command["at"], **document, "outcome": outcome}
        service.writer.add(name, [Row("audit", {"who": asked.who, "what": command["command"], "document": words})])
        service.writer.batch.outcomes[command["id"]] = outcome

    def _retain(self) -> None:
        """Delete residuals that are older than they are kept for."""
        now = time.monotonic()
        if now < self._next_retention:
            return
        self._next_retention = now + RETENTION_EVERY_S
        kept = self._of.config.store.residual_days * DAY_S
        of = {name: asset.progress.counted.t - kept for name, asset in self._of.assets.items() if asset.progress}
        if count := self._of.store.forget("residuals", of):
            log("info", "old residuals deleted", rows=count)
