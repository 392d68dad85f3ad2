"""Blocks of one asset from single values of r, u, y and covariates, each with a time stamp of its own."""

from __future__ import annotations

import math
import time
from datetime import UTC, datetime

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.messages import message, render
from servoscope.service.sources.base import RejectionCounter
from servoscope.service.sources.block import Block, ResumePosition
from servoscope.service.sources.resample import Resampler, SampleGap
from servoscope.service.sources.update_rate import UpdateRate

SIGNALS = ("r", "u", "y")  # what single values are of, in this order


class BlockAssembler:
    """Assembles blocks of `size` samples at a sample `rate` [Hz], behind what was counted before.

    `hold_s`: how long a value holds without a new one [s]; infinite where a source tells each change. `rejections`
    counts what is missing or late. `covariates`: names of further signals, behind r, u and y.
    """

    def __init__(
        self,
        asset: str,
        resume: ResumePosition,
        rejections: RejectionCounter,
        rate: float,
        size: int,
        hold_s: float = math.inf,
        covariates: tuple[str, ...] = (),
    ) -> None:
        self.asset, self.period, self._size = asset, 1.0 / rate, size
        self._sequence, self._rejections = resume.sequence, rejections
        self.resampler = Resampler(len(SIGNALS), 1.0 / rate, resume.last_t, hold_s, len(covariates))
        self.signals = (*SIGNALS, *covariates)
        self._t, self._values = np.zeros(0), np.zeros((len(self.signals), 0))
        self.rates = [UpdateRate() for _ in self.signals]

    def restart_rates(self) -> None:
        """Measure anew how often values come."""
        self.rates = [UpdateRate() for _ in self.signals]

    @property
    def intervals_s(self) -> dict[str, float]:
        """Time between two updates of each signal, as measured [s]; without those of which too few have come."""
        found = {name: rate.interval_s for name, rate in zip(self.signals, self.rates, strict=True)}
        return {name: interval for name, interval in found.items() if not math.isnan(interval)}

    @property
    def slow_ms(self) -> dict[int, float]:
        """Time between two updates of the signals that come too slowly, as measured [ms]; covariates may."""
        return {  # more digits would change with each look
            k: float(f"{1000.0 * one.interval_s:.2g}")
            for k, one in enumerate(self.rates[: len(SIGNALS)])
            if one.is_too_slow(self.period)
        }

    def describe_slow(self, signal: int, interval_ms: float) -> str:
        """Return that a signal comes too slowly."""
        values = {"interval_ms": interval_ms, "needed_ms": 1000.0 * self.period}
        return render(message("service.trouble.slow", signal=SIGNALS[signal], **values))

    def add(self, signal: int, t: float, value: float) -> None:
        """Take a value; NaN where it is known to be bad."""
        self.resampler.add(signal, t, value)

    def collect(self, alive_until: float, settled: float | None = None) -> None:
        """Make the samples that are complete; `alive_until`, `settled`: as in `Resampler.take_samples` [UTC s]."""
        t, values, gaps = self.resampler.take_samples(alive_until, settled)
        for gap in gaps:
            self._rejections.add(self.asset, "gap", describe_gap(gap), gap.samples)
        if late := self.resampler.take_late():
            self._rejections.add(self.asset, "late", "values came after their samples were made", late)
        self._t, self._values = np.append(self._t, t), np.append(self._values, values, axis=1)

    def discard(self, kept: int, kind: str, why: str) -> None:
        """Drop all samples but the newest ones, and count them."""
        lost = max(0, self._t.size - kept)
        if lost:
            self._rejections.add(self.asset, kind, why, lost)
        self._t, self._values = self._t[lost:], self._values[:, lost:]

    def take_blocks(self, *, short: bool = False) -> list[Block]:
        """Return the blocks that are complete; also what is left of samples if they may be `short`."""
        found = []
        while self._t.size >= (1 if short else self._size):
            self._sequence += 1
            signals = np.vstack([self._t[: self._size], self._values[:, : self._size]])
            found.append(Block.from_signals(self.asset, self._sequence, signals, time.monotonic()))
            self._t, self._values = self._t[self._size :], self._values[:, self._size :]
        return found

    @property
    def buffered(self) -> int:
        """How many samples are in no block yet."""
        return self._t.size

    @property
    def waiting_times(self) -> FloatArray:
        """Times of samples and values that are in no block yet, in order, shape (N,) [UTC s]."""
        return np.sort(np.append(self._t, self.resampler.pending_times))


def describe_gap(gap: SampleGap) -> str:
    """Return when a gap was."""
    start, end = (datetime.fromtimestamp(t, UTC).isoformat(timespec="milliseconds") for t in gap[:2])
    return f"{gap.samples} samples between {start} and {end} are missing"
