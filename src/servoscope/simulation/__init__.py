"""Closed loops with known faults: recordings beside their truth, and fast noise-free responses."""

from servoscope.simulation.closed_loop import simulate, simulate_response
from servoscope.simulation.cylinder import CylinderRig, CylinderTruth, cylinder_motion, simulate_cylinder
from servoscope.simulation.faults import FaultEvent
from servoscope.simulation.measurement import Truth
from servoscope.simulation.nonlinear_eha import Rig, RigTruth, simulate_rig
from servoscope.simulation.references import reference
from servoscope.simulation.stability import check_stable, closed_loop_poles

__all__ = [
    "CylinderRig",
    "CylinderTruth",
    "FaultEvent",
    "Rig",
    "RigTruth",
    "Truth",
    "check_stable",
    "closed_loop_poles",
    "cylinder_motion",
    "reference",
    "simulate",
    "simulate_cylinder",
    "simulate_response",
    "simulate_rig",
]
