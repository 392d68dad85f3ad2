"""Faults that step or ramp in at known times, and the plants that they make of the nominal one."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from servoscope.errors import SimulationError
from servoscope.plants import FloatArray, Plant

_FORM = re.compile(r"\s*(\w+)\s*=\s*([^@~\s]+)\s*(?:@\s*([^@~\s]+)\s*)?(?:~\s*([^@~\s]+)\s*)?")
_GRID = 0.1  # s, longest stretch of a ramp that one plant stands for


@dataclass(frozen=True)
class FaultEvent:
    """A parameter that changes during a simulation.

    Parameters
    ----------
    parameter
        Parameter of the plant, ``C_ie``, or the name of the fault, ``leakage``.
    ratio
        Value after the change, divided by the nominal value; not by that of an earlier event.
    at_s
        When the change begins [s].
    ramp_s
        How long it takes [s]; the logarithm of the ratio then changes linearly. 0 is a step.

    Raises
    ------
    SimulationError
        If the ratio is not positive or a time is negative.
    """

    parameter: str
    ratio: float
    at_s: float
    ramp_s: float = 0.0

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

        Raises
        ------
        SimulationError
            If the text has another form; without ``@`` the fault is there from the start.
        """
        found = _FORM.fullmatch(text)
        if found is None:
            raise SimulationError(f"fault {text!r}: write PARAMETER=RATIO@SECONDS, or PARAMETER=RATIO@SECONDS~RAMP")
        try:
            ratio, at_s, ramp_s = (float(part) if part else 0.0 for part in found.groups()[1:])
        except ValueError:
            raise SimulationError(f"fault {text!r}: ratio and times must be numbers, as in C_ie=1.2@30") from None
        return cls(found[1], ratio, at_s, ramp_s)


class Schedule(NamedTuple):
    """Which plant holds when.

    ``plants`` and ``ratios`` are those of the stretches, ratios per parameter (stretches,); ``which`` (N,)
    names the stretch of each sample, from that sample to the next.
    """

    plants: tuple[Plant, ...]
    ratios: dict[str, FloatArray]
    which: npt.NDArray[np.int64]


def resolve(plant: Plant, events: Sequence[FaultEvent]) -> tuple[FaultEvent, ...]:
    """Return the events in order of time, with fault names replaced by their parameters.

    Raises
    ------
    SimulationError
        If the plant has no such parameter.
    """
    named = {fault.name: fault.parameter for fault in plant.faults}
    resolved = []
    for event in events:
        parameter = named.get(event.parameter, event.parameter)
        if parameter not in plant.parameters:
            known = ", ".join(plant.parameters)
            raise SimulationError(f"fault {event}: plant {plant.kind} has no {event.parameter}, only {known}")
        resolved.append(FaultEvent(parameter, event.ratio, event.at_s, event.ramp_s))
    return tuple(sorted(resolved, key=lambda event: event.at_s))


def schedule(plant: Plant, events: Sequence[FaultEvent], samples: int, sample_rate: float) -> Schedule:
    """Lay the plants of some events along the samples of a recording.

    A change acts from the first sample at or after its time. A ramp becomes stretches of at most 0.1 s,
    each with the ratios of its middle.

    Parameters
    ----------
    plant
        The nominal plant.
    events
        Events as `resolve` returns them; a later event of the same parameter takes over where the earlier
        one stands.
    samples, sample_rate
        Length [samples] and rate [Hz] of the recording.

    Raises
    ------
    SimulationError
        If an event lies after the end.
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
    stretch = max(1, int(_GRID * sample_rate + 1e-9))
    grid = np.arange(0, samples, stretch)
    starts.update(int(k) for k in grid[changing[grid]])
    edges = np.array(sorted(k for k in starts if k < samples), dtype=np.int64)
    ends = np.append(edges[1:], samples)
    middles = 0.5 * (edges + ends)
    ratios = {
        name: _ratio(name, events, middles, sample_rate) for name in sorted({event.parameter for event in events})
    }
    plants = tuple(
        plant.with_ratios({name: float(values[i]) for name, values in ratios.items()}) for i in range(edges.size)
    )
    which = np.repeat(np.arange(edges.size, dtype=np.int64), ends - edges)
    return Schedule(plants, ratios, which)


def words(plan: Schedule) -> list[str]:
    """Say of each plant of a schedule how it differs from the nominal one."""
    return [
        ", ".join(f"{name} x {values[i]:g}" for name, values in plan.ratios.items()) or "its nominal plant"
        for i in range(len(plan.plants))
    ]


def _first_sample(time: float, sample_rate: float) -> int:
    return int(np.ceil(time * sample_rate - 1e-6))


def _ratio(parameter: str, events: Sequence[FaultEvent], middles: FloatArray, sample_rate: float) -> FloatArray:
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
