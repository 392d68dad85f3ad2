"""Before deployment: which faults can be detected and told apart, and at which size."""

from servoscope.design.result import DesignStudy, DirectionStudy, FaultStudy, LearnedStudy
from servoscope.design.scenario import Scenario
from servoscope.design.study import design_study, study, study_baseline

__all__ = [
    "DesignStudy",
    "DirectionStudy",
    "FaultStudy",
    "LearnedStudy",
    "Scenario",
    "design_study",
    "study",
    "study_baseline",
]
