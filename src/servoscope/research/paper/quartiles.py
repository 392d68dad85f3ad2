"""Medians and quartiles over the seeds, as numbers and in words."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

MetricSamples = Mapping[str, Sequence[float]]


SCALES = {
    "": (1.0, ""),
    "%": (100.0, " %"),
    "mm": (1e3, ""),
}  # of numbers in sentences, by what stands behind their names


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

    def fill(self, template: str, counts: Sequence[int] = ()) -> str:
        """Return a sentence with medians, quartiles and `counts` in the place of their names and numbers in braces."""

        def value(name: re.Match[str]) -> str:
            return str(counts[int(name[1])]) if name[1].isdigit() else self.text(name[1], *SCALES[name[2]])

        return re.sub(r"\{([^}:]+):?([^}]*)\}", value, template)
