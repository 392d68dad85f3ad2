"""Values of several nodes, each reported when it changes, resampled to one clock by their source's time stamps."""

from __future__ import annotations

import heapq
import math
from typing import NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray

MAX_FILL_SAMPLES = 100_000  # samples of constant values that are made at once
HOLE_S = 10.0  # in a history: a pause that is longer is a hole
COVARIATE_LAG_S = 10.0  # how late a covariate may come and still belong to the next sample
CLOCK_STEP_S = 10.0  # a value that is older than the last sample by more shows that the clock was set back


class SampleGap(NamedTuple):
    """A time without samples: from the last one to the next one [UTC s], and how many are missing."""

    start: float
    end: float
    samples: int


class ResampledSignals(NamedTuple):
    """Samples that are complete: time stamps [UTC s], shape (N,), and values, shape (signals, N); gaps before them."""

    t: FloatArray
    values: FloatArray
    gaps: list[SampleGap]


class Resampler:
    """Makes samples of single values, of `signals` nodes at a sample time `period` [s], behind `last_t` [UTC s].

    A value holds until the next one: a source reports only changes. What lies between two changes is filled as long
    as the source is known to be alive; after `restart` it is not, and the next sample begins anew. Where a source
    repeats its values, one holds for `hold_s` only [s]: later it is missing, and a longer pause is a gap; and what is
    older than the last sample is late, however much.

    The last of them, `covariates`, come when they like: they make no samples, and no sample waits for them. The next
    one has a new value, others have it as long as it holds.
    """

    def __init__(
        self, signals: int, period: float, last_t: float = math.nan, hold_s: float = math.inf, covariates: int = 0
    ) -> None:
        self._signals, signals = signals, signals + covariates
        self._period, self._values = period, np.full(signals, math.nan)
        self._value_t, self._hold_s = np.full(signals, -math.inf), hold_s
        self._known, self._new = (np.zeros(signals, dtype=np.bool_) for _ in range(2))
        self._pending: list[tuple[float, int, int, float]] = []  # a heap: time, order, signal, value
        self._order = 0
        self._newest = -math.inf
        self._restarted, self._restart_t = True, math.inf
        self._history_until = -math.inf
        self._samples: list[tuple[float, FloatArray]] = []
        self._gaps: list[SampleGap] = []
        self.last_t = last_t  # time of the last sample that was made
        self._late = 0  # values that came after their sample had been made

    def restart(self, t: float, *, complete: bool = False, history_until: float = -math.inf) -> None:
        """Continue with a subscription from `t` on; older values only say what holds, and make no samples.

        Unless all changes of the time between are known (`complete`), earlier values are unknown now. What was read
        from a history ends at `history_until`: a long pause in it may be a hole, since no heartbeat has filled it.
        """
        self._restarted, self._restart_t, self._history_until = True, t, history_until
        if not complete:
            self._known[:] = self._new[:] = False
            self._values[self._signals :] = math.nan
            self._pending.clear()
            self._newest = -math.inf

    def add(self, signal: int, t: float, value: float) -> None:
        """Take a value; NaN where its status says that it is bad."""
        self._order += 1
        if signal < self._signals:
            self._newest = max(self._newest, t)
        heapq.heappush(self._pending, (t, self._order, signal, value))

    def take_late(self) -> int:
        """Return how many values came after their sample had been made, since the last call."""
        late, self._late = self._late, 0
        return late

    @property
    def pending_times(self) -> list[float]:
        """Times of values of which no sample was made yet, in no order [UTC s]."""
        return [value[0] for value in self._pending]

    def take_samples(self, alive_until: float, settled: float | None = None) -> ResampledSignals:
        """Return the samples that are complete: those older than the newest value, and all up to `alive_until` [UTC s].

        A source reports changes in their order. Where none comes any more, something else has to show that it is
        alive, and has reported all changes up to `alive_until`. Where signals come in messages of their own, the
        newest value of one says nothing of others: all values up to `settled` have come [UTC s].
        """
        settled = max(alive_until, self._newest) if settled is None else settled
        while self._pending and self._pending[0][0] + 0.5 * self._period <= settled:
            t, _, signal, value = self._pending[0]
            if signal >= self._signals:
                heapq.heappop(self._pending)
                self._take_covariate(t, signal, value)
                continue
            group = dict[int, float]()
            while self._pending and self._pending[0][0] < t + 0.5 * self._period:
                at, _, signal, value = heapq.heappop(self._pending)
                if signal < self._signals:
                    group[signal] = value
                else:
                    self._take_covariate(at, signal, value)
            self._add_group(t, group)
        if (
            self._restarted
            and self._known[: self._signals].all()
            and self._restart_t + 2.0 * self._period <= alive_until
        ):
            self._add_sample(self._restart_t)  # nothing has changed since then
        if not self._restarted and alive_until - self.last_t < MAX_FILL_SAMPLES * self._period:
            while self.last_t + 2.0 * self._period <= alive_until:
                self._add_sample(self.last_t + self._period)
        if not self._pending:
            self._newest = -math.inf
        samples, self._samples = self._samples, []
        gaps, self._gaps = self._gaps, []
        values = np.array([held for _, held in samples]).reshape(-1, self._values.size).T
        return ResampledSignals(np.array([t for t, _ in samples]), values, gaps)

    def take_covariates(self) -> None:
        """Take the covariates that wait for a sample: the next one has the newest of them."""
        waiting, self._pending = sorted(self._pending), []
        for value in waiting:
            if value[2] < self._signals:
                self._pending.append(value)  # in order, which makes a heap
            else:
                self._take_covariate(value[0], *value[2:])

    def _take_covariate(self, t: float, signal: int, value: float) -> None:
        is_set_back = self._hold_s == math.inf and t < self._value_t[signal] - CLOCK_STEP_S
        if t >= self._value_t[signal] or is_set_back or not self._known[signal]:
            self._values[signal], self._value_t[signal] = value, t
            self._known[signal] = self._new[signal] = True

    def _add_group(self, t: float, group: dict[int, float]) -> None:
        """Take values of one moment."""
        if (
            self._hold_s == math.inf
            and t < self.last_t - CLOCK_STEP_S
            and not (self._restarted and t < self._restart_t)
        ):
            self.restart(t, complete=True)
            self.last_t = math.nan
        behind = t <= self.last_t + 0.5 * self._period
        if behind and not self._restarted:
            self._late += len(group)
        is_new = not behind and not (self._restarted and t < self._restart_t)
        steps = round((t - self.last_t) / self._period) if is_new and not self._restarted else 1
        unheld = t - self.last_t > self._hold_s + 1.5 * self._period
        if steps > 1 and (unheld or (t <= self._history_until and t - self.last_t > HOLE_S)):
            self._restarted, self._restart_t = True, t  # a gap: held values would look like a machine that stood still
        elif steps > MAX_FILL_SAMPLES:
            self.restart(t, complete=True)  # a clock that was set, or a source whose end was not noticed in time
        elif steps > 1:
            for between in np.linspace(self.last_t, t, steps + 1)[1:-1].tolist():
                self._add_sample(between)
        for signal, value in group.items():
            self._values[signal], self._known[signal], self._value_t[signal] = value, True, t
        if is_new and self._known[: self._signals].all():
            self._add_sample(t)

    def _add_sample(self, t: float) -> None:
        first = self._restarted and not math.isnan(self.last_t)
        missing = round((t - self.last_t) / self._period) - 1 if first else 0
        if missing > 0:
            self._gaps.append(SampleGap(self.last_t, t, missing))
        age = t - self._value_t
        held = (age <= self._hold_s + 0.5 * self._period) | (self._new & (age <= COVARIATE_LAG_S))
        self._new[:] = False
        self._samples.append((t, np.where(held, self._values, math.nan)))
        self.last_t, self._restarted = t, False
