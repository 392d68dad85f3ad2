"""The stretch of a recording that a refinement looks at, and its innovations under any change of the plant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from servoscope.baseline import Baseline
from servoscope.loop import Loop
from servoscope.plants import FloatArray, Plant
from servoscope.recording import Recording
from servoscope.refinement.kernels import Array, BoolArray
from servoscope.refinement.predictor import Bench, Predictor

PIECES = 8  # of a drift, within which the predictor changes in straight lines
TINY = 1e-30  # complex step
SENSOR_GAIN = "sensor_gain"
"""What stands among the parameters for a factor on y as measured."""


@dataclass(frozen=True)
class Growth:
    """How a change comes: from sample `since` of the window on, over so many samples; 0 is a step.

    The logarithms of the parameters change linearly in between.
    """

    since: int
    over: int = 0

    @property
    def shares(self) -> FloatArray:
        """Shares of the change that the plants after the healthy one have, shape (p - 1,); in between it is linear."""
        return np.arange(1, PIECES + 1) / PIECES if self.over else np.ones(1)


@dataclass(frozen=True, eq=False)
class Window:
    """What a predictor sees.

    Parameters
    ----------
    bench
        Where predictors are made.
    plant
        The healthy plant as learned.
    prior
        Inverse of a root of the covariance of the logarithms of its parameters, shape (m, m); empty where they are
        exact.
    first
        Sample of the recording at which the window begins.
    u, y
        What acted on the plant, and what was measured, shape (N,).
    restart
        Whether a sample is the first one after a gap, shape (N,).
    """

    bench: Bench
    plant: Plant
    prior: FloatArray
    first: int
    u: FloatArray
    y: FloatArray
    restart: BoolArray

    @classmethod
    def of(cls, baseline: Baseline, recording: Recording, first: int, end: int) -> Window:
        """Cut samples `first` to `end` out of a recording; the baseline has an exact predictor."""
        if baseline.exact is None:
            raise ValueError("a window needs a baseline with an exact predictor")
        C = np.array(baseline.ratios_covariance)
        prior = np.linalg.inv(np.linalg.cholesky(C)) if len(C) else np.zeros((0, 0))
        bench = Bench.of(baseline.loop, baseline.exact.noise, recording.u)
        u = _delayed(acting(baseline.loop, recording.u), recording.restart, bench.whole)
        return cls(bench, baseline.plant, prior, 0, u, recording.y, recording.restart).cut(first, end)

    def cut(self, first: int, end: int) -> Window:
        """Return samples `first` to `end` of it."""
        restart = self.restart[first:end].copy()
        restart[0] = True
        return replace(self, first=self.first + first, u=self.u[first:end], y=self.y[first:end], restart=restart)

    @property
    def samples(self) -> int:
        """Length N."""
        return len(self.y)

    @property
    def nuisances(self) -> int:
        """Number m of healthy parameters that are not quite known."""
        return len(self.prior)

    @cached_property
    def healthy(self) -> Predictor:
        """The predictor of the healthy plant as learned."""
        return self.bench.predictor(self.plant)

    def predictor(self, d: Array, names: Sequence[str], x: Array, growth: Growth) -> Predictor:
        """Return the predictors of the healthy plant and of all that follow.

        Parameters
        ----------
        d
            Error of the logarithms of the healthy parameters, shape (m,).
        names, x
            Parameters that change, or `SENSOR_GAIN`, and by how much their logarithms do, shape (len(names),).
        growth
            When.
        """
        healthy = dict(zip(self.plant.parameters, np.exp(d), strict=True)) if np.any(d) else {}
        each = [self.bench.predictor(self.plant.scaled(healthy)) if healthy else self.healthy]
        for share in growth.shares:
            ill = dict(healthy)
            for name, value in zip(names, np.exp(share * x), strict=True):
                ill[name] = ill.get(name, 1.0) * value
            output_gain = ill.pop(SENSOR_GAIN, 1.0)
            each.append(self.bench.predictor(self.plant.scaled(ill), output_gain))
        return Predictor.of([_as(one, np.result_type(*(e.A for e in each))) for one in each])

    def innovations(self, predictor: Predictor, growth: Growth) -> Array:
        """Return the innovations in standard deviations, shape (N,)."""
        return predictor.innovations(growth.since, growth.over, self.u, self.y, self.restart)

    def residual(self, z: Array, names: Sequence[str], growth: Growth) -> Array:
        """Return what least squares makes small: innovations and prior, shape (N + m,), at z = [d, x]."""
        d, x = z[: self.nuisances], z[self.nuisances :]
        e = self.innovations(self.predictor(d, names, x, growth), growth)
        return np.concatenate([e, self.prior @ d])

    def jacobian(self, z: FloatArray, names: Sequence[str], growth: Growth, by: slice = slice(None)) -> FloatArray:
        """Return the derivatives of `residual` by the unknowns that `by` selects, shape (N + m, k).

        By complex steps: no difference is taken, so nothing is lost by rounding (Squire and Trapp, 1998).
        """
        columns = []
        for i in np.arange(len(z))[by]:
            moved = z.astype(np.complex128)
            moved[i] += 1j * TINY
            columns.append(self.residual(moved, names, growth).imag / TINY)
        return np.array(columns).reshape(-1, self.samples + self.nuisances).T

    def disturbed(self, predictor: Predictor, growth: Growth, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return what disturbances of u and of y, shape (N,), add to the innovations: they are linear in both."""
        restart = np.zeros_like(self.restart)
        return np.asarray(predictor.innovations(growth.since, growth.over, u, y, restart), dtype=np.float64)


def acting(loop: Loop, u: FloatArray) -> FloatArray:
    """Return what acted on the plant, shape (N,): u within its limits, and nothing inside the dead zone."""
    if loop.input_logged == "before_limiter" and loop.input_limits is not None:
        u = np.clip(u, *loop.input_limits)
    if loop.input_deadzone is not None:
        low, high = loop.input_deadzone
        u = np.where((u >= low) & (u <= high), 0.0, u)
    return u


def _delayed(u: FloatArray, restart: BoolArray, samples: int) -> FloatArray:
    """Return u as it was some samples before, run by run."""
    k = np.arange(len(u))
    begin = np.maximum.accumulate(np.where(restart, k, 0))
    return np.asarray(u[np.maximum(k - samples, begin)])


def _as(predictor: Predictor, dtype: np.dtype[np.generic]) -> Predictor:
    return Predictor(*(part.astype(dtype) for part in predictor))
