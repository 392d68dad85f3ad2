"""Random faults: by the radius outside which they are seen, and over the ranges of the paper's Table 2."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

import servoscope as ss
from accuracy.innovations import known
from accuracy.rig import FAULT_AT, loop, record
from servoscope.errors import SimulationError
from servoscope.paper.conditions import SIZES, WORDS
from servoscope.plants import Fault
from servoscope.refinement.hypotheses import deviation
from servoscope.refinement.window import Growth
from servoscope.simulation import FaultEvent

KINDS = ("profile", "multisine", "trapezoid")
SECONDS = 60.0  # of a recording; faults begin half-way
PARAMETERS = tuple(WORDS)
TABLE_2 = {name: (min(sizes), max(sizes)) for name, sizes in SIZES.items()} | {"beta": (0.005, 0.1)}
RADII = 0.5, 10.0
USED = 0.9  # of the logarithms of the ratios that a diagnosis looks at: beyond, a size could not be said
SEEN = 7.8
"""Standard deviations of a size that make a radius. One false alarm a year asks for 22 nats of a detector; nine of ten
runs have collected them when they have 30 on average, with a variance of twice the mean: sqrt(2 30) deviations."""


@functools.cache
def faults() -> dict[str, Fault]:
    """Return the rig's faults by parameter."""
    return {fault.parameter: fault for fault in loop().plant.faults}


@functools.cache
def spread(kind: str, parameter: str) -> float:
    """Return the Cramer-Rao bound of a size's logarithm 30 s after the onset, all else known, as standard deviation."""
    recording = record(kind, SECONDS, 0, 0)
    J = known(recording, loop().plant).jacobian(np.zeros(1), (parameter,), Growth(round(FAULT_AT * loop().sample_rate)))
    return deviation(J)


def radius(kind: str, parameter: str) -> float:
    """Return the size, as logarithm of the ratio, that is seen with 90 % probability within 30 s of its onset."""
    return SEEN * spread(kind, parameter)


def small(rng: np.random.Generator, kind: str, parameter: str) -> float:
    """Draw a ratio whose size is log-uniform in radii, up or down."""
    up = bool(rng.integers(2))
    most = USED * abs(float(np.log(faults()[parameter].ratio_range[up])))
    size = between(rng, RADII[0], min(RADII[1], most / radius(kind, parameter))) * radius(kind, parameter)
    return float(np.exp(size if up else -size))


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
