"""What runs in a process of its own: one task, read from stdin, under limits; its answer goes to stdout."""

from __future__ import annotations

import json
import os
import resource
import sys
import traceback

from servoscope.errors import ServoscopeError

__all__ = ["work"]

FILES = 256  # that may be open
NICE = 5  # pages and samples come first


def work() -> None:
    """Carry out the task on stdin and say what comes of it, one JSON object per line."""
    asked = json.loads(sys.stdin.buffer.readline())
    limit(**asked["limits"])
    said = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # whatever prints must not get between the answers

    def tell(**words: object) -> None:
        said.write(json.dumps(words, allow_nan=False) + "\n")
        said.flush()

    try:
        from servoscope.web.tasks import TASKS

        answer = TASKS[asked["task"]](lambda step: tell(step=step), **asked["arguments"])
        tell(answer=answer)
    except ServoscopeError as error:
        tell(problem=str(error))
    except MemoryError:
        tell(problem=f"it needs more than {asked['limits']['memory_mb']:g} MB of memory")
    except Exception as error:  # a damaged file may lead to anything, and must not look like a fault of the server
        traceback.print_exc()
        tell(problem=f"it cannot be used ({type(error).__name__}: {str(error)[:200]})")


def limit(cpu_s: float, memory_mb: float, file_mb: float) -> None:
    """Bound what this process may take; the kernel ends it, or refuses, beyond that."""
    os.nice(NICE)
    for kind, most in (
        (resource.RLIMIT_CPU, round(cpu_s)),
        (resource.RLIMIT_AS, round(memory_mb * 1e6)),
        (resource.RLIMIT_FSIZE, round(file_mb * 1e6)),
        (resource.RLIMIT_NOFILE, FILES),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(kind)[1]
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        # a second more before the kernel kills what ignores its first signal
        resource.setrlimit(kind, (most, most + 1 if kind == resource.RLIMIT_CPU and hard != most else most))
