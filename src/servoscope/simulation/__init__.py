"""Closed loops with known faults: recordings beside their truth, and fast noise-free responses."""

from servoscope.simulation.closed_loop import Truth, response, simulate
from servoscope.simulation.faults import FaultEvent
from servoscope.simulation.references import reference
from servoscope.simulation.rig import Rig, RigTruth, simulate_rig
from servoscope.simulation.stability import check_stable, closed_loop_poles

__all__ = [
    "FaultEvent",
    "Rig",
    "RigTruth",
    "Truth",
    "check_stable",
    "closed_loop_poles",
    "reference",
    "response",
    "simulate",
    "simulate_rig",
]
