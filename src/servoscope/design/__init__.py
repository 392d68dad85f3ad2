"""Before deployment: which faults can be detected and told apart, and at which size."""

from servoscope.design.result import BaselineStudy, DesignStudy, DirectionStudy, FaultStudy
from servoscope.design.scenario import Scenario
from servoscope.design.study import design_study, study, study_baseline

__all__ = [
    "BaselineStudy",
    "DesignStudy",
    "DirectionStudy",
    "FaultStudy",
    "Scenario",
    "design_study",
    "study",
    "study_baseline",
]
