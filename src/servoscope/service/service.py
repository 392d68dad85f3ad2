"""The service: polls sources for blocks, follows assets, stores the results, and acknowledges what is stored."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from pathlib import Path

import numpy as np

from servoscope import __version__
from servoscope.core.errors import ServoscopeError, StoreUnavailableError
from servoscope.core.messages import count_words, message, render
from servoscope.prognosis.forecast import Prognosis
from servoscope.service.assets.examination import StoredDiagnosis
from servoscope.service.assets.examination_schedule import PendingDiagnosis
from servoscope.service.assets.groups import QuietBlocks
from servoscope.service.assets.reception import RECEPTION_OK, ReceptionLog
from servoscope.service.assets.records import StepResult, audit_row
from servoscope.service.build import ServiceComponents
from servoscope.service.config import ServiceFile
from servoscope.service.diagnosis_worker import DiagnosisWorker, find_due_prognosis
from servoscope.service.health import HealthReport
from servoscope.service.housekeeping import Housekeeping
from servoscope.service.log import log, set_level
from servoscope.service.metrics import ServiceMetrics
from servoscope.service.parts import ServiceParts
from servoscope.service.process_supervisor import notify_systemd
from servoscope.service.reload import reload_components
from servoscope.service.sources.block import Block
from servoscope.service.sources.inbox import Inbox

MAX_BLOCKS_PER_POLL = 1024  # blocks of one source that are processed before it is another one's turn
MAX_PAUSE_S = 0.05
MIN_TURN_S = 0.25  # blocks that came within a turn are followed together, which costs a fraction of one by one
HOUSEKEEPING_EVERY_S = 1.0
PROGNOSIS_RETRY_S = 60.0  # after one that failed


class Service(ServiceParts):
    """Runs until it is stopped, or until all sources have ended; it closes its components at the end."""

    def __init__(
        self, config: ServiceFile, components: ServiceComponents, monotonic: Callable[[], float] = time.monotonic
    ) -> None:
        """`monotonic`: as in `ServiceParts`."""
        super().__init__(config, components, monotonic)
        self.metrics = ServiceMetrics(self)
        self._diagnosis_worker = DiagnosisWorker()
        self._diagnosis_jobs: dict[tuple[str, PendingDiagnosis], Future[StoredDiagnosis]] = {}
        self._prognosis_jobs: dict[str, Future[Prognosis]] = {}
        self._prognosis_from: dict[str, float] = {}  # by asset, before when none is asked for again, monotonic [s]
        self._housekeeping = Housekeeping(self, self.metrics)
        self._next_commit = self._next_housekeeping = 0.0
        self._stopping = self._is_behind = False  # _is_behind: whether the last turn left blocks for the next

    def stop(self) -> None:
        """Stop soon; for a signal's handler or another thread. Blocks in hand are finished and committed."""
        self._stopping = True

    @property
    def unready_reason(self) -> str:
        """Why it is not ready; empty where it is."""
        if self._stopping:
            return "stopping"
        is_away = self.writer.unavailable_since is not None
        return f"the store is unavailable, {self.writer.waiting} blocks wait" if is_away else ""

    def health_report(self) -> HealthReport:
        """Return what it reports of itself over HTTP."""
        return HealthReport(
            self.metrics.render, lambda: self.unready_reason, lambda: self.degraded_reason, lambda: self.last_turn
        )

    def run(self, announce: Callable[[], None] = lambda: None) -> None:
        """Run; `announce` is called when assets that begin anew have their new states in the store.

        Raises StoreUnavailableError if at the end the store does not take what is left; the sources return it again.
        """
        document = {"version": __version__, "assets": len(self.assets), "store": self.store.name}
        log("info", "started", service=self.config.name, **document)
        self.writer.add(self.config.name, [audit_row("started", document)])
        self._add_restarts(self._components)
        self.dispatcher.start()
        try:
            self._commit()
            announce()
            notify_systemd("READY=1", self._systemd_status)
            while not self._stopping and not self._ended:
                if self._reload_from is not None and self.writer.unavailable_since is None:
                    path, self._reload_from = self._reload_from, None
                    self._reload(path)
                self._run_once()
                time.sleep(self._pause_s)
            self.writer.add(self.config.name, [audit_row("stopped", {"why": self._stop_reason})])
            notify_systemd("STOPPING=1")
            self._commit_all()
        finally:
            self.dispatcher.stop()
            self._diagnosis_worker.close()
            for close in [component.close for kind in (self.sources, self._publishers) for component in kind.values()]:
                close()
            self.store.close()
        log("info", "stopped", service=self.config.name, why=self._stop_reason)

    def _add_restarts(self, components: ServiceComponents) -> None:
        """Write new states at once: if no block comes, the next start must not find the torn or old one."""
        for name, owed in components.restarted.items():
            self.writer.add(name, [audit_row("began anew", {}), *owed])
            if name in components.assets:
                self.writer.set_checkpoint(components.assets[name])

    @property
    def _systemd_status(self) -> str:
        return f"STATUS={count_words(len(self.assets), 'asset')}, {self.degraded_reason or 'all followed'}"

    def _reload(self, path: Path) -> None:
        """Change to what the service file says now; where that cannot be used, go on as before."""
        notify_systemd("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")
        try:
            config = self.config.load_again(path)
            components, changes = reload_components(config, self.config, self._components, self._commit_all)
        except StoreUnavailableError as error:  # what asked for it may be done by now: it is not asked for again
            self._reload_from = path
            log("warning", "reload waits for the store", why=str(error))
            return
        except ServoscopeError as error:
            log("error", "reload refused", why=str(error))
            self.writer.add(self.config.name, [audit_row("reload refused", {"why": str(error)})])
            notify_systemd("READY=1", f"STATUS=reload refused: {error}")
            return
        before = self.assets
        self._take_components(config, components)
        self.writer.capacity = config.service.buffer
        set_level(config.service.log)
        self.dispatcher.change(config.actions)
        # a diagnosis that is still due is asked for again
        jobs = self._diagnosis_jobs.items()
        self._diagnosis_jobs = {key: job for key, job in jobs if self.assets.get(key[0]) is before[key[0]]}
        self._prognosis_jobs = {name: job for name, job in self._prognosis_jobs.items() if name in self.assets}
        self._receptions = {
            name: self._receptions.get(name) or ReceptionLog(heard_before=asset.heard, now=self._listening.seconds)
            for name, asset in self.assets.items()
        }
        self._add_restarts(components)
        log("info", "reloaded", **changes)
        self.writer.add(self.config.name, [audit_row("reloaded", changes)])
        notify_systemd("READY=1", self._systemd_status)

    @property
    def _stop_reason(self) -> str:
        return render(message("service.stopped_asked" if self._stopping else "service.stopped_ended"))

    def _run_once(self) -> None:
        self.last_turn = now = self.clock.monotonic()
        if not self._is_behind:  # else what came is heard later, and the time until now counts with it
            self._listening.advance(now, self.config.quality.silent_s, is_free=bool(self.writer.free))
        self._is_behind = False
        for source in self.sources.values():
            self.layers.enter("decode")
            blocks = source.poll(min(MAX_BLOCKS_PER_POLL, self.writer.free))
            self.layers.enter("assemble")
            self._is_behind |= len(blocks) == MAX_BLOCKS_PER_POLL
            self._process_blocks(source, blocks)
        self._run_diagnoses(ended=self._exhausted)
        self.layers.enter("other")
        if now >= self._next_housekeeping:
            self._next_housekeeping = now + HOUSEKEEPING_EVERY_S
            notify_systemd("WATCHDOG=1")
            self._check_reception()
            self._run_prognoses()
            self._housekeeping.run_due()
        if self._exhausted:
            self.writer.finish()
        if now >= self._next_commit:
            self._next_commit = now + self.config.service.commit_every_s
            self._commit()

    def _process_blocks(self, source: Inbox, blocks: Sequence[Block]) -> None:
        # recordings are dated as they like
        latest = self.clock.latest() + self.config.service.ahead_s if source.clock_rate == 1.0 else math.inf
        for outcome in self._groups.process(blocks, latest):
            if isinstance(outcome, QuietBlocks):
                self._store_quiet(outcome)
                continue
            block, result = outcome
            asset = self.assets[block.asset]
            if asset.pending_diagnoses:
                self._awaiting[asset.name] = None
            if isinstance(result, ServoscopeError):
                log("error", "block refused", asset=block.asset, sequence=block.sequence, why=str(result))
                self.note_refusal(block.asset, str(result))
                document = {"sequence": block.sequence, "why": str(result)}
                result = StepResult([audit_row("block refused", document)], [])
            elif result.refusal is None:
                self._receptions[block.asset].hear(self._listening.seconds)
                asset.reception = RECEPTION_OK
            else:
                source.refuse(block, *result.refusal)
            self.handle_result(asset, result)
            self.writer.set_checkpoint(asset, block.completed_at, can_wait=result.repeatable)

    def _store_quiet(self, quiet: QuietBlocks) -> None:
        for asset, (number, *_, samples, regular) in zip(quiet.assets, quiet.packed, strict=True):
            self.writer.add_block(asset.name, number, samples, regular)
            self._receptions[asset.name].hear(self._listening.seconds)
        for place, row in quiet.history:
            self.writer.add(quiet.assets[place].name, [row])
        self.writer.set_checkpoints(quiet.assets, [block.completed_at for block in quiet.blocks])

    def _run_diagnoses(self, *, ended: bool) -> None:
        """Start the full diagnoses that are due, and take the results of those that are done."""
        for name in list(self._awaiting):
            asset = self.assets[name]
            if not asset.pending_diagnoses:
                del self._awaiting[name]
            for window, blocks in asset.due_diagnoses(ended=ended, started=self._diagnosis_jobs):
                self._diagnosis_jobs[name, window] = self._diagnosis_worker.submit(asset.machine, name, blocks)
        for name, window in [key for key, job in self._diagnosis_jobs.items() if job.done()]:
            asset, diagnosis = self.assets[name], self._diagnosis_jobs.pop((name, window)).result()
            log("info", "diagnosis", asset=name, verdict=diagnosis.verdict, summary=diagnosis.summary)
            is_news = asset.is_news(window, diagnosis)
            self.handle_result(asset, asset.apply_diagnosis(window, diagnosis))
            now, rows = self.clock.now(), []
            if is_news and asset.state is not None:
                rows = self.notifier.notify_diagnosis(asset.state.alarms, diagnosis, window.until, now)
            rows += self.notifier.accommodate_fault(name, diagnosis, window.until, now)
            self.writer.add(self.config.name, rows)
            self.writer.set_checkpoint(asset)

    def _run_prognoses(self) -> None:
        """Ask for the prognoses that are due, and take the results of those that are done."""
        now, free = self.clock.monotonic(), not self._exhausted
        for name, asset in self.assets.items():
            job, limits = self._prognosis_jobs.get(name), asset.policy.limits
            if job is None and free and limits and now >= self._prognosis_from.get(name, 0.0):
                due = find_due_prognosis(asset.state, limits, self.config.prognosis.every_s) if asset.state else None
                if due is not None:
                    self._prognosis_jobs[name] = self._diagnosis_worker.submit_prognosis(self.store, name, due)
            elif job is not None and job.done():
                del self._prognosis_jobs[name]
                try:
                    prognosis = job.result()
                except ServoscopeError as error:  # nothing stored yet, or the store is away
                    self._prognosis_from[name] = now + PROGNOSIS_RETRY_S
                    log("debug", "no prognosis", asset=name, why=str(error))
                    continue
                log("info", "prognosis", asset=name, summary=prognosis.summary)
                self.handle_result(asset, asset.apply_prognosis(prognosis))
                self.writer.set_checkpoint(asset)

    def _check_reception(self) -> None:
        """Look how each asset is heard, and advance the clocks of those that are not, as fast as their samples' run."""
        if self._exhausted:
            return
        troubles = {name: (source.trouble, source.asset_troubles) for name, source in self.sources.items()}
        fresh_s = min(HOUSEKEEPING_EVERY_S, self.config.quality.silent_s)
        for name, asset in self.assets.items():
            reception, before, (trouble, of_assets) = self._receptions[name], asset.reception, troubles[asset.source]
            fresh = name not in of_assets and reception.is_fresh(self._listening.seconds, fresh_s)
            if fresh and before is RECEPTION_OK:
                continue  # nearly all of them, nearly always
            source, own = self.sources[asset.source], of_assets.get(name)
            pause_s, silence = source.pause_s, reception.silence_s(self._listening.seconds)
            is_expected = math.isinf(pause_s) or (silence < pause_s and not asset.heard)
            if is_expected and not asset.heard and own is None and not trouble:
                asset.reception = RECEPTION_OK  # its first samples may still come in time
            elif not math.isinf(source.next_block_s):
                patience_s = self.config.quality.silent_s + max(asset.policy.pause_s, 0.0 if trouble else pause_s)
                asset.reception = reception.evaluate(self._listening.seconds, patience_s, trouble, own)
            has_changed = asset.reception != before
            if silence >= HOUSEKEEPING_EVERY_S and not is_expected:
                result = asset.advance_time(silence * source.clock_rate)
                self.handle_result(asset, result)
                has_changed |= bool(result.rows) or not result.repeatable
            if has_changed:
                self.writer.set_checkpoint(asset)

    @property
    def degraded_reason(self) -> str:
        """Which assets are not followed although the service itself is ready; empty: none."""
        lacking = {name: asset for name, asset in self.assets.items() if asset.reception.state != "followed"}
        whys = {**self._components.left_out, **{name: asset.reception.why for name, asset in lacking.items()}}
        if not whys:
            return ""
        name, why = next(iter(whys.items()))
        counts = {"count": len(whys), "total": len(self.assets) + len(self._components.left_out)}
        return render(message("service.degraded_assets", asset=name, why=why, **counts))

    def _commit(self) -> None:
        """Write what was gathered; what cannot be written waits."""
        self.layers.enter("store")
        if not self.writer.empty:
            self.writer.add_checkpoint(self.notifier.checkpoint())
        start, unavailable_since = time.monotonic(), self.writer.unavailable_since
        try:
            stored = self.writer.write()
        except StoreUnavailableError as error:
            if unavailable_since is None:
                log("error", "store unavailable", why=str(error), waiting=self.writer.waiting)
            self.metrics.failures.inc()
            return
        if stored is None:
            return
        if unavailable_since is not None:
            seconds = round(time.time() - unavailable_since, 3)
            log("info", "store available again", seconds=seconds, waiting=self.writer.waiting)
            document = {"from": unavailable_since, "seconds": seconds}
            self.writer.add(self.config.name, [audit_row("store was unavailable", document)])
        self.layers.enter("publish")
        statuses = {name: row["status"] for name, row in stored.batch.checkpoints.items()}
        for publisher in self._publishers.values():
            publisher.publish(statuses)
        self.dispatcher.wake()
        now = time.monotonic()
        for name, blocks in stored.blocks.items():
            self.sources[self.assets[name].source].acknowledge(name, blocks)
        self.layers.enter("other")
        latencies = now - np.array(stored.completion_times)
        self.metrics.record_commit(latencies, now - start)
        latest = round(float(latencies.max(initial=0.0)), 4)
        log("debug", "commit", blocks=latencies.size, seconds=round(now - start, 4), latest=latest)

    @property
    def _exhausted(self) -> bool:
        return all(math.isinf(source.next_block_s) for source in self.sources.values())

    @property
    def _ended(self) -> bool:
        """Whether there is nothing left to do, and never will be."""
        is_waiting = self._diagnosis_jobs or self._prognosis_jobs
        return self._exhausted and not is_waiting and self.writer.empty and self.dispatcher.idle

    @property
    def _pause_s(self) -> float:
        """How long to sleep before the next turn [s]."""
        now = self.clock.monotonic()
        # what is measured now is gathered for a while, unless each block is to be stored soon, or a turn was full
        gather_s = min(MIN_TURN_S, 0.5 * self.config.service.commit_every_s) if not self._is_behind else 0.0
        rest_s = max(0.0, self.last_turn + gather_s - now)
        nexts = (max(source.next_block_s, rest_s * (source.clock_rate == 1.0)) for source in self.sources.values())
        due = min(nexts, default=math.inf) if self.writer.free else math.inf  # none: a worker that lost its last asset
        return min(due, max(MAX_PAUSE_S, rest_s), max(0.0, self._next_commit - now))

    def _commit_all(self) -> None:
        """Commit what is in hand; raises StoreUnavailableError if the store does not take it in time."""
        self.writer.finish()
        deadline = time.monotonic() + self.config.service.stop_within_s
        while not self.writer.empty:
            self._commit()
            if self.writer.unavailable_since is not None and time.monotonic() > deadline:
                waiting = self.writer.waiting
                raise StoreUnavailableError(
                    f"{self.store.name}: still unavailable; {waiting} blocks are not stored, sources offer them again"
                )
            time.sleep(0.0 if self.writer.unavailable_since is None else MAX_PAUSE_S)
