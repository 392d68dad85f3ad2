"""The stretch of a recording that a refinement looks at, and its innovations under any change of the plant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.detection.baseline import Baseline
from servoscope.estimation.noise_model import WhiteNoise
from servoscope.isolation.ml.kernels import Array
from servoscope.isolation.ml.predictor import Predictor, PredictorFactory
from servoscope.models.loop import Loop
from servoscope.models.plants import Plant
from servoscope.signals import Recording

PIECES = 8  # of a drift, within which the predictor changes in straight lines
TINY = 1e-30  # complex step
SENSOR_GAIN = "sensor_gain"
"""What stands among the parameters for a factor on y as measured."""


@dataclass(frozen=True)
class ChangeProfile:
    """How a change comes: from sample `since` of the window on, over so many samples; 0 is a step.

    The logarithms of the parameters change linearly in between.
    """

    onset: int
    duration: int = 0

    @property
    def shares(self) -> FloatArray:
        """Shares of the change that the plants after the healthy one have, shape (p - 1,); in between it is linear."""
        return np.arange(1, PIECES + 1) / PIECES if self.duration else np.ones(1)


@dataclass(frozen=True, eq=False)
class RefitWindow:
    """What a predictor sees."""

    factory: PredictorFactory  # where predictors are made
    plant: Plant  # the healthy plant as learned
    # inverse of a root of the covariance of the logarithms of its parameters, shape (m, m); empty where they are
    # exact
    prior: FloatArray
    names: tuple[str, ...]  # of these parameters, m
    first_sample: int  # sample of the recording at which the window begins
    u: FloatArray  # u, y: what acted on the plant, and what was measured, shape (N,)
    y: FloatArray
    restart: BoolArray  # whether a sample is the first one after a gap, shape (N,)

    @classmethod
    def from_recording(cls, baseline: Baseline, recording: Recording, first: int, end: int) -> RefitWindow:
        """Cut samples `first` to `end` out of a recording; the baseline has an exact predictor."""
        if baseline.exact is None:
            raise ValueError("a window needs a baseline with an exact predictor")
        C = np.array(baseline.ratios_covariance)
        prior = np.linalg.inv(np.linalg.cholesky(C)) if len(C) else np.zeros((0, 0))
        whole = cls.of_healthy(baseline.loop, baseline.plant, baseline.exact.noise, recording)
        return replace(whole, prior=prior, names=tuple(baseline.ratios)[: len(C)]).cut(first, end)

    @classmethod
    def of_healthy(cls, loop: Loop, plant: Plant, noise: WhiteNoise, recording: Recording) -> RefitWindow:
        """Return all of a recording of a plant whose parameters are exact."""
        factory = PredictorFactory.from_input(loop, noise, recording.u)
        u = _delay_input(plant_input(loop, recording.u), recording.restart, factory.integer_delay)
        return cls(factory, plant, np.zeros((0, 0)), (), 0, u, recording.y, recording.restart)

    def cut(self, first: int, end: int) -> RefitWindow:
        """Return samples `first` to `end` of it."""
        restart = self.restart[first:end].copy()
        restart[0] = True
        return replace(
            self, first_sample=self.first_sample + first, u=self.u[first:end], y=self.y[first:end], restart=restart
        )

    @property
    def samples(self) -> int:
        """Length N."""
        return len(self.y)

    @property
    def nuisance_count(self) -> int:
        """Number m of healthy parameters that are not quite known."""
        return len(self.prior)

    @cached_property
    def healthy(self) -> Predictor:
        """The predictor of the healthy plant as learned."""
        return self.factory.predictor(self.plant)

    def predictor(self, d: Array, names: Sequence[str], x: Array, profile: ChangeProfile) -> Predictor:
        """Return the predictors of the healthy plant and of all that follow.

        `d`: error of the logarithms of the healthy parameters, shape (m,); `names, x`: parameters or rays that change,
        or `SENSOR_GAIN`, and by how much their logarithms do, shape (len(names),).
        """
        healthy = dict(zip(self.names, np.exp(d), strict=True)) if np.any(d) else {}
        each = [self.factory.predictor(self.plant.scaled(healthy)) if healthy else self.healthy]
        for share in profile.shares:
            faulty = dict(healthy)
            for name, value in zip(names, np.exp(share * x), strict=True):
                faulty[name] = faulty.get(name, 1.0) * value
            output_gain = faulty.pop(SENSOR_GAIN, 1.0)
            each.append(self.factory.predictor(self.plant.scaled(self.plant.expand_rays(faulty)), output_gain))
        return Predictor.concatenate([_cast_predictor(one, np.result_type(*(e.A for e in each))) for one in each])

    def innovations(self, predictor: Predictor, profile: ChangeProfile) -> Array:
        """Return the innovations in standard deviations, shape (N,)."""
        return predictor.innovations(profile.onset, profile.duration, self.u, self.y, self.restart)

    def residual(self, z: Array, names: Sequence[str], profile: ChangeProfile) -> Array:
        """Return what least squares makes small: innovations and prior, shape (N + m,), at z = [d, x]."""
        d, x = z[: self.nuisance_count], z[self.nuisance_count :]
        e = self.innovations(self.predictor(d, names, x, profile), profile)
        return np.concatenate([e, self.prior @ d])

    def jacobian(
        self, z: FloatArray, names: Sequence[str], profile: ChangeProfile, by: slice = slice(None)
    ) -> FloatArray:
        """Return the derivatives of `residual` by the unknowns that `by` selects, shape (N + m, k).

        By complex steps: no difference is taken, so nothing is lost by rounding (Squire and Trapp, 1998).
        """
        columns = []
        for i in np.arange(len(z))[by]:
            moved = z.astype(np.complex128)
            moved[i] += 1j * TINY
            columns.append(self.residual(moved, names, profile).imag / TINY)
        return np.array(columns).reshape(-1, self.samples + self.nuisance_count).T

    def disturbance_response(
        self, predictor: Predictor, profile: ChangeProfile, u: FloatArray, y: FloatArray
    ) -> FloatArray:
        """Return what disturbances of u and of y, shape (N,), add to the innovations: they are linear in both."""
        restart = np.zeros_like(self.restart)
        return np.asarray(predictor.innovations(profile.onset, profile.duration, u, y, restart), dtype=np.float64)


def plant_input(loop: Loop, u: FloatArray) -> FloatArray:
    """Return what acted on the plant, shape (N,): u within its limits, and nothing inside the dead zone."""
    if loop.input_logged == "before_limiter" and loop.input_limits is not None:
        u = np.clip(u, *loop.input_limits)
    if loop.input_deadzone is not None:
        low, high = loop.input_deadzone
        u = np.where((u >= low) & (u <= high), 0.0, u)
    return u


def _delay_input(u: FloatArray, restart: BoolArray, samples: int) -> FloatArray:
    """Return u as it was some samples before, run by run."""
    k = np.arange(len(u))
    begin = np.maximum.accumulate(np.where(restart, k, 0))
    return np.asarray(u[np.maximum(k - samples, begin)])


def _cast_predictor(predictor: Predictor, dtype: np.dtype[np.generic]) -> Predictor:
    return Predictor(*(part.astype(dtype) for part in predictor))
