"""Times of jobs, taken in turns so that a busy moment of the machine meets all of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

BenchmarkJob = Callable[[], object]


@dataclass(frozen=True)
class JobTiming:
    """Times of one job [s]: median, and the quartiles around it; `processor`, the median of what all cores spent."""

    median: float
    low: float
    high: float
    processor: float


@dataclass(frozen=True)
class BenchmarkRow:
    """One line of the table."""

    name: str
    ns: tuple[float, float, float]  # nanoseconds per sample: median, lower and upper quartile
    # nanoseconds of processor time per sample, which other work on the machine does not lengthen much; median
    processor: float
    # of the processor time to that of the line that it is compared with, and `to`, the name of that line
    ratio: float | None = None
    to: str = ""
    # largest relative difference between the results of the two, where they follow the same algorithm
    error: float | None = None


def time_interleaved(jobs: Mapping[str, BenchmarkJob], repeats: int) -> dict[str, JobTiming]:
    """Run all jobs once uncounted, then in turns; return their times."""
    for job in jobs.values():
        job()
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in jobs}
    for _ in range(repeats):
        for name, job in jobs.items():
            begin, spent = time.perf_counter(), time.process_time()
            job()
            times[name].append((time.perf_counter() - begin, time.process_time() - spent))
    found = {}
    for name, each in times.items():
        walls, processor = (sorted(column) for column in zip(*each, strict=True))
        median, low, high = (walls[round(q * (repeats - 1))] for q in (0.5, 0.25, 0.75))
        found[name] = JobTiming(median, low, high, processor[repeats // 2])
    return found
