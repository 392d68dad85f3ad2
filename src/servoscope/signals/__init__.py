"""A recording: r, u and y of one asset on one clock, and the defects that were found on the way in."""

from servoscope.signals.cleanup import MIN_SAMPLES, clean
from servoscope.signals.defects import Defect
from servoscope.signals.recording import Recording, with_defects
from servoscope.signals.samples import Samples

__all__ = ["MIN_SAMPLES", "Defect", "Recording", "Samples", "clean", "with_defects"]
