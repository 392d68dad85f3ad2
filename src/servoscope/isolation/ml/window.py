"""The stretch of a recording that a refinement looks at, and its innovations under any change of the plant."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.core.arrays import BoolArray, FloatArray, IndexArray, IntArray
from servoscope.estimation.noise_model import WhiteNoise
from servoscope.fit.kernels import Array
from servoscope.fit.plant_experiment import plant_input
from servoscope.fit.predictor import PlantVariants, Predictor, PredictorFactory
from servoscope.isolation.ml.onset_sums import prepare_sums
from servoscope.models.loop import Loop
from servoscope.models.plants import Plant
from servoscope.signals import Recording

MISSED_LAGS = 6  # samples of u and of y that a wrong dynamic model may have missed
SIGN_S = 0.05  # over which the sign of a speed is taken [s]
DRIFT_PIECES = 8  # of a drift, within which the predictor changes in straight lines
COMPLEX_STEP = 1e-30  # complex step
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
        return np.arange(1, DRIFT_PIECES + 1) / DRIFT_PIECES if self.duration else np.ones(1)


DRIFT = ChangeProfile(0, 1)  # whenever it comes, however long it takes

ChangeSums = Callable[[IntArray, IntArray], tuple[FloatArray, FloatArray]]
"""From onsets and durations (M,) to the sums of products, (M, V, V + m), and of log S, (M,), of V = 1 + k columns: the
innovations and their derivatives by the k sizes; the last m are products with the rows of Q."""


@dataclass(frozen=True, eq=False)
class ChangeWindow(abc.ABC):
    """What a refit sees of a recording, whatever predicts y."""

    plant: Plant  # the healthy plant as learned
    # inverse of a root of the covariance of what is not quite known of the healthy plant, d, shape (m, m); empty where
    # it is exact
    prior: FloatArray
    names: tuple[str, ...]  # of these unknowns, m
    first_sample: int  # sample of the recording at which the window begins
    u: FloatArray  # u, y: what acted on the plant, and what was measured, shape (N,)
    y: FloatArray
    restart: BoolArray  # whether a sample is the first one after a gap, shape (N,)

    stride = 1  # samples of the recording from one of the window to the next
    systematic = 2e-3  # share of a change that nominal parameters may be off by
    size_error = (
        0.0  # share of a size, as a logarithm, by which it is off because the plant is simpler than the machine
    )
    follows = False  # whether the healthy parameters are this recording's own from the first fit on
    coloured = 0  # samples over which what a true hypothesis leaves may hang together; 0: it is white

    @property
    @abc.abstractmethod
    def sample_rate(self) -> float:
        """Sample rate of the window [Hz]."""

    @property
    @abc.abstractmethod
    def noise_y_std(self) -> float:
        """Standard deviation of the noise of y."""

    @abc.abstractmethod
    def predictor(self, d: Array, names: Sequence[str], x: Array, profile: ChangeProfile) -> Any:
        """Return the predictors of the healthy plant and of all that follow.

        `d`: error of the healthy plant, shape (m,); `names, x`: parameters or rays that change, or `SENSOR_GAIN`, and
        by how much their logarithms do, shape (len(names),).
        """

    @abc.abstractmethod
    def innovations(self, predictor: Any, profile: ChangeProfile) -> Array:
        """Return the innovations in standard deviations, shape (N,)."""

    @abc.abstractmethod
    def disturbance_response(self, predictor: Any, profile: ChangeProfile, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return what disturbances of u and of y, shape (N,), add to the innovations: they are linear in both."""

    @abc.abstractmethod
    def change_sums(self, d: FloatArray, names: Sequence[str], x: FloatArray, step: float, Q: FloatArray) -> ChangeSums:
        """Prepare the sums of products by onset, with the derivatives by differences of `step`."""

    def inflation(self, jacobian: FloatArray, residual: FloatArray, sizes: int) -> float:
        """Return by how much more the scores of the last unknowns scatter than white innovations would make them.

        `jacobian`, `residual`: of a fit, shapes (N + m, k) and (N + m,).
        """
        return 1.0

    def unmodelled_signals(self) -> tuple[list[FloatArray], list[FloatArray]]:
        """Return what a wrong model may have missed, each (N,), as additions to y and to u.

        Missed dynamics: u and y of the last samples; backlash: the sign of y', added to y; Coulomb friction: the same,
        added to u; offsets of both.
        """
        moving, ones = delayed(speed_sign(self.y, self.sample_rate), 1), np.ones(self.samples)
        lagged = [delayed(x, lag) for x in (self.u, self.y) for lag in range(1, MISSED_LAGS + 1)]
        return [*lagged, moving, ones], [moving, ones]

    def cut(self, first: int, end: int) -> Self:
        """Return samples `first` to `end` of it."""
        restart = self.restart[first:end].copy()
        restart[0] = True
        begin = self.first_sample + first * self.stride
        return replace(self, first_sample=begin, u=self.u[first:end], y=self.y[first:end], restart=restart)

    @property
    def samples(self) -> int:
        """Length N."""
        return len(self.y)

    @property
    def used(self) -> int:
        """Number of innovations that count, N as a rule."""
        return self.samples

    @property
    def nuisance_count(self) -> int:
        """Number m of what is not quite known of the healthy plant."""
        return len(self.prior)

    @cached_property
    def healthy(self) -> Any:
        """The predictor of the healthy plant as learned."""
        return self.predictor(np.zeros(self.nuisance_count), (), np.zeros(0), ChangeProfile(0))

    def variants(self, z: Array, names: Sequence[str], profile: ChangeProfile) -> Any:
        """Return the predictors of V changes, one for each row z = [d, x], shape (V, m + len(names))."""
        m = self.nuisance_count
        return [self.predictor(row[:m], names, row[m:], profile) for row in z]

    def variant_innovations(self, variants: Any, profile: ChangeProfile) -> Array:
        """Return the innovations of each in standard deviations, shape (V, N)."""
        return np.array([self.innovations(predictor, profile) for predictor in variants])

    def residuals(self, z: Array, names: Sequence[str], profile: ChangeProfile) -> Array:
        """Return what least squares makes small: innovations and prior, (V, N + m), at z = [d, x], (V, m + k)."""
        e = self.variant_innovations(self.variants(z, names, profile), profile)
        return np.hstack([e, z[:, : self.nuisance_count] @ self.prior.T])

    def residual(self, z: Array, names: Sequence[str], profile: ChangeProfile) -> Array:
        """Return the `residuals` of one z, shape (N + m,)."""
        return np.asarray(self.residuals(z[None], names, profile)[0])

    def jacobian(
        self, z: FloatArray, names: Sequence[str], profile: ChangeProfile, by: slice | IndexArray = slice(None)
    ) -> FloatArray:
        """Return the derivatives of `residual` by the unknowns that `by` selects, shape (N + m, k).

        By complex steps: no difference is taken, so nothing is lost by rounding (Squire and Trapp, 1998).
        """
        moved = (z + 1j * COMPLEX_STEP * np.eye(len(z)))[by]
        if not len(moved):
            return np.zeros((self.samples + self.nuisance_count, 0))
        return np.asarray(self.residuals(moved, names, profile).imag.T / COMPLEX_STEP)


@dataclass(frozen=True, eq=False)
class RefitWindow(ChangeWindow):
    """What the exact predictor of a linear plant sees."""

    factory: PredictorFactory  # where predictors are made

    @classmethod
    def from_recording(cls, baseline: Baseline, recording: Recording, first: int, end: int) -> RefitWindow:
        """Cut samples `first` to `end` out of a recording; the baseline has an exact predictor."""
        if baseline.exact is None:
            raise ValueError("a window needs a baseline with an exact predictor")
        C = np.array(baseline.healthy.covariance)
        prior = np.linalg.inv(np.linalg.cholesky(C)) if len(C) else np.zeros((0, 0))
        whole = cls.of_healthy(baseline.loop, baseline.plant, baseline.exact.noise, recording)
        return replace(whole, prior=prior, names=tuple(baseline.healthy.ratios)[: len(C)]).cut(first, end)

    @classmethod
    def of_healthy(cls, loop: Loop, plant: Plant, noise: WhiteNoise, recording: Recording) -> RefitWindow:
        """Return all of a recording of a plant whose parameters are exact."""
        factory = PredictorFactory.from_input(loop, noise, recording.u)
        u = delay_input(plant_input(loop, recording.u), recording.restart, factory.integer_delay)
        return cls(plant, np.zeros((0, 0)), (), 0, u, recording.y, recording.restart, factory)

    @property
    def sample_rate(self) -> float:
        """Sample rate of the window [Hz]."""
        return self.factory.loop.sample_rate

    @property
    def noise_y_std(self) -> float:
        """Standard deviation of the noise of y."""
        return self.factory.noise.y_std

    @cached_property
    def healthy(self) -> Predictor:
        """The predictor of the healthy plant as learned."""
        return self.factory.predictor(self.plant)

    def predictor(self, d: Array, names: Sequence[str], x: Array, profile: ChangeProfile) -> Predictor:
        """Return the predictors of the healthy plant and of all that follow; d are errors of logarithms."""
        return self.variants(np.concatenate([d, x])[None], names, profile)[0]

    def variants(self, z: Array, names: Sequence[str], profile: ChangeProfile) -> PlantVariants:
        """Return predictors in a row, and which of them each change goes through, shape (V, p).

        Neighbours of the same d share the healthy one.
        """
        m, shares = self.nuisance_count, profile.shares
        d, x = z[:, :m], z[:, m:]
        new = np.append(True, (d[1:] != d[:-1]).any(axis=1))
        own = np.cumsum(new) - 1  # the healthy ones come first
        count = int(new.sum())
        # a column of logarithms for each name, one row per plant
        faulty = (shares[None, :, None] * x[:, None]).reshape(len(z) * len(shares), len(names))
        healthy = np.concatenate([d[new], np.repeat(d, len(shares), axis=0)])
        factors = dict(zip(self.names, np.exp(healthy).T, strict=True))
        for name, column in zip(names, np.exp(np.concatenate([np.zeros((count, len(names))), faulty])).T, strict=True):
            factors[name] = factors[name] * column if name in factors else column
        output_gains = factors.pop(SENSOR_GAIN, np.ones(len(healthy)))
        spaces = self.plant.state_spaces(self.plant.expand_rays(factors), len(healthy))
        after = own[-1] + 1 + np.arange(len(faulty)).reshape(len(z), len(shares))
        return PlantVariants(self.factory.predictors(spaces, output_gains), np.column_stack([own, after]))

    def innovations(self, predictor: Predictor, profile: ChangeProfile) -> Array:
        """Return the innovations in standard deviations, shape (N,)."""
        return predictor.innovations(profile.onset, profile.duration, self.u, self.y, self.restart)

    def variant_innovations(self, variants: PlantVariants, profile: ChangeProfile) -> Array:
        """Return the innovations of each in standard deviations, shape (V, N)."""
        predictor, plants = variants
        return predictor.innovations(profile.onset, profile.duration, self.u, self.y, self.restart, plants)

    def disturbance_response(
        self, predictor: Predictor, profile: ChangeProfile, u: FloatArray, y: FloatArray
    ) -> FloatArray:
        """Return what disturbances of u and of y, shape (N,), add to the innovations: they are linear in both."""
        restart = np.zeros_like(self.restart)
        return np.asarray(predictor.innovations(profile.onset, profile.duration, u, y, restart), dtype=np.float64)

    def change_sums(self, d: FloatArray, names: Sequence[str], x: FloatArray, step: float, Q: FloatArray) -> ChangeSums:
        """Prepare the sums of products by onset: one pass over the window, in which every predictor settles anew."""
        moved = np.vstack([np.zeros(len(x)), step * np.eye(len(x))])
        variants = self.variants(np.column_stack([np.tile(d, (len(moved), 1)), x + moved]), names, DRIFT)
        return prepare_sums(variants, step, self.u, self.y, self.restart, Q)


def delayed(x: FloatArray, samples: int) -> FloatArray:
    """Return a signal some samples later, its first value before it begins."""
    return np.concatenate([np.full(samples, x[0]), x[:-samples]])


def speed_sign(y: FloatArray, rate: float) -> FloatArray:
    """Return the sign of the difference over `SIGN_S`: noise does not decide it as long as there is motion."""
    over = max(1, round(SIGN_S * rate))
    return np.asarray(np.sign(np.concatenate([np.zeros(over), y[over:] - y[:-over]])))


def delay_input(u: FloatArray, restart: BoolArray, samples: int) -> FloatArray:
    """Return u as it was some samples before, run by run."""
    k = np.arange(len(u))
    begin = np.maximum.accumulate(np.where(restart, k, 0))
    return np.asarray(u[np.maximum(k - samples, begin)])
