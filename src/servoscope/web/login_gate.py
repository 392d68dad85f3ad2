"""Lets attempts to log in through to the hash: few of each address and name, few at a time, and a queue with an end."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager

from starlette.exceptions import HTTPException

from servoscope.service.access import LoginThrottle

SLOTS = 2  # argon2 takes 64 MB and a processor each time
MAX_WAITING = 32  # attempts: some seconds of hashes


class LoginAttempt:
    """One attempt, which counts as a failure if `failed` is set."""

    failed = False


class LoginGate:
    """The attempts of one server."""

    def __init__(self) -> None:
        self._throttle, self._slots = LoginThrottle(), asyncio.Semaphore(SLOTS)
        self._waiting = 0

    @asynccontextmanager
    async def enter(self, keys: Sequence[str]) -> AsyncIterator[LoginAttempt]:
        """Count an attempt of these keys, wait for a slot, and hold it.

        Raises HTTPException if a key has failed too often, or too many attempts wait.
        """
        # a clock that is set back would make everybody wait
        if (wait := self._throttle.reserve(keys, time.monotonic())) > 0.0:
            raise HTTPException(429, "too many failed logins, wait a minute", {"Retry-After": str(int(wait) + 1)})
        attempt = LoginAttempt()
        try:
            if self._waiting >= MAX_WAITING:
                raise HTTPException(503, "too many log in at once, try again", {"Retry-After": "2"})
            self._waiting += 1
            try:
                await self._slots.acquire()
            finally:
                self._waiting -= 1
            try:
                yield attempt
            finally:
                self._slots.release()
        finally:
            self._throttle.settle(keys, time.monotonic(), failed=attempt.failed)
