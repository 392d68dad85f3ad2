"""All that is measured on a recording before anything is concluded from it, ready for JSON."""

from __future__ import annotations

from servoscope.core.messages import Message, MessageText, message
from servoscope.learning.inspection.delay import Delay
from servoscope.learning.inspection.excitation import MIN_PERIODS, Band, FrequencyExcitation
from servoscope.learning.inspection.model_order import ModelOrderFit
from servoscope.learning.inspection.residual import Residual
from servoscope.learning.inspection.signals import (
    DeadZone,
    DefectCount,
    InspectionModel,
    Quantisation,
    Rest,
    Sampling,
    Saturation,
)
from servoscope.learning.inspection.simulation_fit import FreeRun


class Coefficient(InspectionModel):
    """A coefficient over the whole recording, with its standard deviation."""

    value: float
    std: float


class InverseModelFit(InspectionModel):
    """The inverse model fitted to the whole recording.

    Parameters
    ----------
    model
        In words.
    coefficients
        By name.
    used_share
        Share of the samples used: filters settled, output not at rest.
    explained, explained_ungated
        Share of the variance of the filtered u that is explained one step ahead, without and with rest.
    condition, weakest
        Condition number of the scaled R_phi, and its weakest direction in words.
    leading, leading_share
        Name of the coefficient that carries most of u (the offset aside), and how much (rms over rms).
    wrong_sign
        Name of the coefficient that carries most of u, where it is negative: u or y has the wrong sign.
    """

    model: MessageText
    coefficients: dict[str, Coefficient]
    used_share: float
    explained: float
    explained_ungated: float
    condition: float
    weakest: str
    leading: str
    leading_share: float
    wrong_sign: str | None


class InspectionMeasurements(InspectionModel):
    """All that is measured on a recording; parts that could not be measured are None or empty.

    `cutoff_hz` is the state-variable filter's in the fit, `suggested_cutoff_hz` what the recording asks for;
    `orders` are the generic inverses tried, the best of them in `best_order`; `periods` is how many periods of
    the reference the recording holds, None where it does not repeat.
    """

    recording: str
    loop: str | None
    sampling: Sampling
    defects: tuple[DefectCount, ...]
    quantisation: tuple[Quantisation, ...]
    saturation: Saturation | None = None
    swapped: MessageText | None = None
    dead_zone: DeadZone | None = None
    rest: Rest | None = None
    band: Band | None = None
    periods: float | None = None
    frequencies: tuple[FrequencyExcitation, ...] = ()
    cutoff_hz: float | None = None
    suggested_cutoff_hz: float | None = None
    orders: tuple[ModelOrderFit, ...] = ()
    best_order: ModelOrderFit | None = None
    fit: InverseModelFit | None = None
    delay: Delay | None = None
    free_run: FreeRun | None = None
    residual: Residual | None = None

    @property
    def coherent(self) -> bool:
        """Whether the recording holds enough periods of the reference to judge coherence."""
        return self.periods is None or self.periods >= MIN_PERIODS


def describe_order(fit: ModelOrderFit) -> Message:
    """Return what a generic inverse consists of."""
    terms = ["stiffness"] * fit.stiffness + ["coulomb"] * (fit.friction == "coulomb") + ["offset"]
    return message("inspection.generic_plant", order=fit.order, terms=[message(f"inspection.{term}") for term in terms])
