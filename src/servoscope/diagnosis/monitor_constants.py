"""What a monitor takes from one baseline once, and what the assets of one monitor must have in common."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.baseline.baseline import Baseline
from servoscope.core.arrays import FloatArray
from servoscope.detection.baseline_run import cusum_constants
from servoscope.diagnosis.side_monitors import SideMonitors
from servoscope.estimation import frequency_response
from servoscope.estimation.frequency_response import FrequencyResponse
from servoscope.estimation.pipeline import Pipeline
from servoscope.estimation.recursion import EvaluationConstants, RecursionConstants


def compatibility_key(baseline: Baseline) -> tuple[Hashable, ...]:
    """Return the properties that all assets of one monitor must share."""
    loop = baseline.loop
    return loop.sample_rate, loop.monitor.evaluation_rate, baseline.names, loop.monitor.frequencies


@dataclass(frozen=True, eq=False)
class MonitorConstants:
    """The part of a monitor that comes from one baseline and never changes."""

    pipeline: Pipeline
    constants: RecursionConstants
    expected_theta: FloatArray
    healthy: FrequencyResponse
    side: SideMonitors

    @classmethod
    def from_baseline(cls, baseline: Baseline) -> MonitorConstants:
        """Derive the constants; the bias under the baseline's references is taken out of estimate and expectation."""
        pipeline, side = baseline.pipeline(), SideMonitors(baseline, baseline.pipeline())
        frequencies, expected = baseline.loop.monitor.frequencies, np.array(baseline.theta) - baseline.bias
        E = pipeline.bank.E(frequencies)
        response = np.stack([E.real, E.imag], axis=1).reshape(2 * len(E), -1)
        settled, rate = baseline.settled_after, baseline.loop.sample_rate
        covariance = baseline.covariance_array(), baseline.covariance_after(np.array(np.inf))
        evaluation = EvaluationConstants(covariance[0], expected, response, rate, covariance[1], settled)
        constants = pipeline.constants(baseline.tuning, cusum_constants(baseline, pipeline), evaluation)
        healthy = frequency_response.frequency_response(
            pipeline.bank, frequencies, expected, baseline.covariance_array()
        )
        return cls(pipeline, constants, expected, healthy, side)


def deduplicate(values: Sequence[npt.NDArray[Any]]) -> npt.NDArray[Any]:
    """Stack arrays; where all are the same object, it stands once, with a first axis of length one."""
    return np.array(values if len({id(value) for value in values}) > 1 else values[:1])
