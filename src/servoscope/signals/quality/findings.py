"""What can be wrong with the data of an asset, and what that leaves of a verdict."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from servoscope.core.messages import Message, message, render

KINDS = ("waiting", "silent", "frozen_y", "frozen_u", "gap", "jitter", "rate", "clock")


class QualityFinding(NamedTuple):
    """The beginning or the end of something wrong with the data."""

    kind: str  # one of `KINDS`
    begins: bool  # whether it begins
    time: float  # when (epoch, s): by the time stamps of the data; of silence by the clock of the service
    value: float  # value, limit: what was measured, and what is allowed
    limit: float

    @property
    def text(self) -> Message:
        """What it says."""
        if not self.begins:
            return message("quality.over", kind=self.kind)
        at_rest = self.kind == "frozen_y" and self.value == 0.0
        kind = "frozen_y_at_rest" if at_rest else self.kind
        return message(f"quality.{kind}", value=self.value, limit=self.limit)

    @property
    def message(self) -> str:
        """One line for the user."""
        return render(self.text)


def limit_verdict(verdict: str, active: Iterable[str]) -> str:
    """Return what is left of a monitor's verdict, given the findings that are active.

    Nothing is healthy on bad data. A fault stays one where samples are missing, which a monitor waits out; any other
    finding could have made it.
    """
    kinds = set(active)
    return verdict if not kinds or (verdict == "fault" and kinds == {"gap"}) else "undetermined"


def describe_findings(active: Iterable[str]) -> str:
    """Return what is wrong with the data, in a few words."""
    return ", ".join(render(message(f"quality.short.{kind}")) for kind in active) or render(message("quality.sound"))
