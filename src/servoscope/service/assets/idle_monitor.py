"""What stands for a monitor where a machine is judged window by window: nothing is known of it in between."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.detection.covariate_monitor import CovariateHistory
from servoscope.diagnosis.monitor import Monitor


class IdleMonitor:
    """A monitor without state and evaluations."""

    lane_key = None

    def init(self) -> FloatArray:
        """Return the state, which is empty."""
        return np.zeros(0)

    def run_lanes(self, states: FloatArray, *signals: object, **channels: object) -> tuple[FloatArray, None]:
        """Return the states and no evaluations."""
        return states, None

    def covariate_history(self, state: FloatArray) -> CovariateHistory:
        """Return that nothing is known of covariates: a joint that is missing is a gap."""
        return {}


Follower: TypeAlias = Monitor | IdleMonitor
