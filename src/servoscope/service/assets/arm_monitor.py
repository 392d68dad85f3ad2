"""What stands for a monitor where an arm is followed: nothing is known of it between two examinations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from servoscope.baseline.arm import ArmBaseline
from servoscope.core.arrays import FloatArray
from servoscope.detection.covariate_monitor import CovariateHistory
from servoscope.detection.trace import Trace
from servoscope.diagnosis.monitor import Monitor
from servoscope.estimation.frequency_response import FrequencyResponse

_NONE = np.zeros(0)
_NO_RESPONSE = FrequencyResponse(_NONE, np.zeros((0, 0), dtype=complex), np.zeros((0, 0, 2, 2)))
NO_EVALUATIONS = Trace(
    *(_NONE, (), np.zeros((0, 0)), np.zeros((0, 0, 0)), np.zeros((0, 0)), _NONE, 1.0, _NONE, _NONE),
    *(_NO_RESPONSE, _NO_RESPONSE, np.zeros(0, dtype=np.bool_)),
)


class ArmMonitor:
    """A monitor without state and evaluations; the torques of an arm need minutes to say something of its joints."""

    lane_key = None

    def __init__(self, baseline: ArmBaseline) -> None:
        self.baselines = (baseline,)

    def init(self) -> FloatArray:
        """Return the state, which is empty."""
        return np.zeros(0)

    def run(
        self,
        state: FloatArray,
        r: npt.ArrayLike,
        u: npt.ArrayLike,
        y: npt.ArrayLike,
        restart: npt.ArrayLike | None = None,
        *,
        channels: Mapping[str, npt.ArrayLike] | None = None,
    ) -> tuple[FloatArray, Trace]:
        """Return the state and no evaluations."""
        return state, NO_EVALUATIONS

    def covariate_history(self, state: FloatArray) -> CovariateHistory:
        """Return that nothing is known of covariates: a joint that is missing is a gap."""
        return {}


AnyMonitor: TypeAlias = Monitor | ArmMonitor
