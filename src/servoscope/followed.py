"""What a monitor keeps of one baseline: the pipeline, and what its evaluations are compared with."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from servoscope import ifrf
from servoscope.baseline import Baseline
from servoscope.ifrf import Response
from servoscope.pipeline import Pipeline
from servoscope.plants import FloatArray
from servoscope.twostage import Stage

if TYPE_CHECKING:
    from servoscope.recursion import Constants


def clock(baseline: Baseline) -> Hashable:
    """Return what all assets of one monitor must have in common."""
    loop = baseline.loop
    return loop.sample_rate, loop.monitor.evaluation_rate, baseline.names, loop.monitor.frequencies


@dataclass(frozen=True, eq=False)
class Followed:
    """What a monitor keeps of one baseline: everything but state."""

    pipeline: Pipeline
    stage: Stage
    head: int
    constants: Constants
    origin: FloatArray
    healthy: Response

    @classmethod
    def of(cls, baseline: Baseline) -> Followed:
        """Turn a baseline into constants; the bias under its references is taken out of estimate and expectation."""
        from servoscope.recursion import View

        pipeline, stage = baseline.pipeline(), Stage(baseline.loop, baseline.stage_one)
        frequencies, origin = baseline.loop.monitor.frequencies, np.array(baseline.theta) - baseline.bias
        E = pipeline.bank.E(frequencies)
        response = np.stack([E.real, E.imag], axis=1).reshape(2 * len(E), -1)
        view = View(baseline.cov(), origin, response, baseline.loop.sample_rate)
        constants = pipeline.constants(baseline.tuning, baseline.watch(pipeline), view)
        healthy = ifrf.response(pipeline.bank, frequencies, origin, baseline.cov())
        return cls(pipeline, stage, pipeline.valve.size + stage.size, constants, origin, healthy)
