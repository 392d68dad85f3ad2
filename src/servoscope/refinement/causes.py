"""What else it could be: causes outside the list of faults that explain a window as well as the best of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from servoscope.refinement.backlash import backlash
from servoscope.refinement.columns import solve
from servoscope.refinement.goodness import LAGS, traces
from servoscope.refinement.hypotheses import Fitted, fit
from servoscope.refinement.outside import outside
from servoscope.refinement.predictor import Predictor
from servoscope.refinement.refining import Refined
from servoscope.refinement.window import Growth, Window

AS_WELL = 6.0  # of the sum of squares; a likelihood 20 times smaller is not as good
NEARLY_ALL = 0.95  # of what the healthy plant does not explain
QUIET = 1.15  # variance of the innovations up to which nothing but noise is left
TRIED = 9  # delays up to one further sample, before the best is refined


@dataclass(frozen=True)
class Cause:
    """Something that would explain the window.

    Parameters
    ----------
    name, words
        What it is.
    value, unit
        A ratio to the healthy value (unit ``ratio``), or a size.
    J
        Sum of squares with it.
    """

    name: str
    words: str
    value: float
    unit: str
    J: float


def causes(refined: Refined) -> list[Cause]:
    """Return the causes that explain the window, the likeliest first.

    Where a fault or a pair is the best explanation, those that are as good. Where none is, the best of the others and
    those as good as it, if they explain nearly all that the healthy plant does not.
    """
    window, best = refined.window, refined.best.fitted
    found, healthy = _at(refined, best.growth)
    limit = best.J
    if refined.is_unknown:
        # the onset of an explanation that is none may mean nothing
        earlier, other = _at(refined, Growth(refined.rough))
        if min(cause.J for cause in earlier) < min(cause.J for cause in found):
            found, healthy = earlier, other
        most = window.samples + (1.0 - NEARLY_ALL) * (healthy - window.samples)
        enough = min(max(most, QUIET * window.samples), best.J)
        limit = min([cause.J for cause in found if enough >= cause.J], default=-np.inf)
    return sorted((c for c in found if limit + AS_WELL * refined.louder >= c.J), key=lambda cause: cause.J)


def _at(refined: Refined, growth: Growth) -> tuple[list[Cause], float]:
    """Return all causes for a change at some time, and the sum of squares of no change at all."""
    window, best = refined.window, refined.best.fitted
    healthy = fit(window, [], growth, best.d, [np.zeros(0)], free=True)
    others = refined.outside if growth == best.growth else outside(window, growth, best, refined.louder)
    return [*map(_ratio, others), *_added(window, growth, healthy)], healthy.J


def _ratio(other: Fitted) -> Cause:
    (fault,) = other.faults
    return Cause(fault.name, fault.words, float(np.exp(other.x[0])), "ratio", other.J)


def _added(window: Window, growth: Growth, healthy: Fitted) -> Iterator[Cause]:
    """Try what is no parameter: a later input, backlash, Coulomb friction, offsets."""
    yield _later(window, growth, healthy)
    gap = backlash(window, growth)
    yield Cause("backlash", "backlash between actuator and sensor", gap.width, "of y", gap.J)
    predictor = window.predictor(healthy.d, (), np.zeros(0), growth)
    where = np.arange(window.samples) >= growth.since
    columns = traces(window, predictor, growth, where)[:, 2 * LAGS + 1 :]
    # a disturbance is taken off y to explain it, so its size has the other sign
    names = (
        ("sensor_offset", "an offset of the sensor of y", "of y", 1.0),
        ("coulomb_friction", "Coulomb friction", "of u", -1.0),
        ("input_offset", "an offset of the input", "of u", 1.0),
    )
    for (name, words, unit, factor), column in zip(names, columns.T, strict=True):
        J = np.column_stack([healthy.jacobian, np.append(column, np.zeros(window.nuisances))])
        step, left = solve(J, healthy.residual)
        yield Cause(name, words, float(factor * step[-1]), unit, left)


def _later(window: Window, growth: Growth, healthy: Fitted) -> Cause:
    """Try an input that acts up to a sample later than the loop file says."""
    from scipy.optimize import minimize_scalar

    rate, bench = window.bench.loop.sample_rate, window.bench
    nothing = np.zeros(window.nuisances)

    def cost(samples: float) -> float:
        last = bench.predictor(window.plant, later_s=samples / rate)
        both = Predictor.of([window.healthy, *(last for _ in growth.shares)])
        e = np.asarray(window.innovations(both, growth), dtype=np.float64)
        return solve(healthy.jacobian, np.concatenate([e, nothing]))[1]

    latest = 1.0 - bench.rest_s * rate
    tried = np.linspace(0.0, latest, TRIED)
    at = int(np.argmin([cost(float(samples)) for samples in tried]))
    bracket = float(tried[max(at - 1, 0)]), float(tried[min(at + 1, TRIED - 1)])
    found = minimize_scalar(cost, bounds=bracket, method="bounded", options={"xatol": 1e-4})
    best = min((float(tried[at]), float(found.x)), key=cost)
    return Cause("delay", "an input that acts later", best / rate, "s", cost(best))
