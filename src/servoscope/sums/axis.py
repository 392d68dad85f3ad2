"""Motor axes and polynomials as equations: the regression of the filter bank, and the faults of the plant."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.verdict import Segment
from servoscope.estimation.frequency_response import FrequencyResponse, frequency_response
from servoscope.estimation.pipeline import Pipeline, Regression, RegressionRunner
from servoscope.models.loop import Loop
from servoscope.models.plants.terms import TermPlant
from servoscope.signals import Recording
from servoscope.sums.healthy import Healthy
from servoscope.sums.records import FaultDirection, Sums

BLOCK_S = 0.5
MIN_PERIODS = 2.0  # of the cutoff in a block, so that it outlasts the memory of the filters
FASTER = 4.0  # times the cutoff, with which the speed is taken that shows a rest
REST_SHARE = 0.02  # of the largest speed, below which an axis rests

Factors = Callable[[Mapping[str, FloatArray]], Mapping[str, FloatArray]]
"""Channels of a recording to what multiplies each coefficient along it, shape (N,)."""


@dataclass(frozen=True, eq=False)
class AxisEquations:
    """The regression ``input_gain u = sum of terms`` behind the loop's filters, and a constant force."""

    pipeline: Pipeline
    rest_speed: float = 0.0  # at which rows do not count, and for as long afterwards as the filters remember
    factors: Factors | None = None  # of covariates, which move the coefficients within a recording

    @classmethod
    def of_loop(cls, loop: Loop, rest_speed: float = 0.0, factors: Factors | None = None) -> AxisEquations:
        """Return the equations of a loop. Raises LoopError as `Pipeline.of`."""
        plain = {"structure": "svf", "estimator": "akf", "two_stage": "none"}
        monitor = loop.monitor.model_copy(update=plain)
        return cls(Pipeline.of(loop.model_copy(update={"monitor": monitor})), rest_speed, factors)

    @classmethod
    def of_healthy(cls, loop: Loop, recordings: Sequence[Recording], factors: Factors | None = None) -> AxisEquations:
        """Return the equations of a loop; healthy recordings show how fast it moves.

        At rest, friction is whatever holds the axis. Raises LoopError as `Pipeline.of`.
        """
        equations = cls.of_loop(loop, factors=factors)
        return replace(equations, rest_speed=REST_SHARE * max(map(equations.largest_speed, recordings)))

    @cached_property
    def motion(self) -> Pipeline:
        """What forms position, speed and acceleration, with a faster filter: rests have to show before they matter."""
        loop = self.pipeline.loop
        cutoff = min(FASTER * loop.cutoff, 0.25 * loop.sample_rate)
        monitor = loop.monitor.model_copy(update={"cutoff": cutoff})
        return Pipeline.of(loop.model_copy(update={"monitor": monitor})).kinematics

    def speed(self, kinematics: Regression) -> FloatArray:
        """Return the speed of each sample, shape (N,), given the regression of `motion`."""
        return kinematics.phi[:, 1 - self.plant.derivative]

    def largest_speed(self, recording: Recording) -> float:
        """Return the largest speed of a recording."""
        moved = self.motion.regression(recording.r, recording.u, recording.y, recording.restart)
        return float(np.abs(self.speed(moved)[moved.ok]).max(initial=0.0))

    @property
    def plant(self) -> TermPlant:
        """The plant of the loop file."""
        assert isinstance(self.pipeline.loop.plant, TermPlant)
        return self.pipeline.loop.plant

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the plant's coefficients; a constant force, which every machine may have, comes last."""
        return (*(name for name in self.plant.names if name != "offset"), "offset")

    @property
    def free(self) -> tuple[int, ...]:
        """The constant force."""
        return (len(self.names) - 1,)

    @property
    def block_s(self) -> float:
        """Length of a block [s]."""
        return max(BLOCK_S, MIN_PERIODS / self.pipeline.loop.cutoff)

    def causes(self, theta: FloatArray) -> tuple[FaultDirection, ...]:
        """Return the faults of the plant that change coefficients (p,)."""
        plant, healthy = self.plant, dict(zip(self.names, theta.tolist(), strict=True))

        def moved(parameter: str) -> FloatArray:
            powers = plant.exponents(parameter, healthy)
            return np.array([powers.get(name, 0.0) for name in self.names]) * theta

        causes = [
            FaultDirection(fault.name, moved(fault.parameter), fault.parameter == "input_gain")
            for fault in plant.faults
            if fault.parameter != "offset"
        ]
        for ray in plant.rays:
            parts = [exponent * moved(name) for name, exponent in ray.exponents.items()]
            causes.append(FaultDirection(ray.name, np.sum(parts, axis=0)))
        return tuple(cause for cause in causes if cause.direction.any())

    def sums(self, recording: Recording) -> Sums:
        """Return the sums of a recording; rows at its end that fill no block are left out."""
        return SumsRunner(self).advance(recording)


def response(healthy: Healthy, segment: Segment, frequencies: npt.ArrayLike) -> FrequencyResponse:
    """Return the inverse frequency response of a stretch of an axis, with its covariance; frequencies (F,) in Hz."""
    equations = healthy.equations
    assert isinstance(equations, AxisEquations)
    bank = equations.pipeline.bank
    at = [equations.names.index(name) for name in bank.names]
    theta = healthy.mean(np.ones(1)) + segment.deviation
    return frequency_response(bank, frequencies, theta[at], segment.covariance[np.ix_(at, at)])


class SumsRunner:
    """Sums up a recording block by block; where it is cut changes nothing."""

    def __init__(self, equations: AxisEquations) -> None:
        self._equations, pipeline = equations, equations.pipeline
        loop = pipeline.loop
        self._regression, self._motion = RegressionRunner(pipeline), RegressionRunner(equations.motion)
        self._memory = pipeline.bank.wait
        self._since_rest = self._memory + 1
        self._size = max(round(equations.block_s * loop.sample_rate), 1)
        self._order = [loop.plant.names.index(name) for name in equations.names[:-1]]
        self._left = np.zeros((0, 2 + len(equations.names)))  # t and rows of the block that is not yet full

    def rows(self, block: Recording) -> FloatArray:
        """Return eta and phi of each sample, shape (N, 1 + p); rows that do not count are 0."""
        regression = self._regression.advance(block.r, block.u, block.y, block.restart)
        counted = regression.ok & self._is_moving(block)
        phi, equations = regression.phi[:, self._order], self._equations
        if equations.factors is not None:
            along = equations.factors(block.channels)
            phi = phi * np.column_stack([along[name] for name in equations.names[:-1]])
        rows = np.column_stack([regression.eta, phi, np.ones(len(block.t))])
        return np.where(counted[:, None], rows, 0.0)

    def advance(self, block: Recording) -> Sums:
        """Return the sums of the blocks that are full with these samples."""
        rows = np.concatenate([self._left, np.column_stack([block.t, self.rows(block)])])
        K = len(rows) // self._size
        full, self._left = np.split(rows, [K * self._size])
        cut = full.reshape(K, self._size, -1)
        return Sums.of_rows(cut[..., 2:], cut[..., 1], cut[:, 0, 0], self._size / block.sample_rate, (1.0,))

    def _is_moving(self, block: Recording) -> BoolArray:
        if not self._equations.rest_speed:
            return np.ones(len(block.t), dtype=np.bool_)
        speed = self._equations.speed(self._motion.advance(block.r, block.u, block.y, block.restart))
        at = np.arange(len(speed))
        slow = np.abs(speed) <= self._equations.rest_speed
        last = np.maximum.accumulate(np.where(slow, at, -1 - self._since_rest))
        since = at - last
        self._since_rest = int(since[-1])
        return np.asarray(since > self._memory)
