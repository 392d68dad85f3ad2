"""Times of jobs, taken in turns so that a busy moment of the machine meets all of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

Job = Callable[[], object]


@dataclass(frozen=True)
class Measured:
    """Times of one job [s]: median, and the quartiles around it."""

    median: float
    low: float
    high: float


@dataclass(frozen=True)
class Figure:
    """One line of the table.

    Parameters
    ----------
    name
        What ran.
    ns
        Nanoseconds per sample: median, lower and upper quartile.
    ratio
        Of the median to that of the line that it is compared with, and `to`, the name of that line.
    error
        Largest relative difference between the results of the two, where they follow the same algorithm.
    """

    name: str
    ns: tuple[float, float, float]
    ratio: float | None = None
    to: str = ""
    error: float | None = None


def interleaved(jobs: Mapping[str, Job], repeats: int) -> dict[str, Measured]:
    """Run all jobs once uncounted, then in turns; return their times."""
    for job in jobs.values():
        job()
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(repeats):
        for name, job in jobs.items():
            begin = time.perf_counter()
            job()
            times[name].append(time.perf_counter() - begin)
    found = {}
    for name, each in times.items():
        ranked = sorted(each)
        at = [ranked[round(q * (len(ranked) - 1))] for q in (0.5, 0.25, 0.75)]
        found[name] = Measured(*at)
    return found
