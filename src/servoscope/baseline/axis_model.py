"""What `learn` keeps of a healthy motor axis for its refit: coefficients, how well they are known, and the noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np
from pydantic import Field

from servoscope.baseline.covariates import CovariateModel
from servoscope.baseline.records import BaselineModel, Matrix
from servoscope.core.arrays import FloatArray
from servoscope.estimation.axis_filter import NO_LAG, AxisNoise, DriveLag
from servoscope.models.plants import Fault
from servoscope.models.plants.axis import BY_DIRECTION, FRICTION, FRICTION_FAULT, AxisPlant


class AxisMoves(BaselineModel):
    """How covariates move the coefficients of an axis along a recording."""

    covariates: CovariateModel
    names: tuple[str, ...]  # of the coefficients that its slopes are about

    def factors(self, plant: AxisPlant, channels: Mapping[str, FloatArray]) -> FloatArray:
        """Return what multiplies u and the terms in ``y'' = b u - sum a_i column_i``, shape (1 + terms, N)."""
        along = dict(zip(self.names, self.covariates.factors(channels).T, strict=True))
        inertia = along["inertia"]
        return np.array([1.0 / inertia, *(along[column.coefficient] / inertia for column in plant.acting)])


class AxisModel(BaselineModel):
    """A healthy motor axis with friction, in the unit of ``input_gain u``."""

    coefficients: dict[str, float]  # all of the plant's
    parameters: tuple[str, ...]  # those of which the logarithm is known with `covariance` (m, m), between recordings
    covariance: Matrix
    noise: AxisNoise
    # how late the force follows u, beyond the delay of the loop file
    drive: Annotated[DriveLag, Field(exclude_if=lambda drive: not any(drive))] = NO_LAG
    stride: int  # samples of a recording from one of the filter to the next
    rest_speed: float  # below, the axis counts as resting [output per s]
    offset_std: float  # how far the constant force of a recording may be from that of the others
    drift_std: float  # and how much it may change within one
    # coefficients that the healthy recordings do not show, and how far one recording's estimate may be from them
    unseen: dict[str, float] = Field(default={})
    # what twice the log-likelihood ratio of a change within a recording has to exceed, where healthy ones exceed what
    # chance explains; 0 where they do not
    change_limit: float = 0.0
    # the same for the squared t statistic of a vibration that begins within a recording
    vibration_limit: float = 0.0
    # what covariates do to the coefficients, which are those of the middle of the learned range then
    moves: AxisMoves | None = Field(default=None, exclude_if=lambda moves: moves is None)

    def scatter(self, names: Sequence[str]) -> FloatArray:
        """Return the standard deviations of coefficients between recordings, shape (len(names),)."""
        std = dict(zip(self.parameters, np.sqrt(np.diag(np.array(self.covariance))), strict=True))
        known = {name: float(std[name]) * abs(self.coefficients[name]) for name in self.parameters}
        return np.array([(known | self.unseen | {"offset": self.offset_std}).get(name, 0.0) for name in names])

    def with_scatter(self, earlier: AxisModel) -> AxisModel:
        """Return the axis with the relative scatter of an earlier one, where that is larger."""
        C, known = np.array(self.covariance), dict(zip(earlier.parameters, earlier.covariance, strict=True))
        for i, name in enumerate(self.parameters):
            C[i, i] = max(C[i, i], known[name][earlier.parameters.index(name)] if name in known else 0.0)
        return self.model_copy(update={"covariance": tuple(map(tuple, C.tolist()))})

    def visible_faults(self, faults: Sequence[Fault]) -> tuple[Fault, ...]:
        """Return those faults that multiply something that the healthy recordings show; all friction: all of it."""
        both = {"viscous_friction": BY_DIRECTION} if "viscous_friction" not in self.coefficients else {}
        faults = [
            f for f in faults if f.name != FRICTION_FAULT[0] or not set(FRICTION + BY_DIRECTION) & set(self.unseen)
        ]
        return tuple(
            fault for fault in faults if not set(both.get(fault.parameter, (fault.parameter,))) <= set(self.unseen)
        )

    def at(self, factors: Mapping[str, float], shifts: Mapping[str, float]) -> AxisModel:
        """Return the axis at some covariates: coefficients multiplied or, where no factor is known, shifted."""
        moved = {
            name: value * factors.get(name, 1.0) + shifts.get(name, 0.0) for name, value in self.coefficients.items()
        }
        return self.model_copy(update={"coefficients": moved, "moves": None})

    def plant(self, declared: AxisPlant) -> AxisPlant:
        """Return the plant of the loop file with these coefficients."""
        return declared.model_copy(update={"coefficients": self.coefficients})
