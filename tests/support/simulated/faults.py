"""What happens to the service, and where: each pair of them is counted, and a seed aims at some that are rare."""

from __future__ import annotations

import hashlib
import random
from collections import Counter
from typing import NamedTuple

# places within the process at which its faults can strike, each before or after the act itself
STATEMENTS = (
    "upsert meta", "insert residuals", "insert diagnoses", "insert transitions", "insert sizes", "insert outbox",
    "insert audit", "upsert checkpoints", "upsert needed", "delete recent", "insert bundles", "update commands",
    "update outbox", "select outbox", "select commands", "select audit", "select meta", "select checkpoints",
    "select bundles", "select needed", "select recent", "select residuals",
)  # fmt: skip
COMMITS = ("commit", "commit read")
ACTS = ("acknowledge", "confirm", "receive", "connect", "sleep", "post", "mail", "replace file", "diagnose")
PAIRS = [
    *(("kill", f"{place}{side}") for place in (*STATEMENTS, *COMMITS, *ACTS) for side in (" before", " after")),
    *(("error", f"{place} before") for place in STATEMENTS),
    *(("lost", f"{place} before") for place in COMMITS),  # it is not made, and an error says so
    *(("unknown", f"{place} after") for place in COMMITS),  # it is made, and an error hides it
    *(("delay", f"{place} before") for place in ("begin", *ACTS)),
    *(("error", f"{place} before") for place in ("post", "mail")),
    *(("hang", f"{place} before") for place in ("post", "mail")),
    *(("unknown", f"{place} after") for place in ("post", "mail")),
    *((fault, "person") for fault in ("kill",)),
    *(("outside", what) for what in (
        "broker restart", "broker forgets", "cable of service", "cable of sender", "sender restart", "sender ahead",
        "sender behind", "clock ahead", "clock back", "store away", "silence", "gap", "leak", "command", "relearn",
        "repeat", "reorder",
    )),
]  # fmt: skip
OUTSIDE = [place for fault, place in PAIRS if fault == "outside"]
WITHIN = [pair for pair in PAIRS if pair[0] != "outside"]


class Armed(NamedTuple):
    """A fault that strikes the n-th time that its place is reached."""

    fault: str
    place: str
    left: int


class Plan:
    """What one seed has in mind: pairs in turn, so that none is rare over many seeds, and some by chance."""

    def __init__(self, seed: int, steps: int) -> None:
        self.chance = random.Random(f"plan {seed}")
        self.reached: Counter[tuple[str, str]] = Counter()
        self.trace: list[str] = []
        self.calm = False
        self._digest = hashlib.blake2b(digest_size=16)
        wanted = [PAIRS[(seed * 7 + k * 31) % len(PAIRS)] for k in range(2)]
        within = [pair for pair in wanted if pair[0] != "outside"]
        within += self.chance.choices(WITHIN, k=self.chance.randrange(2, 7))
        self._armed = [Armed(fault, place, self._patience(place)) for fault, place in within]
        outside = [place for fault, place in wanted if fault == "outside"]
        outside += self.chance.choices(OUTSIDE, k=self.chance.randrange(3, 9))
        self.outside = sorted((self.chance.randrange(20, max(21, int(0.9 * steps))), place) for place in outside)

    def note(self, *what: object) -> None:
        """Add to the digest that something has happened: who steps when, each message, and each statement."""
        self._digest.update(repr(what).encode())

    @property
    def digest(self) -> str:
        """The digest of all that has happened, which a seed repeats in every process."""
        return self._digest.hexdigest()

    def _patience(self, place: str) -> int:
        """Return after how many visits of a place a fault strikes: there are many of some, few of others."""
        return int(
            10.0 ** self.chance.uniform(0.0, 2.0 if place.startswith(("sleep", "commit", "ack", "recei")) else 1.0)
        )

    def strikes(self, place: str) -> str:
        """Return the fault that strikes at a place now; empty: none."""
        if self.calm:
            return ""
        for i, (fault, where, left) in enumerate(self._armed):
            if where == place:
                if left > 1:
                    self._armed[i] = Armed(fault, where, left - 1)
                    continue
                del self._armed[i]
                self.reached[fault, place] += 1
                self.trace.append(f"{fault} at {place}")
                return fault
        return ""
