"""Medians and quartiles over the seeds, in words, and the verdict that follows from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

ClaimVerdict = Literal["holds", "holds partly", "does not hold"]
MetricSamples = Mapping[str, Sequence[float]]


class ClaimResult(NamedTuple):
    """What was measured, in words, the verdict that follows from it, and whether the presumed cause was confirmed."""

    measured: str
    verdict: ClaimVerdict
    cause_confirmed: bool = True


def claim_verdict(holds: bool, partly: bool = False) -> ClaimVerdict:
    """Return the verdict."""
    return "holds" if holds else "holds partly" if partly else "does not hold"


class MetricQuartiles:
    """Medians and quartiles of the metrics of several seeds, as numbers and as words; remembers what was asked for."""

    def __init__(self, metrics: MetricSamples) -> None:
        self._metrics = metrics
        self.used: dict[str, tuple[float, float, float]] = {}

    def __call__(self, key: str) -> float:
        """Return a median; infinite values count, NaN is left out."""
        values = np.array([value for value in self._metrics.get(key, ()) if not np.isnan(value)])
        if not values.size:
            self.used[key] = (float("nan"),) * 3
        else:
            low, middle, high = np.quantile(values, [0.25, 0.5, 0.75], method="nearest")
            self.used[key] = float(low), float(middle), float(high)
        return self.used[key][1]

    def text(self, key: str, scale: float = 1.0, unit: str = "") -> str:
        """Return ``median [low, high]``."""
        self(key)
        low, middle, high = (value * scale for value in self.used[key])
        if np.isnan(middle):
            return "never"
        if np.isclose(low, high, rtol=5e-3):
            return f"{middle:.3g}{unit}"
        return f"{middle:.3g}{unit} [{low:.3g}, {high:.3g}]"

    def percent(self, key: str) -> str:
        """Return ``median % [low, high]``."""
        return self.text(key, 100.0, " %")
