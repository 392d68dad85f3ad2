"""How an asset's samples come in: whether it is heard at all, too slowly, or only with what cannot be used, and why."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from servoscope.core.messages import message, render
from servoscope.core.texts import clean_text

ReceptionState = Literal["followed", "unheard", "silent", "slow", "refused"]
STATES: tuple[ReceptionState, ...] = get_args(ReceptionState)
ALARMED_STATES: tuple[ReceptionState, ...] = ("unheard", "slow", "refused")  # silence is a finding of data quality
MAX_TURN_S = 5.0  # between two polls: after a longer time the service was stopped


@dataclass(frozen=True)
class Reception:
    """The reception of one asset; what a source says of one that it cannot follow, though it is connected."""

    state: ReceptionState
    why: str = ""  # in words; empty where it is followed
    source_down: bool = False  # whether the trouble is that of the source, which has an alarm of its own

    def __post_init__(self) -> None:
        """Take words from outside as stores and publishers do."""
        object.__setattr__(self, "why", clean_text(self.why))

    @property
    def sentence(self) -> str:
        """What it leaves of a verdict, as a sentence; empty where the asset is followed."""
        return "" if self.state == "followed" else render(message("service.reception.sentence", why=self.why))


RECEPTION_OK = Reception("followed")
UNHEARD_RECEPTION = Reception("unheard", render(message("service.reception.unheard")))


class ReceptionClock:
    """Counts the time in which a silence is that of an asset: the service has polled what came, and had room for it.

    Of one step of it at most `MAX_TURN_S` count, and half of the patience: a process that was suspended has not read
    its connections yet.
    """

    def __init__(self, now: float) -> None:
        self.seconds, self._counted_at = 0.0, now

    def advance(self, now: float, silent_s: float, *, is_free: bool) -> None:
        """Count until now, by the monotonic clock [s]; `silent_s`: the patience; `is_free`: whether there was room."""
        if is_free:
            self.seconds += min(now - self._counted_at, MAX_TURN_S, 0.5 * silent_s)
        self._counted_at = now


class ReceptionLog:
    """When an asset was heard, and when something of it was refused, by a clock that only runs while we listen [s]."""

    def __init__(self, *, heard_before: bool, now: float = 0.0) -> None:
        self._heard = heard_before
        self._heard_at, self._refusal = now, (-float("inf"), "")

    def hear(self, now: float) -> None:
        """Note a block that could be used."""
        self._heard, self._heard_at = True, now

    def refuse(self, now: float, why: str) -> None:
        """Note something that could not be used."""
        self._refusal = now, why

    def is_fresh(self, now: float, within_s: float) -> bool:
        """Return whether something could be used less than so long ago [s]."""
        return self._heard and now - self._heard_at < within_s

    def silence_s(self, now: float) -> float:
        """Return how long nothing could be used [s]."""
        return now - self._heard_at

    def evaluate(self, now: float, patience_s: float, source_trouble: str, trouble: Reception | None) -> Reception:
        """Return the reception.

        `patience_s`: how long a pause may be [s]; `source_trouble`, `trouble`: what the source says of itself and of
        the asset, if anything.
        """
        refused_at, refusal = self._refusal
        if source_trouble and not (self._heard and self.silence_s(now) <= patience_s):
            return Reception("silent" if self._heard else "unheard", source_trouble, source_down=True)
        if trouble is not None:
            return trouble
        if self._heard and self.silence_s(now) <= patience_s:
            return RECEPTION_OK
        if now - refused_at <= patience_s:
            return Reception("refused", refusal)
        state: ReceptionState = "silent" if self._heard else "unheard"
        why = message(f"service.reception.{state}")
        if refused_at > (self._heard_at if self._heard else -float("inf")):  # that is why
            why = message("service.reception.strange", why=render(why), reason=refusal)
        return Reception(state, render(why))
