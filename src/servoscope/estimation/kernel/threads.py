"""Threads that blocks of many assets share."""

from __future__ import annotations

import functools
import os
from concurrent.futures import ThreadPoolExecutor


def core_count() -> int:
    """Return the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.cache
def thread_pool(workers: int) -> ThreadPoolExecutor:
    """Return threads that stay alive: starting them takes as long as ten thousand samples."""
    return ThreadPoolExecutor(workers, "servoscope")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=thread_pool.cache_clear)  # its threads did not come along
