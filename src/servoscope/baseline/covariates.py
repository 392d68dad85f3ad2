"""Healthy coefficients as functions of logged covariates: temperature, load, supply pressure, time since start."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pydantic import Field

from servoscope.baseline.records import BaselineModel, Matrix, Vector
from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.core.messages import Message, message
from servoscope.models.lfilter import lfilter

EDGE_SHARE = 0.2  # share of the learned range, by which a covariate may be outside of it, where slopes are less certain


class WarmUp(BaselineModel):
    """What healthy recordings say of a warm-up that is not measured; see `servoscope.detection.warm_up`."""

    time_constant_s: float
    power: float  # mean of u y'; 0 where there is none
    variance: float  # of what is left of eta, as sums over blocks of time show it


class CovariateModel(BaselineModel):
    """How n coefficients move with k covariates c, from their values theta_0 where x = (c - origin)/half_range is 0.

    ::

        theta_i = theta_0i exp(g_i)  where `proportional`,   theta_0i + g_i  elsewhere,   g = B' basis(x)

    with the powers of each x up to its `degrees` as basis, p of them, and B (p, n) known with `covariance`.
    """

    names: tuple[str, ...]
    low: Vector  # low, high: the range that the healthy recordings hold
    high: Vector
    degrees: tuple[int, ...]
    proportional: tuple[bool, ...]
    slopes: Matrix  # B (p, n)
    covariance: Matrix  # of B by rows, (p n, p n)
    # where the one covariate is no column but a warm-up that the coefficients tell
    warm_up: WarmUp | None = Field(default=None, exclude_if=lambda value: value is None)

    @cached_property
    def origin(self) -> FloatArray:
        """The middle of the learned range, shape (k,)."""
        return np.asarray(0.5 * (np.array(self.low) + np.array(self.high)))

    @cached_property
    def known(self) -> tuple[FloatArray, FloatArray]:
        """The learned range and what is next to it, shapes (k,)."""
        edge = EDGE_SHARE * (np.array(self.high) - np.array(self.low))
        return np.asarray(self.low - edge), np.asarray(self.high + edge)

    def basis(self, c: FloatArray) -> FloatArray:
        """Return the powers of covariates (..., k), shape (..., p)."""
        x = (c - self.origin) / (0.5 * (np.array(self.high) - np.array(self.low)))
        powers = [x[..., j] ** d for j, degree in enumerate(self.degrees) for d in range(1, degree + 1)]
        return np.asarray(np.stack(powers, axis=-1), dtype=np.float64)

    def theta(self, theta: FloatArray, c: FloatArray) -> FloatArray:
        """Return the coefficients (n,) of the origin at covariates (..., k), shape (..., n)."""
        g = self.basis(c) @ np.array(self.slopes)
        return np.asarray(np.where(self.proportional, theta * np.exp(g), theta + g))

    def factors(self, channels: Mapping[str, FloatArray]) -> FloatArray:
        """Return by what each coefficient is multiplied along a recording, shape (N, n); 1 where not `proportional`."""
        values = self.clip(CovariatePath.of(self, np.zeros(len(self.proportional)), channels, 1.0).values)
        return np.asarray(np.where(self.proportional, np.exp(self.basis(values) @ np.array(self.slopes)), 1.0))

    def theta_covariance(self, theta: FloatArray, c: FloatArray, std: FloatArray | None = None) -> FloatArray:
        """Return what the uncertain slopes make of the coefficients at covariates (..., k), shape (..., n, n).

        `std` (..., 1): standard deviation of the one covariate, where it is not measured.
        """
        G, n = self.basis(c), len(theta)
        C = np.array(self.covariance).reshape(G.shape[-1], n, G.shape[-1], n)
        size = np.where(self.proportional, self.theta(theta, c), 1.0)
        # few products of whole arrays: einsum of three takes ten times as long
        pairs = itertools.product(range(G.shape[-1]), repeat=2)
        spread = sum(((G[..., p, None, None] * C[p, :, q]) * G[..., q, None, None] for p, q in pairs), np.float64(0.0))
        spread = np.asarray(spread * size[..., :, None] * size[..., None, :])
        if std is not None:
            off = self.theta(theta, c + std) - self.theta(theta, c)
            spread = spread + off[..., :, None] * off[..., None, :]
        return spread

    def clip(self, c: FloatArray) -> FloatArray:
        """Return covariates (..., k) held where something is known: within the learned range, or next to it."""
        return np.asarray(np.clip(c, *self.known))

    def values(self, channels: Mapping[str, FloatArray]) -> FloatArray:
        """Return the covariates among the channels of a block, shape (N, k); NaN where one is missing."""
        return np.stack([channels[name] for name in self.names], axis=-1)

    def describe_missing(self, channels: Mapping[str, FloatArray]) -> Message | None:
        """Return that a covariate was not logged; None where all were."""
        for name in self.names if self.warm_up is None else ():
            if name not in channels or np.isnan(channels[name]).all():
                return message("covariate.missing", covariate=name)
        return None

    def describe_stale(self, channels: Mapping[str, FloatArray], hold_s: float, sample_rate: float) -> Message | None:
        """Return that a covariate had no new value for longer than one holds [s]; None where none is that old."""
        for name in self.names if self.warm_up is None else ():
            known = np.flatnonzero(~np.isnan(channels[name])) if name in channels else np.zeros(0, dtype=np.intp)
            ends = np.concatenate([[-1], known, [len(channels[name]) if name in channels else 0]])
            if not known.size or np.diff(ends).max() > hold_s * sample_rate + 1:
                return message("covariate.stale", covariate=name, hold_s=hold_s)
        return None

    def is_inside(self, c: FloatArray) -> BoolArray:
        """Return whether all covariates (..., k) are within the learned range, or next to it."""
        low, high = self.known
        return np.asarray(((c >= low) & (c <= high)).all(axis=-1))

    def describe_outside(self, c: FloatArray) -> Message | None:
        """Return that covariates (N, k) leave the learned range; None where they do not."""
        lowest, highest = np.nanmin(c, axis=0), np.nanmax(c, axis=0)
        for j in range(len(self.names)):
            ends = np.where(np.arange(len(self.names)) == j, [lowest, highest], self.origin)
            if self.is_inside(ends).all():
                continue
            seen, known = _span(lowest[j], highest[j]), _span(self.low[j], self.high[j])
            return message("covariate.outside", covariate=self.names[j], seen=seen, known=known)
        return None


def _span(low: float, high: float) -> str:
    ends = f"{low:.3g}", f"{high:.3g}"
    return ends[0] if ends[0] == ends[1] else f"{ends[0]}\u2013{ends[1]}"


def hold_last(c: FloatArray, before: FloatArray) -> FloatArray:
    """Return covariates (N, k) with the last known value where one is missing; `before` (k,): that of the past."""
    rows = np.vstack([before, c])
    known = np.where(np.isnan(rows), 0, np.arange(len(rows))[:, None])
    return np.take_along_axis(rows, np.maximum.accumulate(known, axis=0), axis=0)[1:]


class CovariateAverage:
    """Averages covariates as the estimator averages what it learns: with its memory, sample by sample.

    theta_hat is an average of what theta was lately, so it is compared with the coefficients of such an average.
    """

    def __init__(self, covariates: int, memory: float) -> None:
        """`memory`: in samples; an average keeps `keep` of itself per sample."""
        self.size, self.keep = 3 * covariates, 1.0 - 1.0 / memory

    def start(self) -> FloatArray:
        """Return the state before the first sample: last known values, and those of the filter, shape (size,)."""
        return np.full(self.size, np.nan)

    def run(self, state: FloatArray, c: FloatArray) -> FloatArray:
        """Return the average after each sample, (N, k), NaN before the first value; changes the state."""
        last, memory = np.split(state, [c.shape[1]])
        held, z = hold_last(c, last), memory.reshape(-1, 2)
        averages = np.full_like(held, np.nan)
        for j in range(c.shape[1]):
            known = np.flatnonzero(~np.isnan(held[:, j]))
            if not known.size:
                continue
            first = int(known[0])
            if np.isnan(z[j, 0]):
                z[j] = self.keep * held[first, j], 0.0  # as if it had been so for ever
            b, a = np.array([1.0 - self.keep]), np.array([1.0, -self.keep])
            averages[first:, j] = lfilter(b, a, held[first:, j], z[j : j + 1])
        last[:] = held[-1] if len(held) else last
        return averages

    def latest(self, state: FloatArray) -> FloatArray:
        """Return the average in a state, shape (k,)."""
        return state[self.size // 3 :: 2] / self.keep


@dataclass(frozen=True, eq=False)
class CovariatePath:
    """What the coefficients of a healthy loop would be along one recording."""

    model: CovariateModel
    theta: FloatArray  # of the model's origin, shape (n,)
    values: FloatArray  # shape (N, k)
    averages: FloatArray  # with the estimator's memory, shape (N, k)
    # of the one covariate that is not measured but fitted: its standard deviation, shape (N,), and from which size on a
    # jump is not taken for its course
    std: FloatArray | None = None
    jump: float = 0.0

    @classmethod
    def of(
        cls, model: CovariateModel, theta: FloatArray, channels: Mapping[str, FloatArray], memory: float
    ) -> CovariatePath:
        """Follow the covariates of a recording; before the first value of one, that one holds."""
        c = model.values(channels)
        for column in c.T:
            if not np.isnan(column).all():
                column[0] = column[np.flatnonzero(~np.isnan(column))[0]]
        average = CovariateAverage(c.shape[1], memory)
        held = hold_last(c, c[0])
        return cls(model, theta, held, model.clip(average.run(average.start(), c)))

    @property
    def start(self) -> FloatArray:
        """The coefficients at the first sample, shape (n,)."""
        return self.model.theta(self.theta, self.model.clip(self.values[0]))

    @property
    def place(self) -> str:
        """What the covariates were, as ``oil_temperature 44–52``."""
        ends = zip(self.model.names, self.values.min(axis=0), self.values.max(axis=0), strict=True)
        return ", ".join(f"{name} {_span(low, high)}" for name, low, high in ends)

    @property
    def outside(self) -> Message | None:
        """That the covariates leave the learned range; None where they do not."""
        outside = self.model.describe_outside(self.values)
        if outside is None or self.std is None:
            return outside
        values = dict(outside.values)
        return message("covariate.warm_up_outside", seen=values["seen"], known=values["known"])

    def expected(self, samples: IntArray) -> FloatArray:
        """Return the coefficients that theta_hat is compared with at some samples, shape (K, n)."""
        return self.model.theta(self.theta, self.averages[samples])

    def covariance(self, samples: IntArray) -> FloatArray:
        """Return what is not known of them, shape (K, n, n)."""
        std = None if self.std is None else self.std[samples, None]
        return self.model.theta_covariance(self.theta, self.averages[samples], std)
