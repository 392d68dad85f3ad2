"""After an alarm: the refit of the seconds around the onset by maximum likelihood on the exact sampled plant."""

from servoscope.refinement.causes import Cause, causes
from servoscope.refinement.refining import MOST, Hypothesis, Refined, refine

__all__ = ["MOST", "Cause", "Hypothesis", "Refined", "causes", "refine"]
