"""Processor time of the service's one thread, by layer: where the time of a sample goes."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Literal, get_args

Layer = Literal["decode", "assemble", "quality", "kernel", "judge", "store", "publish", "other"]


class LayerTimes:
    """Attributes the thread's processor time to the layer that it is in; layers do not nest."""

    def __init__(self) -> None:
        self._seconds = dict.fromkeys(get_args(Layer), 0.0)
        self._layer: Layer = "other"
        self._since: float | None = None

    def enter(self, layer: Layer) -> None:
        """Leave one layer for another; called about ten times per turn, and not per block."""
        now = time.thread_time()
        if self._since is not None:
            self._seconds[self._layer] += now - self._since
        self._layer, self._since = layer, now

    @property
    def seconds(self) -> Mapping[str, float]:
        """Processor time of each layer so far [s]."""
        return self._seconds
