"""Blocks of one asset from single values of r, u, y and covariates, each with a time stamp of its own."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.messages import message, render
from servoscope.service.assets.reception import Reception
from servoscope.service.sources.block import Block, ResumePosition
from servoscope.service.sources.message import RejectionCounter, SignalValue
from servoscope.service.sources.resample import Resampler, SampleGap

SIGNALS = ("r", "u", "y")  # what single values are of, in this order
MAX_KNOWN_MESSAGES = 1000  # messages of an asset by which one that comes again is known
MAX_VALUES = 100_000  # of a signal, between two looks at what is complete
SETTLED_PERIOD_SHARE = 0.75  # of a period: behind a row with all signals nothing of its moment comes
LAG_S = 2.0  # how far a signal may be behind others, which come in messages of their own, by time stamps
STEPS = 60  # updates from which an interval is measured
FAST_SHARE = 0.1  # of the steps: as short as these a signal's updates may follow each other
MIN_STEPS = 10  # steps that tell whether a server's word holds
FASTER_SHARE = 0.75  # of the interval that a server has stated: steps as short as that are faster
MAX_PERIODS = 1.5  # sample times: a longer interval leaves out samples
ONE_STEP = 1.5  # times the smallest change: a signal that never changes by more is slow itself, and not its updates


class UpdateRate:
    """Measures the updates of one signal over the last `STEPS` of them, by the time stamps of their source."""

    def __init__(self) -> None:
        self._t, self._values = deque[float](maxlen=STEPS + 1), deque[float](maxlen=STEPS + 1)

    def add(self, t: float, value: float) -> None:
        """Take a value with its time [UTC s]."""
        if math.isfinite(value) and not (self._t and t <= self._t[-1]):
            self._t.append(t)
            self._values.append(value)

    @property
    def interval_s(self) -> float:
        """Time between two updates where they follow each other closely [s]; NaN: too few have come."""
        if len(self._t) <= STEPS:
            return math.nan
        return float(np.quantile(np.diff(self._t), FAST_SHARE))

    def contradicts(self, interval_s: float) -> bool | None:
        """Whether values come faster than a server says it looks for them [s]; None: too few have come to tell.

        Some servers do not look, but are told of each change, and say the time between their messages instead.
        """
        steps = np.diff(self._t)
        return None if steps.size < MIN_STEPS else bool(np.median(steps) < FASTER_SHARE * interval_s)

    def is_too_slow(self, period: float) -> bool:
        """Whether samples of a signal that changes in between are left out; `period`: the sample time [s].

        A coarse signal that creeps is told rarely too; but it changes by one step of its sensor at a time.
        """
        if not self.interval_s > MAX_PERIODS * period:
            return False
        changes = np.abs(np.diff(self._values))
        changes = changes[changes > 0.0]
        return bool(changes.size and changes.max() > ONE_STEP * changes.min())


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
        intervals = {name: rate.interval_s for name, rate in zip(self.signals, self.rates, strict=True)}
        return {name: interval for name, interval in intervals.items() if not math.isnan(interval)}

    @property
    def slow_ms(self) -> dict[int, float]:
        """Time between two updates of the signals that come too slowly, as measured [ms]; covariates may."""
        return {  # more digits would change with each look
            k: float(f"{1000.0 * rate.interval_s:.2g}")
            for k, rate in enumerate(self.rates[: len(SIGNALS)])
            if rate.is_too_slow(self.period)
        }

    def describe_slow(self, signal: int, interval_ms: float) -> str:
        """Return that a signal comes too slowly."""
        values = {"interval_ms": interval_ms, "needed_ms": 1000.0 * self.period}
        return render(message("service.trouble.slow", signal=SIGNALS[signal], **values))

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
        blocks = []
        while self._t.size >= (1 if short else self._size):
            self._sequence += 1
            signals = np.vstack([self._t[: self._size], self._values[:, : self._size]])
            blocks.append(Block.from_signals(self.asset, self._sequence, signals, time.monotonic()))
            self._t, self._values = self._t[self._size :], self._values[:, self._size :]
        return blocks


def describe_gap(gap: SampleGap) -> str:
    """Return when a gap was."""
    start, end = (datetime.fromtimestamp(t, UTC).isoformat(timespec="milliseconds") for t in gap[:2])
    return f"{gap.samples} samples between {start} and {end} are missing"


class Receipt:
    """A message that came: `release` calls `acknowledge` when all that hold it have released it."""

    __slots__ = ("_acknowledge", "holders")

    def __init__(self, acknowledge: Callable[[], None]) -> None:
        self._acknowledge, self.holders = acknowledge, 1

    def release(self) -> None:
        """Release it for one of its holders, or for whom it was made by."""
        self.holders -= 1
        if not self.holders:
            self._acknowledge()


class _OpenMessage(NamedTuple):
    """The times of an asset's values in a message [UTC s]: until none of them waits, some are in no block."""

    first: float
    last: float
    receipt: Receipt

    def waits(self, times: FloatArray) -> bool:
        at = int(np.searchsorted(times, self.first))
        return at < times.size and times[at] <= self.last


class AssetStream(BlockAssembler):
    """What has come of one asset in messages, and is in no block; `known`: covariates of the messages, in order.

    `block_s`: length of a block [s]; the asset wants some of the covariates, in its own order.
    """

    def __init__(
        self,
        asset: str,
        resume: ResumePosition,
        rejections: RejectionCounter,
        rate: float,
        block_s: float,
        hold_s: float,
        known: Sequence[str],
        covariates: tuple[str, ...],
    ) -> None:
        size = max(1, round(block_s * rate))
        super().__init__(asset, resume, rejections, rate, size, hold_s, covariates)
        self._span_s = (size - 0.5) / rate
        self._places = [self.signals.index(signal) if signal in self.signals else -1 for signal in (*SIGNALS, *known)]
        self.open = deque[_OpenMessage]()
        self._seen: dict[int, None] = {}
        self.trouble: Reception | None = None
        # heard_at: when r, u or y came last, by the monotonic clock [s]
        self.heard_at, self._values_taken, self._from = time.monotonic(), 0, math.nan
        self._complete, self.is_flushed = False, True
        self.restart()

    def restart(self) -> None:
        """Begin anew: what signals were before is unknown."""
        self.resampler.restart(math.nan)
        self._newest = [-math.inf] * len(SIGNALS)

    def knows(self, mark: int) -> bool:
        """Return whether a message of this mark was among the last ones; remember it."""
        known = mark in self._seen
        self._seen[mark] = None
        if len(self._seen) > MAX_KNOWN_MESSAGES:
            del self._seen[next(iter(self._seen))]
        return known

    def hold(self, values: Sequence[SignalValue], receipt: Receipt) -> None:
        """Hold a message until its values are in a block."""
        times = [value.t for value in values]
        receipt.holders += 1
        self.open.append(_OpenMessage(min(times), max(times), receipt))

    def take(self, values: Sequence[SignalValue], complete: bool) -> bool:
        """Take values, of which each moment has all signals if they are `complete`; return whether a block may be."""
        newest, sampled = self._newest, False
        for signal, t, value in values:
            place = self._places[signal]
            if place < 0:
                continue
            self.resampler.add(place, t, value)
            self.rates[place].add(t, value)
            if place < len(SIGNALS):
                newest[place], sampled = max(newest[place], t), True
        self._values_taken, self.is_flushed = self._values_taken + len(values), False
        if sampled:
            self._complete, self.heard_at = complete, time.monotonic()
            if self.trouble is not None and self.trouble.state == "silent":
                self.trouble = None
        if math.isnan(self._from):
            self._from = values[0].t
        return abs(values[-1].t - self._from) >= self._span_s or self._values_taken >= len(SIGNALS) * MAX_VALUES

    def collect_blocks(self, *, short: bool) -> list[Block]:
        """Return the blocks that are complete; with what is left of samples if they may be `short`."""
        self._values_taken, last = 0, max(self._newest)
        settled = last + SETTLED_PERIOD_SHARE * self.period if self._complete else last
        if not (self._complete or short):  # others may still come for what one signal has reached
            settled = max(min(self._newest), last - max(LAG_S, self._span_s))
        self.collect(-math.inf, settled)
        if short:  # a machine that is off makes no samples, while its thermometer goes on: no message waits for them
            self.resampler.take_covariates()
        if self.trouble is None or self.trouble.state == "slow":
            words = [self.describe_slow(k, interval_ms) for k, interval_ms in self.slow_ms.items()]
            self.trouble = Reception("slow", ", ".join(words)) if words else None
        if self.trouble is not None:
            self.discard(0, self.trouble.state, self.trouble.why)
        blocks = self.take_blocks(short=short)
        self._from = last - self._t.size * self.period if math.isfinite(last) else math.nan
        return blocks

    def take_closed(self) -> list[Receipt]:
        """Return the messages of which no value waits any more."""
        # of samples and values that are in no block yet
        times = np.sort(np.append(self._t, self.resampler.pending_times))
        closed, waiting = list[Receipt](), deque[_OpenMessage]()
        for open_message in self.open:
            if open_message.waits(times):
                waiting.append(open_message)
            else:
                closed.append(open_message.receipt)
        self.open = waiting
        return closed
