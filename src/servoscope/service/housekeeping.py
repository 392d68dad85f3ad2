"""What a service does beside its samples, about once a second: commands, deliveries, its own alarms, retention."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping

from servoscope.core.errors import AlarmError, ServoscopeError, StoreUnavailableError
from servoscope.core.messages import message, render
from servoscope.service.alarms import LifecycleEvent, OperatorCommand
from servoscope.service.assets.examination_schedule import Announcement
from servoscope.service.assets.records import StepResult, audit_row
from servoscope.service.baselines import export_baseline, stored_baseline
from servoscope.service.config import StoreSettings
from servoscope.service.log import log
from servoscope.service.metrics import ServiceMetrics
from servoscope.service.parts import ServiceParts
from servoscope.service.sources.message import RejectionCounter
from servoscope.service.store import CommandOutcome, Row, Store
from servoscope.service.store.rows import BASELINE_NOTE, BEGUN, CONFIRMATION, NOTE, RELEARN, TEST
from servoscope.service.store.series import read_new_notes, thin_sizes

DAY_S = 86400.0
RETENTION_EVERY_S = 3600.0
THIN_WITHIN_S = 1800.0  # the sizes of all assets are thinned, some at each look, a millisecond each
REJECTIONS_EVERY_S = 60.0  # between two audit rows about a flood of bad messages


class Housekeeping:
    """Done by a service for itself."""

    def __init__(self, service: ServiceParts, metrics: ServiceMetrics) -> None:
        self._service, self._metrics = service, metrics
        self._executed: set[int] = set()  # commands whose outcome is not yet stored
        self._rejections = RejectionCounter()
        self._last_note, self._announced = 0, dict[str, Announcement | None]()
        self._next_retention = 0.0
        self._next_rejections: dict[tuple[str, str], float] = {}  # by asset and kind, monotonic [s]
        # by asset, until when on its clock its sizes are thinned, and until when they are to be
        self._thinned: dict[str, float] = {}
        self._to_thin: dict[str, float] = {}

    def run_due(self) -> None:
        """Do what is due."""
        self._update_service_alarms()
        self._store_deliveries()
        self._store_rejections()
        try:
            if self._service.writer.unavailable_since is None:
                self._take_announcements()
                self._service.store_requests()
                self._execute_commands()
                self._delete_old_rows()
                self._thin_sizes()
        except StoreUnavailableError as error:
            log("debug", "store unavailable", why=str(error))  # the next commit reports it as an error

    def _update_service_alarms(self) -> None:
        """Advance the service's own alarms, and the flood."""
        writer, notifier, now = self._service.writer, self._service.notifier, self._service.clock.now()
        result = notifier.check_service(writer.fill_ratio, self._service.troubles, now)
        self._handle_own(result, now)
        clocks = [asset.t for asset in self._service.assets.values() if asset.heard]
        writer.add(notifier.name, notifier.advance_time(max(clocks, default=0.0), now))

    def _handle_own(self, result: StepResult, now: float) -> None:
        writer, notifier = self._service.writer, self._service.notifier
        writer.add(notifier.name, result.rows)
        writer.add(notifier.name, notifier.notify(result.transitions, {}, now))

    def _store_deliveries(self) -> None:
        for attempt in self._service.dispatcher.take_attempts():
            level, entry = "info" if attempt.delivered else "warning", attempt.entry
            log(level, "delivery", key=entry.key, sink=entry.sink, outcome=attempt.detail)
            due = None if attempt.retry_entry is None else attempt.retry_entry.due
            row = {"attempts": entry.attempts + 1, "due": due, "outcome": attempt.detail}
            self._service.writer.batch.deliveries[entry.key] = row

    def _store_rejections(self) -> None:
        """Store what came from outside and could not be used: at once, then once a minute, for each of its kinds."""
        for name, source in self._service.sources.items():
            for rejection in source.rejections.take():
                self._metrics.record_rejection(name, rejection)
                if rejection.asset:
                    self._service.note_refusal(rejection.asset, rejection.reason)
                self._rejections.add(rejection.asset or name, rejection.kind, rejection.reason, rejection.count)
        now = time.monotonic()
        for rejection in self._rejections.take():
            if now < self._next_rejections.get((rejection.asset, rejection.kind), 0.0):
                self._rejections.add(rejection.asset, rejection.kind, rejection.reason, rejection.count)
                continue
            self._next_rejections[rejection.asset, rejection.kind] = now + REJECTIONS_EVERY_S
            log(
                "warning",
                "refused",
                of=rejection.asset,
                kind=rejection.kind,
                count=rejection.count,
                why=rejection.reason,
            )
            document = {"kind": rejection.kind, "count": rejection.count, "why": rejection.reason}
            self._service.writer.add(rejection.asset, [audit_row("refused", document)])

    def _take_announcements(self) -> None:
        """Let assets know what people have noted to be done to them, until their next baseline is in force."""
        for row in read_new_notes(self._service.store, self._last_note):
            self._last_note, name, note = row["id"], row["asset"], row["document"]
            kind, known = note.get("kind", NOTE), self._announced.get(name)
            if kind == CONFIRMATION:
                self._announced[name] = known and known._replace(confirmed=True)
            elif kind != NOTE:
                self._announced[name] = None if kind == BASELINE_NOTE else Announcement(kind, note["t"])
        for name, announced in self._announced.items():
            if name in self._service.assets:  # a file that was read again has made some anew
                self._service.assets[name].announce(announced)

    def _execute_commands(self) -> None:
        service = self._service
        pending = service.store.pending_commands()
        self._executed &= {row["id"] for row in pending}
        own = {*service.assets, service.notifier.name}  # others belong to another service on the same store
        new = [row for row in pending if row["id"] not in self._executed and row["asset"] in own]
        if begun := [row for row in new if row["command"] != RELEARN and BEGUN not in row["document"]]:
            service.store.begin_commands(begun)
        for row in new:
            self._executed.add(row["id"])
            self._execute_command(row)

    def _execute_command(self, row: Row) -> None:
        service, name, command = self._service, row["asset"], row["document"]
        try:
            if row["command"] == RELEARN:
                if "baseline" in command:  # else of an older servoscope, which had only the file
                    export_baseline(service.config, name, stored_baseline(name, command))
                    command = {key: value for key, value in command.items() if key != "baseline"}
                service.reload(service.config.file)
            elif BEGUN in row["document"]:  # what it led to went with the process, and may have ended it
                raise AlarmError(render(message("service.command_interrupted")))
            else:
                self._carry_out(row)
            outcome = CommandOutcome(accepted=True)
        except Exception as error:  # no command ends the service
            why = str(error) if isinstance(error, ServoscopeError) else f"{type(error).__name__}: {error}"
            outcome = CommandOutcome(accepted=False, refusal=why)
        document = outcome.extend(command)
        service.writer.batch.outcomes[row["id"]] = {"outcome": outcome.text, "document": document}
        if row["command"] == RELEARN and outcome.accepted:
            return  # the audit has it already, as a note
        audit = {"alarm": row["alarm"], "asked": row["at"], **document, "outcome": outcome.text}
        service.writer.add(name, [audit_row(row["command"], audit, row["who"])])

    def _carry_out(self, row: Row) -> None:
        """Do what a command says; raises AlarmError where it has no meaning."""
        service, name, document = self._service, row["asset"], row["document"]
        asset, notifier = service.assets.get(name), service.notifier
        now = service.clock.now() if asset is None or asset.state is None else asset.state.position.t
        until = now + document["for_s"] if document.get("for_s") is not None else None
        if row["command"] == TEST:
            service.writer.add(name, notifier.try_sink(row["alarm"], row["who"], now))
        elif asset is not None:
            service.handle_result(asset, asset.execute(row["alarm"], _operator_command(row, until)))
            service.writer.set_checkpoint(asset)
        else:
            self._handle_own(notifier.execute(row["alarm"], _operator_command(row, until), now), now)

    def _delete_old_rows(self) -> None:
        now = time.monotonic()
        if now < self._next_retention:
            return
        self._next_retention = now + RETENTION_EVERY_S
        service, store = self._service, self._service.store
        clocks = {name: asset.t for name, asset in service.assets.items() if asset.has_state}
        deleted = delete_old_rows(store, service.config.store, service.config.name, clocks, service.clock.now())
        for table, count in deleted.items():
            log("info", f"old {table} deleted", rows=count)
        self._to_thin |= clocks

    def _thin_sizes(self) -> None:
        """Thin the sizes of some assets: those of all of them at once would keep blocks waiting."""
        thinned = 0
        # those of an asset that has gone to another service are thinned there
        self._to_thin = {name: t for name, t in self._to_thin.items() if name in self._service.assets}
        for name in list(self._to_thin)[: math.ceil(len(self._service.assets) / THIN_WITHIN_S)]:
            thinned += thin_sizes(self._service.store, name, self._to_thin[name], self._thinned.get(name))
            self._thinned[name] = self._to_thin.pop(name)
        if thinned:
            log("info", "old sizes thinned", rows=thinned)


def _operator_command(row: Row, until: float | None) -> OperatorCommand:
    return OperatorCommand(LifecycleEvent(row["command"]), row["who"], row["document"].get("why", ""), until)


def delete_old_rows(
    store: Store, settings: StoreSettings, service: str, clocks: Mapping[str, float], now: float
) -> dict[str, int]:
    """Delete what is older than the settings say; return how many rows of which table.

    `clocks`: by each asset that `service` follows, its own time [UTC s]; `now`: that of this machine [UTC s].
    """
    written, counts = store.checkpoint_times(), {}
    for table, days in (
        ("residuals", settings.residual_days),
        ("sizes", settings.size_days),
        ("diagnoses", settings.event_days),
        ("transitions", settings.event_days),
    ):
        if days is None:
            continue
        before = {name: t - days * DAY_S for name, t in clocks.items()}
        # of an asset that nobody follows any more, all rows are older than its last checkpoint
        before |= {name: math.inf for name, at in written.items() if name not in clocks and at < now - days * DAY_S}
        if table == "transitions":
            before[service] = now - days * DAY_S
        counts[table] = store.delete_before(table, before)
    if settings.event_days is not None:
        counts |= store.delete_events(service, list(clocks), now - settings.event_days * DAY_S)
    return {table: count for table, count in counts.items() if count}
