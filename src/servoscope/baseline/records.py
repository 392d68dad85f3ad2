"""The small records of a baseline: what it was learned from, what it promises, and what the exact predictor says."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from typing import Any, Self, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict

from servoscope.core.arrays import FloatArray
from servoscope.estimation.noise_model import WhiteNoise
from servoscope.models.loop import Loop

Value = TypeVar("Value")

# what a baseline remembers: computed from the fields of its loop alone, or from any but some that stand beside it
OF_LOOP, OF_ALL = ("loop", "_pipeline"), ("baseline_run", "bias", "fault_directions")
LOOP_FIELDS = {"loop", "loop_settings", "stage_one", "still_speed", "instrument"}
SEPARATE_FIELDS = {"features", "point", "others"}


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
    h = hashlib.sha256(loop.hash().encode())
    for array in arrays:
        h.update(np.ascontiguousarray(array).tobytes())
    return h.hexdigest()[:16]
