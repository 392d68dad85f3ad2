"""Time that passes when nobody works: each participant is a greenlet that sleeps until its time has come."""

from __future__ import annotations

import heapq
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

from greenlet import GreenletExit, getcurrent, greenlet

BEGAN = 1767225580.0  # 2025-12-31T23:59:40Z: coefficients are stored in the middle of what is sent

LOCKED_S = 0.001  # after which who waits for a lock looks again


class Killed(BaseException):
    """A process has lost its power; nothing catches it that catches exceptions."""


class Process:
    """What ends together: greenlets, of which the first one is told."""

    def __init__(self, name: str) -> None:
        self.name, self.dead = name, False
        self.greenlets: list[greenlet] = []


class Clock:
    """The time of the world, and what is due in it."""

    def __init__(self) -> None:
        self.now, self.steps = 1000.0, 0
        self.wall = BEGAN - self.now  # what a machine's clock is ahead of `now`; a step of the clock changes it
        self._due: list[tuple[float, int, greenlet, Process | None]] = []
        self._count = 0
        self._hub = getcurrent()
        self._owners: dict[greenlet, Process] = {}

    def monotonic(self) -> float:
        """Return the time that has passed [s]."""
        return self.now

    def time(self) -> float:
        """Return what the machine's clock says (epoch, s)."""
        return self.now + self.wall

    def sleep(self, seconds: float) -> None:
        """Let time pass for who calls."""
        me = getcurrent()
        if me is self._hub:  # nobody else is there yet
            self.now += seconds
            return
        self._push(self.now + max(seconds, 1e-6), me)
        self._hub.switch()

    def spawn(
        self, work: Callable[..., None], *arguments: Any, process: Process | None = None, after: float = 0.0
    ) -> None:
        """Begin something that runs beside all else, as a part of a process."""
        process = process or self.process
        new = greenlet(lambda: self._run(work, *arguments), self._hub)
        if process is not None:
            self._owners[new] = process
            process.greenlets.append(new)
        self._push(self.now + after, new)

    def _run(self, work: Callable[..., None], *arguments: Any) -> None:
        try:
            work(*arguments)
        except Killed:
            pass
        finally:
            self._owners.pop(getcurrent(), None)

    @property
    def process(self) -> Process | None:
        """The process that is running now."""
        return self._owners.get(getcurrent())

    def kill(self, process: Process) -> None:
        """End a process where it is; who calls may be in it."""
        process.dead = True
        me = getcurrent()
        for one in process.greenlets:
            if one is not me and not one.dead:
                self._push(self.now, one)
        if me in process.greenlets:
            raise Killed

    def _push(self, when: float, who: greenlet) -> None:
        self._count += 1
        heapq.heappush(self._due, (when, self._count, who, self._owners.get(who)))

    def step(self) -> bool:
        """Let the next one work; return whether there was one."""
        while self._due:
            when, _, who, process = heapq.heappop(self._due)
            if who.dead:
                continue
            self.now = max(self.now, when)
            self.steps += 1
            if process is not None and process.dead:
                if who:  # it has begun
                    who.throw(Killed)
                continue
            who.switch()
            return True
        return False

    def close(self) -> None:
        """End whatever still waits."""
        for _, _, who, _ in self._due:
            if who and not who.dead:
                who.throw(GreenletExit)
        self._due.clear()


class _Event:
    def __init__(self, clock: Clock) -> None:
        self._clock, self._is_set = clock, False

    def set(self) -> None:
        self._is_set = True

    def is_set(self) -> bool:
        return self._is_set

    def wait(self, timeout: float) -> bool:
        if not self._is_set:
            self._clock.sleep(timeout)
        return self._is_set


class _Lock:
    """Excludes all participants but one; who waits for it lets time pass."""

    def __init__(self, clock: Clock) -> None:
        self._clock, self._is_held = clock, False

    def __enter__(self) -> bool:
        while self._is_held:
            assert self._clock.process is not None, "nobody but a process waits for its lock"
            self._clock.sleep(LOCKED_S)
        self._is_held = True
        return True

    def __exit__(self, *_: object) -> None:
        self._is_held = False


class _Thread:
    def __init__(
        self, clock: Clock, target: Callable[..., None], args: tuple[Any, ...] = (), name: str = "", daemon: bool = True
    ) -> None:
        self._clock, self._work, self._alive = clock, (target, *args), False

    def start(self) -> None:
        self._alive = True
        self._clock.spawn(self._run)

    def _run(self) -> None:
        try:
            self._work[0](*self._work[1:])
        finally:
            self._alive = False

    def is_alive(self) -> bool:
        return self._alive

    def join(self, timeout: float | None = None) -> None:
        pass


@contextmanager
def in_place(*changes: tuple[Any, str, Any]) -> Iterator[None]:
    """Let attributes have other values for a while."""
    before = [(owner, name, getattr(owner, name)) for owner, name, _ in changes]
    for owner, name, value in changes:
        setattr(owner, name, value)
    try:
        yield
    finally:
        for owner, name, value in reversed(before):
            setattr(owner, name, value)


def clock_changes(clock: Clock, sleep: Callable[[float], None]) -> list[tuple[Any, str, Any]]:
    """Return what has to be in place of time, with this `sleep`, and threads in the service's modules."""
    import threading

    times = SimpleNamespace(
        time=clock.time,
        monotonic=clock.monotonic,
        sleep=sleep,
        thread_time=clock.monotonic,
        perf_counter=clock.monotonic,
        monotonic_ns=lambda: int(clock.now * 1e9),
    )
    threads = SimpleNamespace(
        Thread=lambda **given: _Thread(clock, **given), Event=lambda: _Event(clock), Lock=lambda: _Lock(clock)
    )
    own = [module for name, module in sys.modules.items() if name.startswith("servoscope.service")]
    changes = [(module, "time", times) for module in own if getattr(module, "time", None) is time]
    return changes + [
        (module, "threading", threads) for module in own if getattr(module, "threading", None) is threading
    ]
