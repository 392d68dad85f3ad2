"""What can be wrong with the data of an asset, and what that leaves of a verdict."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

__all__ = ["KINDS", "Finding", "judged", "told"]

KINDS = ("waiting", "silent", "frozen_y", "frozen_u", "gap", "jitter", "rate", "clock")

WORDS = {
    "waiting": "nothing known yet: the first window of data is not complete",
    "silent": "no data for {value:.3g} s, {limit:.3g} s are allowed",
    "frozen_y": "y has stayed the same for {limit:.3g} s, with r moving by {value:.3g}: sensor or axis is stuck",
    "frozen_u": "u has stayed the same for {limit:.3g} s, with r - y moving by {value:.3g}: its logging is stuck",
    "gap": "{value:.2%} of the samples missing, {limit:.2%} are allowed",
    "jitter": "{value:.2%} of the time steps jitter, {limit:.2%} are allowed",
    "rate": "the time stamps say a sample rate off by {value:+.3%}, {limit:.3%} are allowed",
    "clock": "the time stamps jump by {value:+.6g} s: the clock was set, or the log was cut",
}

SHORT = {
    "waiting": "the first window of data is not complete",
    "silent": "no data come",
    "frozen_y": "y stays the same, sensor or axis is stuck",
    "frozen_u": "u stays the same, its logging is stuck",
    "gap": "samples are missing",
    "jitter": "the time steps jitter",
    "rate": "the time stamps say another sample rate",
    "clock": "the time stamps jump",
}


class Finding(NamedTuple):
    """The beginning or the end of something wrong with the data.

    Parameters
    ----------
    kind
        One of `KINDS`.
    begins
        Whether it begins.
    time
        When (epoch, s): by the time stamps of the data; of silence by the clock of the service.
    value, limit
        What was measured, and what is allowed.
    """

    kind: str
    begins: bool
    time: float
    value: float
    limit: float

    @property
    def message(self) -> str:
        """One line for the user."""
        if not self.begins:
            return f"over: {self.kind}"
        if self.kind == "frozen_y" and self.value == 0.0:
            return f"y has stayed the same for {self.limit:.3g} s, and it is noisy at rest: sensor or logging is stuck"
        return WORDS[self.kind].format(value=self.value, limit=self.limit)


def judged(verdict: str, standing: Iterable[str]) -> str:
    """Return what is left of a monitor's verdict under what is wrong with the data.

    Nothing is healthy on bad data. A fault stays one where samples are missing, which a monitor waits out; any other
    finding could have made it.
    """
    kinds = set(standing)
    return verdict if not kinds or (verdict == "fault" and kinds == {"gap"}) else "undetermined"


def told(standing: Iterable[str]) -> str:
    """Return what is wrong with the data, in a few words."""
    return ", ".join(SHORT[kind] for kind in standing) or "the data are sound"
