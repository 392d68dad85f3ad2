"""Closed loops with known faults: recordings beside their truth, and fast noise-free responses."""

from servoscope.simulation.closed_loop import Truth, response, simulate
from servoscope.simulation.faults import FaultEvent
from servoscope.simulation.references import reference
from servoscope.simulation.stability import check_stable, closed_loop_poles

__all__ = ["FaultEvent", "Truth", "check_stable", "closed_loop_poles", "reference", "response", "simulate"]
