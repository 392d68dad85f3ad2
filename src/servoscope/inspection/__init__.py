"""Before anything else: is this log usable, and if not, why."""

from servoscope.inspection.inspecting import Finding, Inspection, Traces, inspect

__all__ = ["Finding", "Inspection", "Traces", "inspect"]
