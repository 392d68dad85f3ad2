"""Who is logged in, and how often a login may be tried: in memory, so that everybody logs in again after a restart."""

from __future__ import annotations

import hashlib
import secrets
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass

MAX_ENTRIES = 10_000  # sessions, and addresses that have failed: what is remembered is bounded
PENDING_S = 1.0  # s: within which attempts that are being checked have ended


@dataclass(frozen=True)
class Session:
    """One login."""

    user: str
    stamp: str  # of the user's password
    csrf: str  # what a request that changes something must repeat: a foreign page cannot know it
    expires: float  # by the monotonic clock [s]: one that is set must neither end nor prolong it


class Sessions:
    """Logins by their secret, of which only a digest is kept; each lasts `lasts_s`."""

    def __init__(self, lasts_s: float) -> None:
        self._lasts = lasts_s
        self._of: dict[str, Session] = {}

    def begin(self, user: str, stamp: str, now: float) -> tuple[str, Session]:
        """Return the secret of a new session, and the session; `now` is by the monotonic clock [s]."""
        self._of = {key: session for key, session in self._of.items() if session.expires > now}
        while len(self._of) >= MAX_ENTRIES:
            del self._of[next(iter(self._of))]
        secret = secrets.token_urlsafe(32)
        session = Session(user, stamp, secrets.token_urlsafe(32), now + self._lasts)
        self._of[_digest(secret)] = session
        return secret, session

    def find(self, secret: str | None, now: float) -> Session | None:
        """Return a session that is still good."""
        session = self._of.get(_digest(secret)) if secret else None
        return session if session is not None and session.expires > now else None

    def end(self, secret: str | None) -> None:
        """Delete a session."""
        if secret:
            self._of.pop(_digest(secret), None)


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode("utf-8", errors="replace")).hexdigest()


class LoginThrottle:
    """Counts attempts per key; after `most` failures within `within_s` [s] the next attempt has to wait.

    An attempt is counted while it is checked, so that attempts at the same time do not pass the limit together.
    """

    def __init__(self, most: int = 5, within_s: float = 60.0) -> None:
        self._most, self._within = most, within_s
        self._failed: dict[str, deque[float]] = {}
        self._pending: Counter[str] = Counter()

    def wait(self, key: str, now: float) -> float:
        """Return how long a key has to wait until it may try again [s]."""
        failed = self._failed.get(key, deque())
        while failed and failed[0] <= now - self._within:
            failed.popleft()
        if not failed:
            self._failed.pop(key, None)
        if len(failed) >= self._most:
            return failed[0] + self._within - now
        return PENDING_S if len(failed) + self._pending[key] >= self._most else 0.0

    def reserve(self, keys: Sequence[str], now: float) -> float:
        """Count an attempt of all keys, to be followed by `settle`; if one has to wait, only return how long [s]."""
        wait = max(self.wait(key, now) for key in keys)
        if wait == 0.0:
            self._pending.update(keys)
        return wait

    def settle(self, keys: Sequence[str], now: float, *, failed: bool) -> None:
        """Replace the attempt by a failure, or by nothing."""
        self._pending -= Counter(keys)  # which forgets keys that have none
        for key in keys if failed else ():
            while key not in self._failed and len(self._failed) >= MAX_ENTRIES:
                del self._failed[next(iter(self._failed))]
            self._failed.setdefault(key, deque(maxlen=self._most)).append(now)
