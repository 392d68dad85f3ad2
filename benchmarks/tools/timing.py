"""Times of jobs, taken in turns so that a busy moment of the machine meets all of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class JobTiming:
    """Times of one job [s]: median, and the quartiles around it; `processor`, the median of what all cores spent."""

    median: float
    low: float
    high: float
    processor: float


def time_interleaved(jobs: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, JobTiming]:
    """Run all jobs once uncounted, then in turns, so that a busy moment meets all of them; return their times."""
    for job in jobs.values():
        job()
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in jobs}
    for _ in range(repeats):
        for name, job in jobs.items():
            begin, spent = time.perf_counter(), time.process_time()
            job()
            times[name].append((time.perf_counter() - begin, time.process_time() - spent))
    timings = {}
    for name, pairs in times.items():
        walls, processor = (sorted(column) for column in zip(*pairs, strict=True))
        median, low, high = (walls[round(q * (repeats - 1))] for q in (0.5, 0.25, 0.75))
        timings[name] = JobTiming(median, low, high, processor[repeats // 2])
    return timings
