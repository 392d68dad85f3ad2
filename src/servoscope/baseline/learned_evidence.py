"""What a baseline holds of each kind of evidence beside the coefficients."""

from __future__ import annotations

from pydantic import Field

from servoscope.baseline.axis_model import AxisModel
from servoscope.baseline.covariates import CovariateModel
from servoscope.baseline.feature_model import FeatureModel
from servoscope.baseline.motion import MotionRange
from servoscope.baseline.pressure_model import PressureModel
from servoscope.baseline.records import BaselineMemory
from servoscope.baseline.residual_model import ResidualModel
from servoscope.baseline.sensors import SensorModel


class LearnedEvidence(BaselineMemory):
    """The models of all kinds of evidence, None where healthy recordings show none; a field is named as its kind."""

    sensors: SensorModel | None = None
    features: FeatureModel | None = None
    motion: MotionRange | None = None
    axis: AxisModel | None = None
    covariates: CovariateModel | None = None
    residual: ResidualModel | None = Field(default=None, exclude_if=lambda value: value is None)
    pressures: PressureModel | None = Field(default=None, exclude_if=lambda value: value is None)
