"""Faults that step or ramp in at known times, and the plants that they make of the nominal one."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import SimulationError
from servoscope.models.plants import Plant

_EVENT_PATTERN = re.compile(r"\s*(\w+)\s*=\s*([^@~\s]+)\s*(?:@\s*([^@~\s]+)\s*)?(?:~\s*([^@~\s]+)\s*)?")
_RAMP_STEP_S = 0.1  # s, longest stretch of a ramp that one plant stands for


@dataclass(frozen=True)
class FaultEvent:
    """A parameter that changes during a simulation.

    Raises SimulationError if the ratio is not positive or a time is negative.
    """

    parameter: str  # parameter of the plant, ``C_ie``, or the name of the fault, ``leakage``
    ratio: float  # value after the change, divided by the nominal value; not by that of an earlier event
    at_s: float  # when the change begins [s]
    ramp_s: float = 0.0  # how long it takes [s]; the logarithm of the ratio then changes linearly. 0 is a step.

    def __post_init__(self) -> None:
        if not (np.isfinite(self.ratio) and self.ratio > 0.0):
            raise SimulationError(f"fault {self}: the ratio must be positive")
        if not (0.0 <= self.at_s < np.inf and 0.0 <= self.ramp_s < np.inf):
            raise SimulationError(f"fault {self}: times must not be negative")

    def __str__(self) -> str:
        """Return the form that `parse` reads."""
        ramp = f"~{self.ramp_s:g}" if self.ramp_s else ""
        return f"{self.parameter}={self.ratio:g}@{self.at_s:g}{ramp}"

    @classmethod
    def parse(cls, text: str) -> FaultEvent:
        """Read ``C_ie=1.2@30``, a step at 30 s, or ``C_ie=1.2@30~600``, a ramp over the 600 s from there.

        Raises SimulationError if the text has another form; without ``@`` the fault is there from the start.
        """
        match = _EVENT_PATTERN.fullmatch(text)
        if match is None:
            raise SimulationError(f"fault {text!r}: write PARAMETER=RATIO@SECONDS, or PARAMETER=RATIO@SECONDS~RAMP")
        try:
            ratio, at_s, ramp_s = (float(part) if part else 0.0 for part in match.groups()[1:])
        except ValueError:
            raise SimulationError(f"fault {text!r}: ratio and times must be numbers, as in C_ie=1.2@30") from None
        return cls(match[1], ratio, at_s, ramp_s)


class PlantSchedule(NamedTuple):
    """Which plant holds when, stretch by stretch."""

    plants: tuple[Plant, ...]
    ratios: dict[str, FloatArray]  # per parameter, shape (stretches,)
    plant_index: npt.NDArray[np.int64]  # of each sample, from that sample to the next, shape (N,)


def resolve_faults(plant: Plant, events: Sequence[FaultEvent]) -> tuple[FaultEvent, ...]:
    """Return the events in order of time, with fault names replaced by their parameters.

    Raises SimulationError if the plant has no such parameter.
    """
    named = {fault.name: fault.parameter for fault in plant.all_faults}
    resolved = []
    for event in events:
        parameter = named.get(event.parameter, event.parameter)
        known_names = (*plant.parameters, *(ray.name for ray in plant.rays))
        if parameter not in known_names:
            known = ", ".join(known_names)
            raise SimulationError(f"fault {event}: plant {plant.kind} has no {event.parameter}, only {known}")
        resolved.append(FaultEvent(parameter, event.ratio, event.at_s, event.ramp_s))
    return tuple(sorted(resolved, key=lambda event: event.at_s))


def schedule_plants(plant: Plant, events: Sequence[FaultEvent], samples: int, sample_rate: float) -> PlantSchedule:
    """Lay the plants of some events along the samples of a recording.

    A change acts from the first sample at or after its time. A ramp becomes stretches of at most 0.1 s, each with the
    ratios of its middle. A later event of the same parameter takes over at the value that the earlier one has reached.

    `events`: as `resolve_faults` returns them. Raises SimulationError if an event lies after the end.
    """
    changing = np.zeros(samples, dtype=bool)
    starts = {0}
    for event in events:
        first = _first_sample(event.at_s, sample_rate)
        if first >= samples:
            raise SimulationError(f"fault {event}: begins after the end, {samples / sample_rate:g} s")
        last = _first_sample(event.at_s + event.ramp_s, sample_rate)
        starts.update((first, last))
        changing[first:last] = True
    stretch = max(1, int(_RAMP_STEP_S * sample_rate + 1e-9))
    grid = np.arange(0, samples, stretch)
    starts.update(int(k) for k in grid[changing[grid]])
    edges = np.array(sorted(k for k in starts if k < samples), dtype=np.int64)
    ends = np.append(edges[1:], samples)
    middles = 0.5 * (edges + ends)
    changed = sorted({event.parameter for event in events})
    ratios = {name: _ratios_at(name, events, middles, sample_rate) for name in changed}
    plants = (plant.with_ratios({name: float(ratios[name][i]) for name in changed}) for i in range(edges.size))
    return PlantSchedule(tuple(plants), ratios, np.repeat(np.arange(edges.size, dtype=np.int64), ends - edges))


def describe_plants(plan: PlantSchedule) -> list[str]:
    """Describe how each plant of a schedule differs from the nominal one."""
    return [
        ", ".join(f"{name} x {values[i]:g}" for name, values in plan.ratios.items()) or "its nominal plant"
        for i in range(len(plan.plants))
    ]


def _first_sample(time: float, sample_rate: float) -> int:
    return int(np.ceil(time * sample_rate - 1e-6))


def _ratios_at(parameter: str, events: Sequence[FaultEvent], middles: FloatArray, sample_rate: float) -> FloatArray:
    """Return the ratio (M,) of a parameter at some times (M,) [samples]."""
    own = [event for event in events if event.parameter == parameter]

    def logarithm(until: int, k: FloatArray) -> FloatArray:
        value = np.zeros_like(k)
        for i, event in enumerate(own[:until]):
            first = _first_sample(event.at_s, sample_rate)
            before = logarithm(i, np.array([float(first)]))[0]
            ramp = max(event.ramp_s * sample_rate, 1e-9)
            share = np.clip((k - first) / ramp, 0.0, 1.0)
            value = np.where(k >= first, before + (np.log(event.ratio) - before) * share, value)
        return value

    return np.exp(logarithm(len(own), middles))
