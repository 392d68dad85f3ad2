"""Before anything else: is this log usable, and if not, why."""

from servoscope.learning.inspection.inspect import Inspection, InspectionTraces, inspect
from servoscope.learning.inspection.rules import InspectionFinding

__all__ = ["Inspection", "InspectionFinding", "InspectionTraces", "inspect"]
