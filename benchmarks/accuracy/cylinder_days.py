"""Days of a hydraulic cylinder: healthy ones, sixty faults and six changes of its process, simulated."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

import servoscope as ss
from servoscope.simulation import CylinderRig, FaultEvent, cylinder_motion, simulate_cylinder

RATE, DURATION_S = 250.0, 60.0
COLDEST_C, WARMEST_C = 35.0, 55.0
LEARNED, HEALTHY = 7, 32  # production days that are learned, further healthy ones
MIXED = ("production", "production", "production", "production", "teach", "teach", "teach", "sweep", "sweep", "sweep")
MIXED_HEALTHY = ("production",) * 16 + ("teach",) * 8 + ("sweep",) * 8

# by fault: the parameters of the rig that it multiplies, and their ratios at its three sizes; sizes at which T^2 of
# nine features, learned from the seven production days, finds 31 +- 4 of 60
FAULTS: dict[str, tuple[tuple[str, ...], tuple[float, float, float]]] = {
    "supply": (("pump_pressure",), (0.985, 0.96, 0.9)),
    "valve, extending": (("gain_extend",), (0.97, 0.94, 0.88)),
    "valve, retracting": (("gain_retract",), (0.985, 0.96, 0.9)),
    "leakage": (("leakage",), (2.5, 6.0, 20.0)),
    "friction": (("friction", "viscous"), (1.5, 2.2, 4.0)),
    "air": (("air",), (3.0, 10.0, 30.0)),
    "overlap": (("overlap",), (1.4, 2.0, 3.5)),
    "zero": (("zero",), (1.5, 2.2, 4.0)),
    "spool lag": (("valve_hz",), (0.6, 0.3, 0.15)),
    "mass": (("mass",), (1.5, 2.5, 5.0)),
}
PROCESS = (0.5, 2.0, 3.0)  # ratios of the process force


class Day(NamedTuple):
    """A recording, and what is wrong in it: nothing, a fault, or the process."""

    recording: ss.Recording
    fault: str = ""
    size: float = 1.0  # ratio of its parameter
    at_s: float = 0.0


def day(kind: str, seed: int, parameters: tuple[str, ...] = (), ratio: float = 1.0, at_s: float = 0.0) -> ss.Recording:
    """Return the recording of a day: motion, temperature and process of its own."""
    rig = CylinderRig(temperature=float(np.random.default_rng([seed, 3]).uniform(COLDEST_C, WARMEST_C)))
    events = [FaultEvent(name, ratio, at_s) for name in parameters]
    motion = cylinder_motion(kind, DURATION_S, RATE, seed)
    recording, _ = simulate_cylinder(motion, rig, faults=events, seed=seed)
    return replace(recording, name=f"{kind} {seed}")


def learned_days(kinds: tuple[str, ...] = ("production",) * LEARNED, first: int = 0) -> list[ss.Recording]:
    """Return the healthy days to learn from; `first`: added to all seeds."""
    return [day(kind, first + seed) for seed, kind in enumerate(kinds)]


def healthy_days(kinds: tuple[str, ...] = ("production",) * HEALTHY, first: int = 0) -> list[Day]:
    """Return further healthy days."""
    return [Day(day(kind, first + 100 + seed)) for seed, kind in enumerate(kinds)]


def faulty_days(first: int = 0) -> Iterator[Day]:
    """Yield the sixty faults: ten kinds, three sizes, from the start and from mid-recording."""
    seed = first + 1000
    for fault, (parameters, sizes) in FAULTS.items():
        for size in sizes:
            yield from _both(fault, parameters, size, seed)
            seed += 2


def process_days(first: int = 0) -> Iterator[Day]:
    """Yield the six changes of the process force."""
    for k, size in enumerate(PROCESS):
        yield from _both("process", ("process_force",), size, first + 2000 + 2 * k)


def _both(fault: str, parameters: tuple[str, ...], size: float, seed: int) -> Iterator[Day]:
    middle = DURATION_S * float(np.random.default_rng([seed, 4]).uniform(0.4, 0.6))
    for k, at_s in enumerate((0.0, middle)):
        yield Day(day("production", seed + k, parameters, size, at_s), fault, size, at_s)
