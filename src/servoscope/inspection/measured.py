"""All that is measured on a recording before anything is concluded from it, ready for JSON."""

from __future__ import annotations

from servoscope.inspection.alignment import Delay
from servoscope.inspection.excitation import LEAST_PERIODS, Band, Excited
from servoscope.inspection.freerun import FreeRun
from servoscope.inspection.leftover import Residual
from servoscope.inspection.levels import DeadZone, DefectCount, Quantisation, Rest, Said, Sampling, Saturation
from servoscope.inspection.modelfit import OrderTried


class Coefficient(Said):
    """A coefficient over the whole recording, with its standard deviation."""

    value: float
    std: float


class Fit(Said):
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

    model: str
    coefficients: dict[str, Coefficient]
    used_share: float
    explained: float
    explained_ungated: float
    condition: float
    weakest: str
    leading: str
    leading_share: float
    wrong_sign: str | None


class Measured(Said):
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
    swapped: str | None = None
    dead_zone: DeadZone | None = None
    rest: Rest | None = None
    band: Band | None = None
    periods: float | None = None
    frequencies: tuple[Excited, ...] = ()
    cutoff_hz: float | None = None
    suggested_cutoff_hz: float | None = None
    orders: tuple[OrderTried, ...] = ()
    best_order: OrderTried | None = None
    fit: Fit | None = None
    delay: Delay | None = None
    free_run: FreeRun | None = None
    residual: Residual | None = None

    @property
    def coherent(self) -> bool:
        """Whether the recording holds enough periods of the reference to judge coherence."""
        return self.periods is None or self.periods >= LEAST_PERIODS


def described(order: OrderTried) -> str:
    """Say what a generic inverse consists of."""
    parts = ["stiffness"] * order.stiffness + ["Coulomb friction"] * (order.friction == "coulomb") + ["offset"]
    return f"an inverse of order {order.order} with {', '.join(parts)}"
