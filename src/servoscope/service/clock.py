"""The clocks of a service: dates that go on evenly, whoever sets the machine's clock, and processor time by layer."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Literal, get_args

Layer = Literal["decode", "assemble", "quality", "kernel", "judge", "store", "publish", "other"]


class SteadyClock:
    """The time of day as it was at the start, and what has passed since then.

    Dates, delays and retries of one run agree with each other that way. The rate still follows a time server, which
    corrects the monotonic clock's rate too; what is left out are steps, and the next start takes them.

    Parameters
    ----------
    monotonic
        Returns the time that has passed since some moment [s].
    """

    def __init__(self, monotonic: Callable[[], float] = time.monotonic) -> None:
        self.monotonic = monotonic
        self._start = time.time() - monotonic()

    def now(self) -> float:
        """Return the time (epoch, s)."""
        return self._start + self.monotonic()

    def latest(self) -> float:
        """Return the later of that and of the machine's clock (epoch, s): what is ahead of both is in the future.

        A machine that starts without a battery learns the time only after its service has started; and one whose
        clock is set back must not take what comes for the future.
        """
        return max(self.now(), time.time())


class LayerTimes:
    """Attributes the thread's processor time to the layer that it is in; layers do not nest."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(get_args(Layer), 0.0)  # processor time of each layer so far [s]
        self._layer: Layer = "other"
        self._since: float | None = None

    def enter(self, layer: Layer) -> None:
        """Leave one layer for another; called about ten times per turn, and not per block."""
        now = time.thread_time()
        if self._since is not None:
            self.seconds[self._layer] += now - self._since
        self._layer, self._since = layer, now
