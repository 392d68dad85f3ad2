"""What else it could be: causes outside the list of faults that explain a window as well as the best of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from servoscope.core.messages import Message, message, text_message
from servoscope.isolation.ml.backlash import fit_backlash
from servoscope.isolation.ml.hypothesis import HypothesisFit, fit_hypothesis
from servoscope.isolation.ml.least_squares import minimise_from_grid, solve_least_squares
from servoscope.isolation.ml.predictor import Predictor
from servoscope.isolation.ml.search import RefitResult
from servoscope.isolation.ml.start_values import fit_further_parameters
from servoscope.isolation.ml.window import ChangeProfile, ChangeWindow, RefitWindow, delayed, speed_sign

AS_WELL = 6.0  # of the sum of squares; a likelihood 20 times smaller is not as good
NEARLY_ALL = 0.95  # of what the healthy plant does not explain
QUIET = 1.15  # variance of the innovations up to which nothing but noise is left
TRIED = 9  # delays up to one further sample, before the best is refined


@dataclass(frozen=True)
class OtherCause:
    """Something that would explain the window."""

    name: str
    cause: Message
    value: float  # value, unit: A ratio to the healthy value (unit ``ratio``), or a size
    unit: str
    cost: float  # sum of squares with it


def find_other_causes(refined: RefitResult) -> list[OtherCause]:
    """Return the causes that explain the window, the likeliest first.

    Where a fault or a pair is the best explanation, those that are as good. Where none is, the best of the others and
    those as good as it, if they explain nearly all that the healthy plant does not.
    """
    window, best = refined.window, refined.best.fitted
    found, healthy = _causes_at(refined, best.profile)
    limit = best.cost
    if refined.is_unknown:
        # the onset of an explanation that is none may mean nothing
        earlier, other = _causes_at(refined, ChangeProfile(refined.initial_onset))
        if min(cause.cost for cause in earlier) < min(cause.cost for cause in found):
            found, healthy = earlier, other
        most = window.samples + (1.0 - NEARLY_ALL) * (healthy - window.samples)
        enough = min(max(most, QUIET * window.samples), best.cost)
        limit = min([cause.cost for cause in found if enough >= cause.cost], default=-np.inf)
    return sorted(
        (c for c in found if limit + AS_WELL * refined.noise_variance >= c.cost), key=lambda cause: cause.cost
    )


def _causes_at(refined: RefitResult, profile: ChangeProfile) -> tuple[list[OtherCause], float]:
    """Return all causes for a change at some time, and the sum of squares of no change at all."""
    window, best = refined.window, refined.best.fitted
    healthy = fit_hypothesis(window, [], profile, best.d, [np.zeros(0)], free=True)
    others = (
        refined.other_parameters
        if profile == best.profile
        else fit_further_parameters(window, profile, best, refined.noise_variance)
    )
    return [*map(_ratio, others), *_additive_causes(window, profile, healthy)], healthy.cost


def _ratio(other: HypothesisFit) -> OtherCause:
    (fault,) = other.faults
    return OtherCause(fault.name, text_message(fault.words), float(np.exp(other.x[0])), "ratio", other.cost)


def _additive_causes(window: ChangeWindow, profile: ChangeProfile, healthy: HypothesisFit) -> Iterator[OtherCause]:
    """Try what is no parameter: a later input, backlash, Coulomb friction, offsets."""
    if isinstance(window, RefitWindow):
        yield _delay_cause(window, profile, healthy)
        gap = fit_backlash(window, profile)
        yield OtherCause("backlash", message("cause.backlash"), gap.width, "of y", gap.cost)
    predictor = window.predictor(healthy.d, (), np.zeros(0), profile)
    where = np.arange(window.samples) >= profile.onset
    nothing, moving, since = np.zeros(window.samples), delayed(speed_sign(window.y), 1), where.astype(np.float64)
    signals = (nothing, since), (moving * since, nothing), (since, nothing)
    # a disturbance is taken off y to explain it, so its size has the other sign
    names = (
        ("sensor_offset", message("cause.sensor_offset"), "of y", 1.0),
        ("coulomb_friction", message("cause.coulomb_friction"), "of u", -1.0),
        ("input_offset", message("cause.input_offset"), "of u", 1.0),
    )
    for (name, cause, unit, factor), (to_u, to_y) in zip(names, signals, strict=True):
        if name in window.plant.names:  # a fault of its own
            continue
        column = window.disturbance_response(predictor, profile, to_u, to_y)
        J = np.column_stack([healthy.jacobian, np.append(column, np.zeros(window.nuisance_count))])
        step, left = solve_least_squares(J, healthy.residual)
        yield OtherCause(name, cause, float(factor * step[-1]), unit, left)


def _delay_cause(window: RefitWindow, profile: ChangeProfile, healthy: HypothesisFit) -> OtherCause:
    """Try an input that acts up to a sample later than the loop file says."""
    rate, factory = window.factory.loop.sample_rate, window.factory
    nothing = np.zeros(window.nuisance_count)

    def cost(samples: float) -> float:
        last = factory.predictor(window.plant, later_s=samples / rate)
        both = Predictor.concatenate([window.healthy, *(last for _ in profile.shares)])
        e = np.asarray(window.innovations(both, profile), dtype=np.float64)
        return solve_least_squares(healthy.jacobian, np.concatenate([e, nothing]))[1]

    latest = 1.0 - factory.fractional_delay_s * rate
    best = minimise_from_grid(cost, np.linspace(0.0, latest, TRIED), 1e-4)
    return OtherCause("delay", message("cause.delay"), best / rate, "s", cost(best))
