"""The small records of a baseline: what it was learned from, what it promises, and what the exact predictor says."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

from servoscope.estimation.noise_model import WhiteNoise


class BaselineModel(BaseModel):
    """What the records of a baseline have in common: frozen, checked, without numbers that JSON cannot hold."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class BaselineSource(BaselineModel):
    """A recording that the baseline was learned from."""

    name: str
    samples: int
    duration_s: float


class DetectableChange(BaselineModel):
    """The smallest change that the baseline promises to see, relative: 0.05 is 5 %; None: none at all."""

    name: str
    parameter: str
    change: float | None


class ExactPredictorFit(BaselineModel):
    """What the exact predictor, of which the refit makes use, says of the healthy recordings."""

    noise: WhiteNoise  # n_u and n_y that make their innovations likeliest
    # what it leaves unexplained in the worst of them, over what noise leaves in all but one of a thousand: the refit
    # is made where this is at most 1
    misfit: float
