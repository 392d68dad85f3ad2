"""Random faults: by the radius outside which they are seen, and over the ranges of the paper's Table 2."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

import servoscope as ss
from accuracy.rig import FAULT_AT, baseline, loop
from servoscope.core.errors import SimulationError
from servoscope.design import DesignStudy, DirectionStudy, study
from servoscope.models.plants import Fault
from servoscope.research.paper.conditions import FAULT_NAMES, SIZES
from servoscope.simulation import FaultEvent, reference

KINDS = ("profile", "multisine", "trapezoid")
SECONDS = 60.0  # of a recording; faults begin half-way
PARAMETERS = tuple(FAULT_NAMES)
TABLE_2 = {name: (min(sizes), max(sizes)) for name, sizes in SIZES.items()} | {"beta": (0.005, 0.1)}
RADII = 0.5, 10.0
USED = 0.9  # of the logarithms of the ratios that a diagnosis looks at: beyond, a size could not be said


@functools.cache
def faults() -> dict[str, Fault]:
    """Return the rig's faults by parameter."""
    return {fault.parameter: fault for fault in loop().plant.faults}


@functools.cache
def designed(kind: str) -> DesignStudy:
    """Return what `servoscope design` says of the rig under a reference, with 30 s after the onset."""
    learned = baseline(kind, SECONDS, 0)
    return study(learned, reference(kind, SECONDS, loop().sample_rate), SECONDS - FAULT_AT)


def side(kind: str, parameter: str, up: bool) -> DirectionStudy:
    """Return what it says of one direction of a fault."""
    found = next(fault for fault in designed(kind).faults.values() if fault.parameter == parameter)
    return found.up if up else found.down


def radius(kind: str, parameter: str, up: bool) -> float:
    """Return the size, as logarithm of the ratio, that is announced within 30 s with 90 % probability.

    Where no size within the range is, the whole range.
    """
    seen = side(kind, parameter, up).detectable
    return abs(float(np.log(seen if seen is not None else faults()[parameter].ratio_range[up])))


def clear(kind: str, parameter: str, ratio: float) -> bool:
    """Return whether a fault is outside the isolability radius."""
    return side(kind, parameter, ratio > 1.0).clear(ratio)


def small(rng: np.random.Generator, kind: str, parameter: str) -> float:
    """Draw a ratio whose size is log-uniform in radii, up or down, under which the loop is stable."""
    while True:
        up = bool(rng.integers(2))
        most = USED * abs(float(np.log(faults()[parameter].ratio_range[up])))
        unit = min(radius(kind, parameter, up), most)
        size = between(rng, RADII[0], min(RADII[1], most / unit)) * unit
        ratio = float(np.exp(size if up else -size))
        if stable([FaultEvent(parameter, ratio, 0.0)]):
            return ratio


def large(rng: np.random.Generator, *parameters: str) -> dict[str, float]:
    """Draw ratios, log-uniform over the ranges of Table 2, under which the loop is stable."""
    while True:
        ratios = {name: between(rng, *TABLE_2[name]) for name in parameters}
        if stable([FaultEvent(name, ratio, 0.0) for name, ratio in ratios.items()]):
            return ratios


def stable(events: Sequence[FaultEvent]) -> bool:
    """Return whether the loop is stable all the time, on the way of a drift too."""
    try:
        ss.simulate(loop(), np.zeros(round(SECONDS * loop().sample_rate)), faults=events)
    except SimulationError:
        return False
    return True


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number, log-uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
