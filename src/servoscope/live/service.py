"""The service: takes blocks from sources, follows assets, writes what that leads to, and acknowledges what is safe."""

from __future__ import annotations

import math
import time
from concurrent.futures import Future
from typing import Any

from servoscope import __version__
from servoscope.errors import ServoscopeError, StoreUnavailable
from servoscope.live.assembling import Assembly
from servoscope.live.asset import Asset
from servoscope.live.block import Block
from servoscope.live.chores import Chores
from servoscope.live.config import Config
from servoscope.live.delivering import Courier
from servoscope.live.examining import Told
from servoscope.live.judging import Window
from servoscope.live.logs import log
from servoscope.live.looking import Looker
from servoscope.live.metrics import Metrics
from servoscope.live.rows import Outcome, Row
from servoscope.live.writing import Writer

__all__ = ["Service"]

AT_ONCE = 256  # blocks that are taken before somebody else has a turn
LONGEST_PAUSE_S = 0.05
CHORES_EVERY_S = 1.0


class Service:
    """Runs until it is stopped, or until all sources have ended.

    Parameters
    ----------
    config
        The service file.
    assembly
        What `assemble` made of it; the service closes it.
    """

    def __init__(self, config: Config, assembly: Assembly) -> None:
        self.config, self.sources, self.store = config, assembly.sources, assembly.store
        self._outlets = assembly.outlets
        self.assets, self.announcer, self._anew = assembly.assets, assembly.announcer, assembly.anew
        self.writer = Writer(self.store, config.name, config.service.buffer)
        self.metrics = Metrics(self)
        self.courier = Courier(self.store, config.name, config.actions.beside(config.folder))
        self._looker = Looker()
        self._looking: dict[tuple[str, Window], Future[Told]] = {}
        self._listened = 0.0  # s: that it has been ready to hear; being busy, or full, is no silence of a sensor
        self._heard: dict[str, float] = {}  # when it last heard of each asset, by that clock
        self._chores = Chores(self)
        self._next_commit = self._next_chores = 0.0
        self._stopping = False
        self.beat = time.monotonic()  # the last turn: a service that hangs is not alive

    def stop(self) -> None:
        """Ask it to stop, from a signal's handler or another thread: blocks in hand are finished and committed."""
        self._stopping = True

    @property
    def ready(self) -> str:
        """Why it is not ready; empty where it is."""
        if self._stopping:
            return "stopping"
        if self.writer.unavailable_since is not None:
            return f"the store is unavailable, {self.writer.waiting} blocks wait"
        return ""

    def run(self) -> None:
        """Run.

        Raises
        ------
        StoreUnavailable
            If at the end the store does not take what is left; the sources will offer it again.
        """
        words = {"version": __version__, "assets": len(self.assets), "store": self.store.name}
        log("info", "started", service=self.config.name, **words)
        self._audit("started", words)
        for name in self._anew:  # written at once: a torn state must not be met again if no block comes
            self.writer.add(name, [Row("audit", {"who": "servoscope", "what": "began anew", "document": {}})])
            if name in self.assets:
                self.writer.stands(self.assets[name])
        self.courier.start()
        try:
            while not self._stopping and not self._ended():
                self._turn()
                time.sleep(self._pause())
            self._finish()
        finally:
            self.courier.stop()
            self._looker.close()
            for source in self.sources.values():
                source.close()
            for outlet in self._outlets.values():
                outlet.close()
            self.store.close()
        log("info", "stopped", service=self.config.name, why=self._why)

    @property
    def _why(self) -> str:
        return "it was asked to" if self._stopping else "all sources have ended"

    def _audit(self, what: str, words: dict[str, Any]) -> None:
        self.writer.add(self.config.name, [Row("audit", {"who": "servoscope", "what": what, "document": words})])

    def _turn(self) -> None:
        before, self.beat = self.beat, time.monotonic()
        now = self.beat
        if self.writer.room:
            self._listened += min(now - before, 2.0 * LONGEST_PAUSE_S)
        for source in self.sources.values():
            for block in source.poll(min(AT_ONCE, self.writer.room)):
                self._take(block)
        self._look(ended=self._exhausted)
        if now >= self._next_chores:
            self._next_chores = now + CHORES_EVERY_S
            self._listen()
            self._chores.do()
        if now >= self._next_commit:
            self._next_commit = now + self.config.service.commit_every_s
            self._commit()

    def _take(self, block: Block) -> None:
        asset = self.assets[block.asset]
        self._heard[block.asset] = self._listened
        try:
            outcome = asset.take(block)
        except ServoscopeError as error:  # one asset's trouble must not stop the others
            log("error", "block refused", asset=block.asset, sequence=block.sequence, why=str(error))
            words = {"sequence": block.sequence, "why": str(error)}
            outcome = Outcome([Row("audit", {"who": "servoscope", "what": "block refused", "document": words})], [])
        self.tell(asset, outcome)
        self.writer.stands(asset, block.due)

    def tell(self, asset: Asset, outcome: Outcome) -> None:
        """Hand on what something led to."""
        self.writer.add(asset.name, outcome.rows)
        if not outcome.transitions or asset.progress is None:
            return
        now, judged = time.time(), asset.progress.judged
        for one in outcome.transitions:
            words = {"asset": one.asset, "alarm": one.alarm, "before": str(one.before), "after": str(one.after)}
            log("info", "alarm", **words, cause=one.cause, who=one.who, t=one.time)
            if one.alarm == "fault" and one.event == "clear":
                self.writer.add(self.config.name, self.announcer.respond(asset.name, None, one.time, now))
        details = {"diagnosis": judged.summary, "onset": judged.onset}
        self.writer.add(self.config.name, self.announcer.tell(outcome.transitions, details, now))

    def _look(self, *, ended: bool) -> None:
        """Start the full diagnoses that are wanted, and take those that are there."""
        for asset in self.assets.values():
            for window, blocks in asset.wanted(ended=ended):
                if (asset.name, window) not in self._looking:
                    self._looking[asset.name, window] = self._looker.submit(asset.baseline, asset.name, blocks)
        for (name, window), job in list(self._looking.items()):
            if not job.done():
                continue
            del self._looking[name, window]
            asset, said = self.assets[name], job.result()
            log("info", "diagnosis", asset=name, verdict=said.verdict, summary=said.summary)
            is_news = asset.is_news(window, said)
            self.tell(asset, asset.told(window, said))
            now = time.time()
            if is_news and asset.progress is not None:
                alarms = asset.progress.alarms
                self.writer.add(self.config.name, self.announcer.diagnosed(alarms, said, window.until, now))
            self.writer.add(self.config.name, self.announcer.respond(name, said, window.until, now))
            self.writer.stands(asset)

    def _listen(self) -> None:
        """Let time pass for assets that nothing is heard of, as fast as their samples' clock runs."""
        for name, asset in self.assets.items():
            silence = self._listened - self._heard.setdefault(name, self._listened)
            pace = self.sources[self.config.assets[name].source].pace
            if silence >= CHORES_EVERY_S and not self._exhausted:
                self.tell(asset, outcome := asset.tick(silence * pace))
                if outcome.rows:
                    self.writer.stands(asset)

    def _commit(self) -> None:
        """Write what was gathered; what cannot be written waits."""
        if not self.writer.empty:
            self.writer.remember(self.announcer.checkpoint())
        begun, before = time.monotonic(), self.writer.unavailable_since
        try:
            done = self.writer.write()
        except StoreUnavailable as error:
            if before is None:
                log("error", "store unavailable", why=str(error), waiting=self.writer.waiting)
            self.metrics.failures.inc()
            return
        if done is None:
            return
        if before is not None:
            seconds = round(time.time() - before, 3)
            log("info", "store available again", seconds=seconds, waiting=self.writer.waiting)
            self._audit("store was unavailable", {"from": before, "seconds": seconds})
        for outlet in self._outlets.values():
            outlet.tell({name: row["status"] for name, row in done.batch.checkpoints.items()})
        self.courier.expect()
        now = time.monotonic()
        for name, blocks in done.taken.items():
            self.sources[self.config.assets[name].source].acknowledge(name, blocks)
        self.metrics.committed([now - due for due in done.due], now - begun)
        latest = max((now - due for due in done.due), default=0.0)
        log("debug", "commit", blocks=len(done.due), seconds=round(now - begun, 4), latest=round(latest, 4))

    @property
    def _exhausted(self) -> bool:
        return all(math.isinf(source.waits) for source in self.sources.values())

    def _ended(self) -> bool:
        """Whether there is nothing left to do, and never will be."""
        return self._exhausted and not self._looking and self.writer.empty and self.courier.idle

    def _pause(self) -> float:
        """Return how long to sleep before the next turn [s]."""
        due = min(source.waits for source in self.sources.values()) if self.writer.room else math.inf
        return min(due, LONGEST_PAUSE_S, max(0.0, self._next_commit - time.monotonic()))

    def _finish(self) -> None:
        """Commit what is in hand."""
        self._audit("stopped", {"why": self._why})
        deadline = time.monotonic() + self.config.service.stop_within_s
        while not self.writer.empty:
            self._commit()
            if self.writer.unavailable_since is not None and time.monotonic() > deadline:
                blocks = self.writer.waiting
                raise StoreUnavailable(
                    f"{self.store.name}: still unavailable; {blocks} blocks are not stored, sources offer them again"
                )
            time.sleep(0.0 if self.writer.unavailable_since is None else LONGEST_PAUSE_S)
