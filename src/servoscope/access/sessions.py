"""Who is logged in, and how often somebody may try: in memory, so that a restart asks everybody again."""

from __future__ import annotations

import hashlib
import secrets
from collections import deque
from dataclasses import dataclass

__all__ = ["Attempts", "Session", "Sessions"]

MOST = 10_000  # sessions, and addresses that have failed: what is remembered is bounded


@dataclass(frozen=True)
class Session:
    """One login.

    Parameters
    ----------
    user
        Who.
    stamp
        Of the user's password.
    csrf
        What a request that changes something must repeat: a foreign page cannot know it.
    expires
        By the clock of the machine [UTC s].
    """

    user: str
    stamp: str
    csrf: str
    expires: float


class Sessions:
    """Logins by their secret, of which only a digest is kept.

    Parameters
    ----------
    lasts_s
        How long a login lasts [s].
    """

    def __init__(self, lasts_s: float) -> None:
        self._lasts = lasts_s
        self._of: dict[str, Session] = {}

    def begin(self, user: str, stamp: str, now: float) -> tuple[str, Session]:
        """Return the secret of a new session, and the session."""
        self._of = {key: one for key, one in self._of.items() if one.expires > now}
        while len(self._of) >= MOST:
            del self._of[next(iter(self._of))]
        secret = secrets.token_urlsafe(32)
        session = Session(user, stamp, secrets.token_urlsafe(32), now + self._lasts)
        self._of[_digest(secret)] = session
        return secret, session

    def find(self, secret: str | None, now: float) -> Session | None:
        """Return a session that is still good."""
        found = self._of.get(_digest(secret)) if secret else None
        return found if found is not None and found.expires > now else None

    def end(self, secret: str | None) -> None:
        """Forget a session."""
        if secret:
            self._of.pop(_digest(secret), None)


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode("utf-8", errors="replace")).hexdigest()


class Attempts:
    """Counts failures per key, and says how long to wait after too many.

    Parameters
    ----------
    most, within_s
        So many failures are free within that time [s].
    """

    def __init__(self, most: int = 5, within_s: float = 60.0) -> None:
        self._most, self._within = most, within_s
        self._failed: dict[str, deque[float]] = {}

    def wait(self, key: str, now: float) -> float:
        """Return how long a key has to wait until it may try again [s]."""
        failed = self._failed.get(key)
        while failed and failed[0] <= now - self._within:
            failed.popleft()
        if not failed:
            self._failed.pop(key, None)
            return 0.0
        return failed[0] + self._within - now if len(failed) >= self._most else 0.0

    def fail(self, key: str, now: float) -> None:
        """Count a failure."""
        while key not in self._failed and len(self._failed) >= MOST:
            del self._failed[next(iter(self._failed))]
        self._failed.setdefault(key, deque(maxlen=self._most)).append(now)
