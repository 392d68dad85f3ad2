"""Whether the exact predictor explains the healthy recordings: only then is a refit worth more than the recursion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servoscope.baseline import Baseline
from servoscope.recording import Recording
from servoscope.refinement.goodness import goodness, traces
from servoscope.refinement.window import Growth, Window

MOST = 60_000  # samples of a recording that are looked at


def exact(baseline: Baseline) -> bool:
    """Return whether the exact predictor can be written down: known noise, a linear plant, a held input."""
    loop = baseline.loop
    known = baseline.noise is not None and baseline.noise.y_std > 0.0 and not loop.monitor.model_error
    return known and loop.plant.has_physics and loop.plant.linear and not loop.plant.extras and loop.hold == "zoh"


def healthy_misfit(baseline: Baseline, recordings: Sequence[Recording]) -> float | None:
    """Return how badly the worst healthy recording is explained: score statistic over its limit, at most 1 if well.

    None where the predictor cannot be written down, see `exact`.
    """
    if not exact(baseline):
        return None
    return max(_misfit(Window.of(baseline, rec, 0, min(rec.samples, MOST))) for rec in recordings)


def _misfit(window: Window) -> float:
    m, always = window.nuisances, Growth(window.samples)
    nothing = np.zeros(m)
    residual = window.residual(nothing, (), always)
    jacobian = window.jacobian(nothing, (), always)
    louder = float(residual @ residual) / window.samples
    Z = traces(window, window.healthy, always, np.ones(window.samples, dtype=np.bool_))
    found = goodness(Z, jacobian, residual, louder, 0.0)
    return found.statistic / found.limit
