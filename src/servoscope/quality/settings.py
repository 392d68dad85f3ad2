"""What data have to be like, from the section `[quality]`: allowed silence, standstill, jitter, gaps and drift."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from pydantic import Field

from servoscope.errors import RecordingError
from servoscope.settings import Positive, Settings

__all__ = ["Limits", "QualitySettings"]

Share = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0, lt=1.0)]

FEWEST = 200  # samples of a window: fewer do not tell a rate to 0.1 %


class Limits(NamedTuple):
    """The settings for one sample rate, as the compiled loop takes them."""

    period: float  # s
    window: int  # samples
    silent_s: float
    frozen: int  # samples
    travel: float  # of y; 0: learned
    jitter: float  # s
    jittery: float  # share
    missing: float  # share
    rate_error: float  # relative


class QualitySettings(Settings):
    """When data are too bad to judge an asset by; every key has a default.

    Parameters
    ----------
    window_s
        Over how long jitter, gaps and sample rate are counted [s]; at least 200 samples are taken.
    silent_s
        Longest time without data, and longest step of the time stamps that is a gap [s].
    frozen_s
        How long y or u may stay exactly the same while the motion demands a change [s].
    frozen_travel
        How far r has to move for y to be expected to change, in units of y; None: a tenth of the range that y itself
        has covered.
    jitter, jitter_share
        A step that is off by more than `jitter` of a sample time jitters; this share of them is too much.
    missing_share
        Share of samples that may be missing.
    rate_error
        How far the measured sample rate may be off, relative.
    """

    window_s: Positive = 10.0
    silent_s: Positive = 10.0
    frozen_s: Positive = 5.0
    frozen_travel: Positive | None = None
    jitter: Share = 0.2
    jitter_share: Share = 0.05
    missing_share: Share = 0.02
    rate_error: Share = 0.002

    def limits(self, sample_rate: float) -> Limits:
        """Return the constants for a loop's sample rate [Hz]."""
        if not sample_rate > 0.0:
            raise RecordingError(f"sample rate {sample_rate!r} must be greater than 0")
        return Limits(
            period=1.0 / sample_rate,
            window=max(FEWEST, round(self.window_s * sample_rate)),
            silent_s=self.silent_s,
            frozen=max(2, round(self.frozen_s * sample_rate)),
            travel=self.frozen_travel or 0.0,
            jitter=self.jitter / sample_rate,
            jittery=self.jitter_share,
            missing=self.missing_share,
            rate_error=self.rate_error,
        )
