"""Who else acts in the world: receivers of notifications, the process of full diagnoses, and people."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Coroutine, Sequence
from types import SimpleNamespace
from typing import Any

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.records import Revision
from servoscope.core.errors import BaselineError, OutputError, StoreError
from servoscope.service.assets.examination import StoredDiagnosis, examine_blocks
from servoscope.service.baselines import announce_baseline
from servoscope.service.config import ServiceFile
from servoscope.service.store import Store
from simulated.broker import point
from simulated.clock import Clock
from simulated.faults import Plan

TIMEOUT_S = 10.0
COMMANDS = ("acknowledge", "reset", "shelve", "unshelve", "remove_from_service", "return_to_service", "no such command")


class Receivers:
    """A webhook's receiver and a mail server: they take, refuse, hang, or take and hide that they did."""

    def __init__(self, clock: Clock, plan: Plan, broken: Callable[[str], None]) -> None:
        self._clock, self._plan, self._broken = clock, plan, broken
        self.delivered = set[str]()  # keys of which the store knows that they were delivered
        self._keys: dict[tuple[Any, ...], str] = {}  # of each event
        self.taken: defaultdict[str, int] = defaultdict(int)

    async def post(self, sink: Any, _folder: Any, body: bytes, headers: dict[str, str]) -> tuple[int, str]:
        """Take the place of an HTTP request."""
        return 204 if self._take("post", sink.timeout_s, [json.loads(body)], headers["Idempotency-Key"]) else 503, "1"

    def mail(self, key: str, events: Sequence[dict[str, Any]], sink: Any, *_: Any) -> str:
        """Take the place of a mail server."""
        if not self._take("mail", sink.timeout_s, events, key):
            raise OSError("451 try again later")
        return "250 ok"

    def _take(self, place: str, timeout_s: float, events: Sequence[dict[str, Any]], key: str) -> bool:
        self._clock.sleep(0.05)
        fault = point(self._clock, self._plan, f"{place} before")
        if fault == "hang":
            self._clock.sleep(timeout_s)
            raise TimeoutError
        if fault == "error":
            return False
        for event in events:
            self._note(place, event)
        self.taken[key] += 1
        if point(self._clock, self._plan, f"{place} after") == "unknown":
            self._clock.sleep(timeout_s)
            raise TimeoutError
        return True

    def _note(self, place: str, event: dict[str, Any]) -> None:
        key, names = event["key"], ("asset", "alarm", "event", "time", "before", "after", "service")
        identity = (place, *(str(event.get(name)) for name in names))
        if key in self.delivered:
            self._broken(f"{place}: {key} is sent once more, though the store knows that it was taken")
        if self._keys.setdefault(identity, key) != key:
            self._broken(f"{place}: {identity} is sent under two keys")


class Loop:
    """What runs coroutines that wait for nothing but greenlets."""

    def run_until_complete(self, work: Coroutine[Any, Any, Any]) -> Any:
        """Return what it returns."""
        try:
            work.send(None)
        except StopIteration as end:
            return end.value
        raise AssertionError("it waits for something outside the world")

    def close(self) -> None:
        """End."""


ASYNCIO = SimpleNamespace(new_event_loop=Loop)


class Answer:
    """A result that is there from some time on."""

    def __init__(self, clock: Clock, seconds: float, compute: Callable[[], StoredDiagnosis]) -> None:
        self._clock, self._due, self._compute = clock, clock.now + seconds, compute

    def done(self) -> bool:
        """Whether it is there."""
        return self._clock.now >= self._due

    def result(self) -> StoredDiagnosis:
        """Return it."""
        return self._compute()


class Diagnoses:
    """Takes the place of the process that makes full diagnoses: it takes its time, and examines without a refit."""

    def __init__(self, clock: Clock, plan: Plan) -> None:
        self._clock, self._plan = clock, plan

    def submit(self, baseline: Any, name: str, blocks: Sequence[Any]) -> Answer:
        """Ask for the diagnosis of a window."""
        point(self._clock, self._plan, "diagnose before")
        seconds, own = self._plan.chance.uniform(0.1, 4.0), list(blocks)
        return Answer(self._clock, seconds, lambda: examine_blocks(baseline, name, own))

    def close(self) -> None:
        """End."""


class People:
    """Give commands and put baselines in force, from a process of their own."""

    def __init__(self, clock: Clock, plan: Plan, config: ServiceFile, names: Sequence[str]) -> None:
        self._clock, self._plan, self._config, self._names = clock, plan, config, names
        self._store: Store | None = None
        self.relearned: dict[str, str] = {}  # by asset, the hash of the last baseline that was put in force for sure
        self._number = 0

    def act(self, what: str) -> None:
        """Do something; where the store is away, do it later."""
        for _ in range(20):
            try:
                if self._store is None:
                    self._store = Store.open(self._config.store.url, self._config.folder)
                return self._command(self._store) if what == "command" else self._relearn(self._store)
            except (StoreError, OutputError):
                self._clock.sleep(1.0)
            except BaselineError:
                return None
        return None

    def _command(self, store: Store) -> None:
        command, name = self._plan.chance.choice(COMMANDS), self._plan.chance.choice(self._names)
        alarm = self._plan.chance.choice(("fault", "data_quality", "reception"))
        store.add_command("ann", name, alarm, command, reason="why", for_s=3.0 if command == "shelve" else None)

    def _relearn(self, store: Store) -> None:
        name = self._plan.chance.choice(self._names)
        before, self._number = Baseline.load(self._config.baseline_file(name)), self._number + 1
        number, now = before.revision.number, self._clock.time()
        revision = Revision(number=number + 1, kind="healthy", who="ann", parent=number, at=now)
        renewed = before.model_copy(update={"hash": f"{self._number:016x}", "revision": revision})
        announce_baseline(self._config, store, name, number, renewed, now)
        self.relearned[name] = renewed.hash
