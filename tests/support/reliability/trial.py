"""One trial: the service as a process of its own, disturbed at random moments, measured from outside."""

from __future__ import annotations

import itertools
import math
import os
import random
import re
import resource
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass, field
from http.client import HTTPException
from pathlib import Path

import numpy as np

BUCKET = re.compile(r'servoscope_latency_seconds_bucket\{le="([^"]+)"\} (\S+)')
COUNTED = re.compile(r"servoscope_blocks_total\{[^}]*\} (\S+)")
UP = re.compile(r"servoscope_store_up (\S+)")
LONGEST_RECOVERY_S = 120.0
LONGEST_NOTICE_S = 60.0
CALM_S = 5.0  # after a disturbance is over


@dataclass
class Disturbance:
    """Something that happens to the service: it begins, lasts, and is over.

    Parameters
    ----------
    name
        For the table.
    begin, end
        What to do.
    lasts_s
        How long it lasts, from when the service noticed it.
    kills
        Whether the process is gone by it and has to be started again.
    """

    name: str
    begin: Callable[[], None]
    end: Callable[[], None]
    lasts_s: float
    kills: bool = False


class Latencies:
    """Latencies of blocks, from the histogram that a service shows, apart for times when it is disturbed and not."""

    def __init__(self) -> None:
        self.calm: dict[float, float] = {}  # upper end of the bucket -> blocks
        self.disturbed: dict[float, float] = {}
        self._seen: dict[float, float] = {}

    def restart(self) -> None:
        """Forget what the last process counted."""
        self._seen = {}

    @property
    def seen(self) -> float:
        """Blocks that this process has counted."""
        return sum(self._seen.values())

    def look(self, text: str, *, calm: bool) -> None:
        """Take what came since the last time from the text of the metrics."""
        ends = {float(end): float(count) for end, count in BUCKET.findall(text)}
        within = dict(zip(ends, np.diff([0.0, *ends.values()]).tolist(), strict=True))
        to = self.calm if calm else self.disturbed
        for end, count in within.items():
            to[end] = to.get(end, 0.0) + max(0.0, count - self._seen.get(end, 0.0))
        self._seen = within


@dataclass
class Measured:
    """What was seen from outside."""

    recoveries: dict[str, list[float]] = field(default_factory=dict)
    latencies: Latencies = field(default_factory=Latencies)
    memory: list[tuple[float, float]] = field(default_factory=list)  # of the last life: s since its start, MB
    lives: int = 0
    seconds: float = 0.0


class Trial:
    """Runs a service file to its end.

    Parameters
    ----------
    config
        The service file.
    port
        Where it answers.
    disturbances
        They happen in turns, at moments by chance.
    every_s
        Mean time between them; there are none in the last part.
    calm_share
        Share of the blocks at the end that are left in peace: memory is measured there.
    blocks
        How many there are in all.
    seed
        Of the chance.
    """

    def __init__(
        self,
        config: Path,
        port: int,
        disturbances: list[Disturbance],
        every_s: float,
        calm_share: float,
        blocks: int,
        seed: int,
    ) -> None:
        self._config, self._port = config, port
        self._disturbances, self._every, self._chance = disturbances, every_s, random.Random(seed)
        self._blocks, self._calm = blocks, (1.0 - calm_share) * blocks
        self._log = config.with_suffix(".log").open("ab")
        self._up = True
        self.measured = Measured()

    def run(self) -> Measured:
        """Run; the service ends by itself when its recordings have ended."""
        begun = time.monotonic()
        self._start()
        try:
            self._follow(begun)
        finally:
            self._process.kill()
            self._process.wait()
            self._log.close()
        self.measured.seconds = time.monotonic() - begun
        return self.measured

    def _follow(self, begun: float) -> None:
        """Look at it, and disturb it, until it has ended."""
        quiet_from, due, turns = begun + CALM_S, begun + self._wait(), itertools.cycle(self._disturbances)
        while self._alive():
            time.sleep(0.25)
            now = time.monotonic()
            counted = self._look(calm=now > quiet_from)
            if self._disturbances and now > due and 0.0 < counted < self._calm:
                self._disturb(next(turns))
                quiet_from, due = time.monotonic() + CALM_S, time.monotonic() + self._wait()

    def _wait(self) -> float:
        return self._chance.uniform(0.5, 1.5) * self._every

    def _start(self) -> None:
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
        words = [sys.executable, "-m", "servoscope", "run", str(self._config)]
        self._process = subprocess.Popen(words, stderr=self._log, env=environment)
        self._started = time.monotonic()
        self.measured.latencies.restart()
        self.measured.memory = []
        self.measured.lives += 1

    def _alive(self) -> bool:
        code = self._process.poll()
        if code:
            raise RuntimeError(f"the service ended with {code}, see {self._log.name}")
        return code is None

    def _disturb(self, what: Disturbance) -> None:
        """Let it happen, and time how long until results are stored again."""
        self._look(calm=True)
        what.begin()
        if what.kills:
            self._process.send_signal(signal.SIGKILL)
            self._process.wait()
        noticed = time.monotonic() + LONGEST_NOTICE_S
        while not what.kills and self._up and time.monotonic() < noticed:
            time.sleep(0.1)
            self._look(calm=False)
        if not what.kills and self._up:
            raise RuntimeError(f"{what.name}: not noticed within {LONGEST_NOTICE_S:g} s")
        time.sleep(what.lasts_s)
        self._look(calm=False)
        before = self.measured.latencies.seen
        what.end()
        ended = time.monotonic()
        if what.kills:
            self._start()
            before = 0.0
        while self._alive() and self.measured.latencies.seen <= before:
            if time.monotonic() - ended > LONGEST_RECOVERY_S:
                raise RuntimeError(f"{what.name}: no recovery within {LONGEST_RECOVERY_S:g} s")
            time.sleep(0.05)
            self._look(calm=False)
        self.measured.recoveries.setdefault(what.name, []).append(time.monotonic() - ended)

    def _look(self, *, calm: bool) -> float:
        """Read metrics and memory; return how many blocks were counted, 0 where nobody answers."""
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self._port}/metrics", timeout=5.0) as answer:
                text = answer.read().decode()
            pages = Path(f"/proc/{self._process.pid}/statm").read_text().split()[1]
        except (OSError, ValueError, HTTPException):
            return 0.0
        self.measured.memory.append((time.monotonic() - self._started, int(pages) * resource.getpagesize() / 2**20))
        self._up = UP.findall(text) == ["1.0"]
        self.measured.latencies.look(text, calm=calm)
        return sum(float(count) for count in COUNTED.findall(text))


def quantile(buckets: dict[float, float], share: float) -> float:
    """Return a quantile from a histogram, interpolated within its bucket [s]; NaN where there is nothing."""
    ends = sorted(buckets)
    total = np.cumsum([buckets[end] for end in ends])
    if not ends or not total[-1] > 0.0:
        return math.nan
    k = int(np.searchsorted(total, share * total[-1]))
    low, below = (ends[k - 1], float(total[k - 1])) if k else (0.0, 0.0)
    if math.isinf(ends[k]):
        return math.inf
    return low + (ends[k] - low) * (share * float(total[-1]) - below) / (float(total[k]) - below)
