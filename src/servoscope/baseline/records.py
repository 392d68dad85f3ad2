"""The small records of a baseline: what it was learned from, what it promises, and what the exact predictor says."""

from __future__ import annotations

import hashlib
import operator
from collections.abc import Callable, Mapping
from typing import Any, Literal, Self, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from servoscope.baseline.hypothesis import CusumHypothesis
from servoscope.baseline.threshold import CalibrationFactors
from servoscope.core.arrays import FloatArray
from servoscope.estimation.instrument import InstrumentTuning
from servoscope.estimation.noise_model import ArmaNoise, WhiteNoise
from servoscope.estimation.pipeline import Tuning
from servoscope.estimation.two_stage import StageOneTuning
from servoscope.models.loop import Loop
from servoscope.signals.recording import Recording

Value = TypeVar("Value")
Vector = tuple[float, ...]
Matrix = tuple[Vector, ...]

# what a baseline remembers: computed from the fields of its loop alone, or from any but some that stand beside it
OF_LOOP, OF_ALL = ("loop", "_pipeline"), ("baseline_run", "bias", "fault_directions")
LOOP_FIELDS = {"loop", "loop_settings", "recursion"}
SEPARATE_FIELDS = {"features", "residual", "pressures", "point", "others"}


def is_covariance(rows: Matrix) -> bool:
    """Return whether a square matrix is symmetric and positive, but for rounding."""
    C, size = np.array(rows), np.sqrt(np.abs(np.diag(rows)))
    scaled = C / np.outer(size, size) if size.all() else C
    return np.allclose(scaled, scaled.T, atol=1e-6) and bool(np.linalg.eigvalsh((scaled + scaled.T) / 2.0)[0] >= -1e-9)


class BaselineModel(BaseModel):
    """What the records of a baseline have in common: frozen, checked, without numbers that JSON cannot hold."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class BaselineMemory(BaselineModel):
    """What of a baseline is computed from its fields once, and which copies of it that holds for."""

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy with some fields changed, which takes along what does not depend on these."""
        copied, changed = super().model_copy(update=update, deep=deep), set(update or ()) - SEPARATE_FIELDS
        for name in (*OF_ALL, *(OF_LOOP if changed & LOOP_FIELDS else ())) if changed else ():
            if name not in changed:
                vars(copied).pop(name, None)
        return copied

    def remember(self, name: str, make: Callable[[Self], Value]) -> Value:
        """Return what `make` computes from the fields, which is computed once; `name` is one of `OF_ALL`."""
        if name not in vars(self):
            vars(self)[name] = make(self)
        value: Value = vars(self)[name]
        return value

    def __getstate__(self) -> dict[Any, Any]:
        """Return what is pickled: the fields, from which everything is computed anew."""
        state = super().__getstate__()
        fields = {name: value for name, value in vars(self).items() if name not in {*OF_ALL, *OF_LOOP}}
        return {**state, "__dict__": fields}


class BaselineSource(BaselineModel):
    """A recording that the baseline was learned from, as it was before stretches of it were taken."""

    name: str
    samples: int
    duration_s: float
    hash: str = Field(default="", exclude_if=operator.not_)  # of u and y; baselines of 1.0 have none

    @classmethod
    def from_recording(cls, recording: Recording) -> Self:
        """Describe a recording so that it is known again."""
        return cls(
            name=recording.name,
            samples=recording.samples,
            duration_s=recording.duration_s,
            hash=hash_arrays(recording.u, recording.y),
        )

    def fits(self, recording: Recording) -> bool:
        """Tell whether this is the recording, not another of its name."""
        if self.samples != recording.samples:
            return False
        return not self.hash or self.hash == hash_arrays(recording.u, recording.y)


Occasion = Literal["repair", "tool", "product", "season"]
RENEWALS: tuple[Occasion, ...] = ("repair", "tool", "product")  # what was healthy before says nothing of what is now


class Revision(BaselineModel):
    """How a baseline took the place of an earlier one; what `learn` writes is the first of its history."""

    number: int = 1
    kind: Literal["first", "healthy", "back"] | Occasion = "first"
    who: str = ""
    why: str = ""
    at: float | None = None  # when [UTC s]
    parent: int = 0  # number of the one that it was made from, to which one step leads back; 0: none
    reference: int = (
        1  # number of the one that slow changes are judged by: the first, or that after the last accepted change
    )


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


class RecursionTuning(BaselineModel):
    """What the recursion takes (see `servoscope.estimation.pipeline.Tuning`), but for the healthy coefficients."""

    scale: Vector
    P_d: Matrix
    R: float
    # of the residual, see `servoscope.estimation.noise_model.ArmaNoise`
    noise_a: Vector
    noise_b: Vector
    noise_gamma: Vector
    noise_variance: float
    stage_one: StageOneTuning | None = None  # of two stages
    instrument: InstrumentTuning | None = None  # model behind the instrument of a loop without a controller
    # speed below which the axis stands still [output per s]; 0 where rest is part of what is expected
    still_speed: float

    def at(self, theta: FloatArray) -> Tuning:
        """Return the tuning around healthy coefficients (n,)."""
        a, b, gamma = map(np.array, (self.noise_a, self.noise_b, self.noise_gamma))
        noise = ArmaNoise(a, b, gamma, self.noise_variance)
        return Tuning(theta, np.array(self.scale), np.array(self.P_d), self.R, noise)


class HealthyParameters(BaselineModel):
    """The healthy plant; None or empty where the loop has no controller or no physics."""

    noise: WhiteNoise | None = None  # n_u and n_y
    loudest: WhiteNoise | None = None  # the largest that the recordings allow; None where white noises explain nothing
    ratios: dict[str, float] = {}  # parameters relative to the loop file's nominal values
    std: dict[str, float] = {}  # standard deviations of their logarithms
    covariance: Matrix = ()  # of these logarithms, (m, m)
    theta: Vector = ()  # coefficients that they lead to, (n,)


class HealthyScatter(BaselineModel):
    """How healthy recordings differ from each other."""

    # covariance (n, n) of the coefficients between them beyond their noise; empty where there was one recording
    between: Matrix = ()
    left_out: Vector = ()  # largest T^2 of each over its limit when learned without it; empty of less than four
    # variances (n,) of a further recording beyond its noise that a baseline before this one had learned, at the present
    # coefficients, and from how many recordings; they count until this one has learned from as many
    carried: Vector = Field(default=(), exclude_if=lambda value: not value)
    carried_from: int = Field(default=0, exclude_if=lambda value: not value)
    # part (n,) of the covariance's diagonal for what the scatter does while the recursion forgets its start: it counts
    # until the estimate has settled
    transient: Vector = Field(default=(), exclude_if=lambda value: not value)


class AlarmThresholds(BaselineModel):
    """Where both tests raise an alarm."""

    dof: float  # effective number of independent residuals
    statistic: float  # threshold of T^2
    calibration: CalibrationFactors  # counted false alarms over those of theory
    hypotheses: tuple[CusumHypothesis, ...] = ()  # of the sequential test; empty where there is none


class Detectability(BaselineModel):
    """What a baseline is good for."""

    explained: float  # share of eta's variance that the model explains
    suggested_model_error: float  # `model_error` that the recordings ask for
    supported_false_alarms_per_year: float  # smallest budget that they speak for
    # smallest changes that are detected with 90 % probability within the baseline's own excitation
    changes: tuple[DetectableChange, ...]


def parse_stored_loop(settings: Mapping[str, Any]) -> Loop:
    """Return the loop that a baseline was learned with; raises LoopError if it is damaged.

    Without `sequential_step` it was learned when the sequential test knew no other step than each update.
    """
    monitor = settings.get("monitor", {})
    if isinstance(monitor, Mapping):
        settings = {**settings, "monitor": {"sequential_step": "update", **monitor}}
    return Loop.from_dict(settings)


def digest(loop: Loop, arrays: list[FloatArray]) -> str:
    """Return a hash of a loop and of all samples that were learned from: 16 hexadecimal digits."""
    return hash_arrays(*arrays, start=loop.hash())


def hash_arrays(*arrays: FloatArray, start: str = "") -> str:
    """Return a hash of a text and of arrays, bit by bit: 16 hexadecimal digits."""
    h = hashlib.sha256(start.encode())
    for array in arrays:
        h.update(np.ascontiguousarray(array).tobytes())
    return h.hexdigest()[:16]
