"""What `learn` keeps of a healthy motor axis for its refit: coefficients, how well they are known, and the noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np
from pydantic import Field

from servoscope.baseline.covariates import CovariateModel
from servoscope.baseline.records import BaselineModel, Matrix, Vector
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
        along = self.by_coefficient(channels)
        inertia = along["inertia"]
        return np.array([1.0 / inertia, *(along[column.coefficient] / inertia for column in plant.acting)])

    def by_coefficient(self, channels: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Return what multiplies each coefficient along a recording, shape (N,)."""
        return dict(zip(self.names, self.covariates.factors(channels).T, strict=True))


class AxisSums(BaselineModel):
    """What the sums over blocks of healthy recordings teach of p coefficients, for changes within a recording."""

    names: tuple[str, ...]
    theta: Vector
    unit: Vector  # what scatter and changes are relative to
    kappa: float  # of the noise: the covariance of a block's score is kappa A
    within: Matrix  # covariances of the coefficients (p, p): between stretches of a recording,
    between: Matrix  # and recordings
    inflation: float  # of the covariance of long stretches, for neighbouring blocks err alike
    degrees: float  # of freedom that `between` is known with
    unexplained: float  # mean square of what a fit to a block leaves
    recordings: int
    left_out: Vector  # evidence of each recording when it is left out of learning [nats]
    limit: float  # of the evidence
    rest_speed: float  # below, rows do not count [output per s]

    def at(self, factors: Mapping[str, float], shifts: Mapping[str, float]) -> AxisSums:
        """Return what `AxisModel.at` does; scatter stays as large, relative to the coefficients."""
        factor = np.array([factors.get(name, 1.0) for name in self.names])
        theta = factor * np.array(self.theta) + [shifts.get(name, 0.0) for name in self.names]
        scaled = {
            name: tuple(map(tuple, (np.outer(factor, factor) * np.array(getattr(self, name))).tolist()))
            for name in ("within", "between")
        }
        unit = (factor * np.array(self.unit)).tolist()
        return self.model_copy(update={"theta": tuple(theta.tolist()), "unit": tuple(unit), **scaled})


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
    # of baselines before 2.0, which looked for changes in another way: read, and not used
    change_limit: float = Field(default=0.0, exclude=True)
    # what the squared t statistic of a vibration that begins within a recording has to exceed, where healthy ones
    # exceed what chance explains; 0 where they do not
    vibration_limit: float = 0.0
    # None in baselines before 2.0, which find no change within a recording
    changes: AxisSums | None = Field(default=None, exclude_if=lambda changes: changes is None)
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
        changes = None if self.changes is None else self.changes.at(factors, shifts)
        return self.model_copy(update={"coefficients": moved, "moves": None, "changes": changes})

    def plant(self, declared: AxisPlant) -> AxisPlant:
        """Return the plant of the loop file with these coefficients."""
        return declared.model_copy(update={"coefficients": self.coefficients})
