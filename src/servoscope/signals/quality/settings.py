"""What can be wrong with the data of an asset: limits, from the section `[quality]`, and findings beyond them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, NamedTuple

from pydantic import Field

from servoscope.core.errors import RecordingError
from servoscope.core.messages import Message, message, render
from servoscope.core.settings import Positive, Settings

KINDS = ("waiting", "silent", "frozen_y", "frozen_u", "gap", "jitter", "rate", "clock")
Share = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0, lt=1.0)]

MIN_WINDOW_SAMPLES = 200  # samples of a window: fewer do not tell a rate to 0.1 %


class QualityLimits(NamedTuple):
    """The settings for one sample rate, as the compiled loop takes them."""

    period: float  # s
    window: int  # samples
    gap_s: float  # longest step that is a gap; a longer one is a pause of whoever logs, or silence
    silent_s: float
    frozen: int  # samples
    travel: float  # of y; 0: learned
    jitter: float  # s
    jittery: float  # share
    missing: float  # share
    rate_error: float  # relative


class QualitySettings(Settings):
    """When data are too bad to judge an asset by; every key has a default."""

    # over how long jitter, gaps and sample rate are counted [s]; at least 200 samples are taken
    window_s: Positive = 10.0
    silent_s: Positive = 10.0  # longest time without data, and longest step of the time stamps that is a gap [s]
    frozen_s: Positive = 5.0  # how long y or u may stay exactly the same while the motion demands a change [s]
    # how far r has to move for y to be expected to change, in units of y; None: a tenth of the range that y itself
    # has covered
    frozen_travel: Positive | None = None
    # jitter, jitter_share: A step that is off by more than `jitter` of a sample time jitters; this share of them is
    # too much
    jitter: Share = 0.2
    jitter_share: Share = 0.05
    missing_share: Share = 0.02  # share of samples that may be missing
    rate_error: Share = 0.002  # how far the measured sample rate may be off, relative

    def limits(self, sample_rate: float, pause_s: float = 0.0) -> QualityLimits:
        """Return the constants for a loop's sample rate [Hz]; `pause_s`: how much longer its log may pause [s]."""
        if not sample_rate > 0.0:
            raise RecordingError(f"sample rate {sample_rate!r} must be greater than 0")
        return QualityLimits(
            period=1.0 / sample_rate,
            window=max(MIN_WINDOW_SAMPLES, round(self.window_s * sample_rate)),
            gap_s=self.silent_s,
            silent_s=self.silent_s + pause_s,
            frozen=max(2, round(self.frozen_s * sample_rate)),
            travel=self.frozen_travel or 0.0,
            jitter=self.jitter / sample_rate,
            jittery=self.jitter_share,
            missing=self.missing_share,
            rate_error=self.rate_error,
        )


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
