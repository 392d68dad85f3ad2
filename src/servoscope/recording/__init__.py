"""A recording: r, u and y of one asset on one clock, and the defects that were found on the way in."""

from servoscope.recording.cleaning import LEAST_SAMPLES, clean
from servoscope.recording.defects import Defect
from servoscope.recording.recorded import Recording, with_defects

__all__ = ["LEAST_SAMPLES", "Defect", "Recording", "clean", "with_defects"]
