"""Before deployment: which faults can be detected and told apart, at which size, after how long."""

from servoscope.design.isolability_pairs import explanation_distances
from servoscope.design.result import DesignStudy, DirectionStudy, FaultStudy
from servoscope.design.scenario import Scenario
from servoscope.design.study import design_study, study

__all__ = ["DesignStudy", "DirectionStudy", "FaultStudy", "Scenario", "design_study", "explanation_distances", "study"]
