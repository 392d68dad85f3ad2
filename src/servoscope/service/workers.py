"""The processes among which a service shares out its assets: started, asked, and stopped as one service."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import closing
from http.client import HTTPConnection, HTTPException
from json import loads
from pathlib import Path
from typing import Any

from servoscope.core.errors import ServoscopeError
from servoscope.core.messages import count_words
from servoscope.service.build import check_restarted, check_service_file
from servoscope.service.config import ServiceFile
from servoscope.service.health import STALL_S, HealthReport
from servoscope.service.log import log
from servoscope.service.process_supervisor import ProcessSupervisor, notify_systemd
from servoscope.service.store import Store

POLL_INTERVAL_S = 1.0
ANSWER_S = 5.0  # in which a worker answers
# of metrics that several workers have under one name: how they are put together, where that is not their sum
COMBINATIONS: dict[str, Callable[[float, float], float]] = {
    "servoscope_store_up": min,
    "servoscope_source_up": min,
    "servoscope_connection_trouble": max,
    "servoscope_last_turn_age_seconds": max,
}


def merge_metrics(texts: Iterable[str]) -> str:
    """Return metrics of several processes, each in the format of Prometheus, as those of one."""
    heads: dict[str, list[str]] = {}  # by family, in order
    values: dict[str, dict[str, float]] = {}  # by family, then by name and labels
    for text in texts:
        family, own = "", set[str]()
        for line in text.splitlines():
            if line.startswith("#"):
                family = line.split(" ", 3)[2]
                if family not in heads or family in own:
                    heads.setdefault(family, []).append(line)
                    own.add(family)
                continue
            key, _, value = line.rpartition(" ")
            name, of = key.partition("{")[0], values.setdefault(family, {})
            combine = min if name.endswith("_created") else COMBINATIONS.get(name, float.__add__)
            of[key] = combine(of[key], float(value)) if key in of else float(value)
    lines = []
    for family, head in heads.items():
        lines += [*head, *(f"{key} {value!r}" for key, value in values.get(family, {}).items())]
    return "".join(f"{line}\n" for line in lines)


class _Follower:
    """One of the processes, and where it answers; empty: it has not said so yet.

    `anew`: assets that begin with a new state when it first starts; `files`: as in `ProcessSupervisor`.
    """

    def __init__(
        self, config: ServiceFile, path: Path, number: int, anew: Iterable[str], files: Collection[int]
    ) -> None:
        self.number, self._path, self._anew, self._address = number, path, list(anew), ""
        self._reload_due = self.has_begun = False  # has_begun: whether it follows its assets
        self.supervisor = ProcessSupervisor(
            f"worker {number}",
            self._command,
            may_end=True,
            says=self._take_address,
            files=files,
            stops_within_s=config.service.stop_within_s + 10.0,
        )

    def _command(self) -> list[str]:
        self._address, self.has_begun = "", False
        anew = [part for name in self._anew for part in ("--anew", name)]
        return ["run", str(self._path), "--worker", str(self.number), *anew]

    def _take_address(self, line: str) -> None:
        self._address, self.has_begun = line.removeprefix("-"), bool(line)
        if line:
            self._anew = []  # their new states are stored: started again, it goes on
            if self._reload_due:
                self.reload()

    def reload(self) -> None:
        """Let it read the service file again; while it starts a signal would end it, and waits."""
        self._reload_due = True
        if self.has_begun:
            self._reload_due = False
            self.supervisor.send_signal(signal.SIGHUP)

    def ask(self, path: str) -> bytes:
        """Return its answer; raises OSError where it has none."""
        try:
            with closing(HTTPConnection(self._address, timeout=ANSWER_S)) as connection:
                connection.request("GET", path)
                return connection.getresponse().read()
        except (ValueError, HTTPException) as error:  # it has not started yet, or ended while it answered
            raise OSError(f"no answer: {error}") from None


class WorkerPool:
    """A service whose assets are shared out among processes; each follows those of its shard as a service of its own.

    `config`: the whole service file, from `path`; `restarted`: assets that begin with a new state.
    """

    def __init__(self, config: ServiceFile, path: Path, restarted: Collection[str] = ()) -> None:
        names = [config.shard_name(number) for number in sorted(config.shard_numbers())]
        check_restarted(restarted, [*config.assets, *names])
        check_service_file(config)
        self.config, self.path, self.restarted = config, path, restarted
        self._workers, self.last_turn = list[_Follower](), time.monotonic()
        self._stopping, self._reload = threading.Event(), threading.Event()

    def health_report(self) -> HealthReport:
        """Return what it reports of itself over HTTP."""
        return HealthReport(
            lambda: merge_metrics(text for _, text in self._ask_all("/metrics", bytes.decode) if text).encode(),
            lambda: self.unready_reason,
            lambda: self.degraded_reason,
            lambda: self.last_turn,
        )

    def _ask_all(self, path: str, parse: Callable[[bytes], Any]) -> Iterator[tuple[_Follower, Any]]:
        """Yield each worker with its answer, None where it has none: its supervisor starts it again."""
        for worker in self._workers:
            try:
                yield worker, parse(worker.ask(path))
            except (OSError, ValueError):
                yield worker, None

    def _why(self, key: str) -> str:
        whys = []
        for worker, answer in self._ask_all("/health/ready", loads):
            is_silent = answer is None and key == "why" and not worker.supervisor.done
            why = "does not answer" if is_silent else "" if answer is None else answer[key]
            whys += [f"worker {worker.number}: {why}"] if why else []
        return "; ".join(whys)

    @property
    def unready_reason(self) -> str:
        """Why it is not ready; empty: it is."""
        return "stopping" if self._stopping.is_set() else self._why("why")

    @property
    def degraded_reason(self) -> str:
        """Which assets are not followed although the service itself is ready; empty: none."""
        return self._why("degraded")

    def stop(self) -> None:
        """Stop soon; for a signal's handler."""
        self._stopping.set()

    def reload(self, path: Path) -> None:
        """Let all workers change to what the service file says now, soon; for a signal's handler."""
        self.path = path
        self._reload.set()

    def run(self, announce: Callable[[], None] = lambda: None) -> None:
        """Run until it is stopped, or all workers have nothing left to do; `announce` is called when all have begun."""
        settings = self.config.store
        store = Store.open(settings.url, self.config.folder, write=True)
        try:
            # of a file the workers inherit the lock: it ends with the last of them. A server locks each asset.
            store.acquire_lock(())
            files = () if store.lock_file is None else (store.lock_file,)
            self._start(files)
            next_look, is_announced = time.monotonic() + STALL_S, False
            while not self._stopping.wait(POLL_INTERVAL_S) and not all(
                worker.supervisor.done for worker in self._workers
            ):
                self.last_turn = time.monotonic()
                notify_systemd("WATCHDOG=1")
                if not is_announced and all(worker.has_begun or worker.supervisor.done for worker in self._workers):
                    is_announced = True
                    announce()
                    notify_systemd("READY=1", self._systemd_status)
                if self.last_turn >= next_look:
                    next_look = self.last_turn + STALL_S / 3.0
                    self._end_hung()
                if self._reload.is_set():
                    self._reload.clear()
                    self._change(files)
            notify_systemd("STOPPING=1")
            for worker in self._workers:
                worker.supervisor.ask_to_stop()  # all at once
            for worker in self._workers:
                worker.supervisor.stop()
        finally:
            store.close()

    @property
    def _systemd_status(self) -> str:
        counts = count_words(len(self.config.assets), "asset"), count_words(len(self._workers), "worker")
        return f"STATUS={', '.join(counts)}"

    def _start(self, files: Sequence[int]) -> None:
        """Start a worker for each shard that has assets and none yet."""
        running = {worker.number for worker in self._workers if not worker.supervisor.done}
        self._workers = [worker for worker in self._workers if worker.number in running]
        restarted, self.restarted = self.restarted, ()  # once
        for number in sorted(self.config.shard_numbers() - running):
            own = {*self.config.shard(number).assets, self.config.shard_name(number)}
            worker = _Follower(self.config, self.path, number, [name for name in restarted if name in own], files)
            self._workers.append(worker)
            worker.supervisor.start()

    def _end_hung(self) -> None:
        """Kill workers that answer, and do nothing else: they are started again."""
        for worker, answer in self._ask_all("/health/live", loads):
            if answer is not None and not answer["ok"]:
                log("error", "worker hangs", worker=worker.number)
                worker.supervisor.send_signal(signal.SIGKILL)

    def _change(self, files: Sequence[int]) -> None:
        """Change to what the service file says now; where that cannot be used, go on as before."""
        notify_systemd("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")
        try:
            config = ServiceFile.load(self.path)
            self.config.check_fixed(config)
            check_service_file(config)
        except ServoscopeError as error:
            log("error", "reload refused", why=str(error))
            notify_systemd("READY=1", f"STATUS=reload refused: {error}")
            return
        self.config = config
        for worker in self._workers:
            worker.reload()
        self._start(files)
        notify_systemd("READY=1", self._systemd_status)
