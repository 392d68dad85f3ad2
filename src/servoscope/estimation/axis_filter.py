"""A motor axis as a predictor of y: a steady Kalman filter whose innovations are linear in the axis's coefficients.

The axis integrates its acceleration twice, and everything that makes the acceleration is a signal that can be computed
from u and y before: ``y'' = b u - sum a_i column_i(y, y') + w``, with an Ornstein-Uhlenbeck process w for the force
that no term explains. So the innovations are those of y minus ``b`` times those of u, and so on (Ljung, 1999,
section 10.4).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.models.plants.axis import AxisPlant

TARGET_RATE = 200.0  # Hz; what an axis does faster than that is not its rigid body
SPEED_SAMPLES = 5  # over which a parabola gives the speed
MAX_REMAINING_SHARE = 1e-2  # share of its state that the filter may still hold
RELATIVE_FLOOR = 1e-12  # of y's noise, relative to what the force does to y within a sample
MIN_LAG_SAMPLES = 1e-2  # below which a lag is none
DOUBLINGS = 30  # of the samples that the steady state is computed over


class AxisNoise(NamedTuple):
    """What disturbs an axis: a force, as an Ornstein-Uhlenbeck process, and noise of y."""

    acceleration_std: float  # of the force over the inertia [output per s^2]
    correlation_s: float  # time in which the force forgets itself [s]
    y_std: float


class DriveLag(NamedTuple):
    """How late the force of a drive follows u: a dead time, and the time constant of a first-order lag."""

    delay_s: float = 0.0
    lag_s: float = 0.0

    def of_input(self, u: FloatArray, restart: BoolArray, sample_rate: float) -> FloatArray:
        """Return the force's mean from each sample to the next, shape (N,), of u that is held; each run begins settled.

        A delay between two samples is the mean of both, which is exact for a u that is held. It may be negative: by
        half a sample, u runs in straight lines.
        """
        if not any(self):
            return u
        from scipy.signal import lfilter

        k = np.arange(len(u))
        begin = np.maximum.accumulate(np.where(restart, k, 0))
        whole, part = divmod(self.delay_s * sample_rate, 1.0)
        at = (np.clip(k - int(whole) - extra, begin, len(u) - 1) for extra in (0, 1))
        sooner, later = (u[np.where(begin[i] > begin, k, i)] for i in at)  # no run reaches into the next one
        u = (1.0 - part) * sooner + part * later
        if self.lag_s * sample_rate < MIN_LAG_SAMPLES:
            return np.asarray(u)
        kept = float(np.exp(-1.0 / (self.lag_s * sample_rate)))
        late = np.empty_like(u)
        first = np.flatnonzero(restart)
        for a, b in zip(first, [*first[1:], len(u)], strict=True):
            late[a:b] = lfilter([0.0, 1.0 - kept], [1.0, -kept], u[a:b], zi=[u[a]])[0]
        return np.asarray(u + (late - u) * self.lag_s * sample_rate * (1.0 - kept))


NO_LAG = DriveLag()


def axis_stride(sample_rate: float) -> int:
    """Return the samples of a recording from one of the filter to the next."""
    return max(1, int(sample_rate / TARGET_RATE))


@dataclass(frozen=True, eq=False)
class AxisFilter:
    """The filter from the acceleration, and from y, to the innovations.

    `to_acceleration` (numerator) and `to_y` share `poles` (denominator); `variance` is that of the innovations.
    """

    to_acceleration: FloatArray
    to_y: FloatArray
    poles: FloatArray
    variance: float
    settling: int  # samples after which it has forgotten a false step of the acceleration

    @classmethod
    def design(cls, noise: AxisNoise, sample_rate: float, derivative: int = 0) -> AxisFilter:
        """Solve for the steady gain (Anderson and Moore, 1979, chapter 4); `derivative`: 1 where y is a speed."""
        from scipy.linalg import expm
        from scipy.signal import ss2tf

        T, tau = 1.0 / sample_rate, noise.correlation_s
        n = 3 - derivative  # position, speed and the force, or the last two
        A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0 / tau]])[derivative:, derivative:]
        B, C = np.array([[0.0], [1.0], [0.0]])[derivative:], np.eye(1, n)
        whole = expm(np.block([[A, B], [np.zeros((1, n + 1))]]) * T)
        Phi, Gamma = whole[:n, :n], whole[:n, n:]
        q = np.diag([0.0, 0.0, 2.0 * noise.acceleration_std**2 / tau])[derivative:, derivative:]
        loan = expm(np.block([[-A, q], [np.zeros((n, n)), A.T]]) * T)  # Van Loan (1978)
        Q = loan[n:, n:].T @ loan[:n, n:]
        # in units in which the states are of one size
        size = noise.acceleration_std * np.array([T**2, T, 1.0])[derivative:]
        scaled = Phi * size / size[:, None]
        C = C * size
        r = max(noise.y_std**2, RELATIVE_FLOOR * float((C @ C.T)[0, 0]))
        P = _steady_covariance(scaled, C, Q / np.outer(size, size), r)
        S = float((C @ P @ C.T)[0, 0] + r)
        K = scaled @ P @ C.T / S
        F = scaled - K @ C
        inputs = np.hstack([Gamma / size[:, None], K])
        numerator, poles = ss2tf(F, inputs, C, np.zeros((1, 2)), 0)
        from_y, _ = ss2tf(F, inputs, C, np.zeros((1, 2)), 1)
        slowest = float(np.abs(np.linalg.eigvals(F)).max())
        settling = int(np.ceil(np.log(MAX_REMAINING_SHARE) / np.log(min(max(slowest, 0.01), 0.999))))
        # kernels take three poles, of which that of a position may be missing
        to_acceleration, to_y, poles = (
            np.pad(polynomial, (0, derivative)) for polynomial in (numerator[0], poles - from_y[0], poles)
        )
        return cls(to_acceleration, to_y, poles, S, settling)

    def of_acceleration(self, acceleration: Any, runs: Sequence[slice]) -> Any:
        """Return what accelerations (..., N) add to y's prediction; every run begins anew."""
        from scipy.signal import lfilter

        return np.concatenate([lfilter(self.to_acceleration, self.poles, acceleration[..., r]) for r in runs], axis=-1)

    def of_output(self, y: FloatArray, runs: Sequence[slice]) -> FloatArray:
        """Return the innovations of y (N,) under no acceleration."""
        from scipy.signal import lfilter

        return np.concatenate([lfilter(self.to_y, self.poles, y[r] - y[r.start]) for r in runs])


def _steady_covariance(A: FloatArray, C: FloatArray, Q: FloatArray, r: float) -> FloatArray:
    """Solve ``P = A (P - P C' C P/(C P C' + r)) A' + Q``, all (n, n), by doubling (Anderson, 1978)."""
    G, H, A = C.T @ C / r, Q, A.T
    for _ in range(DOUBLINGS):
        W = np.linalg.inv(np.eye(len(A)) + G @ H)
        G, grown, A = G + A @ W @ G @ A.T, H + A.T @ H @ W @ A, A @ W @ A
        if np.abs(grown - H).max() <= 1e-13 * np.abs(grown).max():
            break
        H = 0.5 * (grown + grown.T)
    return grown


@dataclass(frozen=True, eq=False)
class AxisSignals:
    """A recording as the filter takes it: every `stride`-th y, and the mean of u until the next."""

    u: FloatArray  # (N,), what acted on the plant
    y: FloatArray
    restart: BoolArray
    sample_rate: float
    derivative: int = 0  # 1 where y is a speed
    factors: FloatArray | None = None  # what multiplies `columns`, of the same shape; None: nothing moves them

    @classmethod
    def thinned(
        cls,
        u: FloatArray,
        y: FloatArray,
        restart: BoolArray,
        sample_rate: float,
        stride: int,
        derivative: int = 0,
        factors: FloatArray | None = None,
    ) -> AxisSignals:
        """Take every `stride`-th sample; runs that are shorter are joined to what follows."""
        N = len(y) // stride
        blocks = slice(0, N * stride)
        new: BoolArray = np.any(restart[blocks].reshape(N, stride), axis=1)
        new[0] = True
        acting = u[blocks].reshape(N, stride).mean(axis=1)
        thin = None if factors is None else factors[:, blocks][:, ::stride]
        return cls(acting, y[blocks][::stride], new, sample_rate / stride, derivative, thin)

    @cached_property
    def runs(self) -> tuple[slice, ...]:
        """The stretches without a gap."""
        begin = np.flatnonzero(self.restart).tolist()
        return tuple(slice(a, b) for a, b in zip(begin, [*begin[1:], len(self.y)], strict=True))

    @cached_property
    def speed(self) -> FloatArray:
        """The slope of a parabola through the samples around each (Savitzky and Golay, 1964), shape (N,).

        Of a y that is a speed, its value.
        """
        from scipy.signal import savgol_filter

        def slope(y: FloatArray) -> FloatArray:
            if len(y) < SPEED_SAMPLES:
                return y if self.derivative else np.zeros(len(y))
            order, delta = 1 - self.derivative, 1.0 / self.sample_rate
            return np.asarray(savgol_filter(y, SPEED_SAMPLES, 2, deriv=order, delta=delta))

        return np.concatenate([slope(self.y[r]) for r in self.runs])

    def columns(self, plant: AxisPlant) -> FloatArray:
        """Return u and minus what the terms multiply, shape (1 + n, N): times `acceleration_coefficients`, y''.

        Each is its mean from a sample to the next, as u is: held from the sample on, a friction that grows would be
        half a sample late, and pass for inertia.
        """
        v = np.where(np.abs(self.speed) > plant.sign_speed, self.speed, 0.0)
        terms = plant.regressors(self.y, v)
        following = np.append(np.arange(1, len(v)), len(v) - 1)
        following[np.flatnonzero(self.restart[following])] -= 1  # a run ends with its own value
        columns = np.array([self.u, *-0.5 * (terms + terms[:, following])])
        return columns if self.factors is None else columns * self.factors

    @property
    def force(self) -> FloatArray:
        """The first of `columns`, shape (N,)."""
        return self.u if self.factors is None else np.asarray(self.u * self.factors[0])

    def moving(self, rest_speed: float, settling: int) -> BoolArray:
        """Return where the axis moves and the filter has forgotten the last rest, reversal and gap, shape (N,).

        At rest friction is whatever holds the axis, and in a reversal it changes within a sample.
        """
        slow = (np.abs(self.speed) <= rest_speed) | self.restart
        last = np.maximum.accumulate(np.where(slow, np.arange(len(slow)), -len(slow)))
        return np.asarray(np.arange(len(slow)) - last > settling)
