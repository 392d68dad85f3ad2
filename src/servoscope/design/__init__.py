"""Before deployment: which faults can be detected and told apart, at which size, after how long."""

from servoscope.design.designing import design_study
from servoscope.design.findings import FaultStudy, Side, Study
from servoscope.design.pairs import explanations
from servoscope.design.scene import Scene
from servoscope.design.studying import study

__all__ = ["FaultStudy", "Scene", "Side", "Study", "design_study", "explanations", "study"]
