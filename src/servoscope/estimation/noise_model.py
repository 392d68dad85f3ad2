"""The noise of the residual v = eta - phi' theta as one ARMA model: white noises of u and y, or an autoregression.

White noise that enters the plant with u and white noise of the sensor reach v through filters that are known: those
of the regression itself. Two variances then say all about its colour, down to the deep notch at low frequencies,
where 1/G is small, that no short autoregression can draw.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from servoscope.core.arrays import ComplexArray, FloatArray
from servoscope.estimation.filter_bank import FilterBank
from servoscope.models.lfilter import lfilter
from servoscope.models.lti import LinearSystem, autocovariances, decimate_noise, innovation_gain, scale_to_noise

AR_ORDER = 10
MIN_VARIANCE_SHARE = 1e-9  # of the variance of v: no innovation is smaller
CANCELLATION_SHARE = 0.05  # of a pole's distance from the unit circle, within which a zero cancels it
WHITENESS_LAGS = 20  # of innovations that should be white
RESPONSE_SAMPLES = 2000  # samples of a whitening filter's answer that are looked at


@dataclass(frozen=True)
class WhiteNoise:
    """White noise of the loop: standard deviations of n_u (enters with u) and n_y (part of the measured y)."""

    u_std: float
    y_std: float

    def times(self, factor: float) -> WhiteNoise:
        """Return the same noise with standard deviations times a factor."""
        return WhiteNoise(u_std=factor * self.u_std, y_std=factor * self.y_std)


@dataclass(frozen=True, eq=False)
class ArmaNoise:
    """Stationary noise v(k) = sum a_j v(k-j) + e(k) + sum b_j e(k-j), e white."""

    a: FloatArray  # a, b: shapes (p,), p > 0, and (q,)
    b: FloatArray
    gamma: FloatArray  # autocovariance of v at lags 0 to p - 1, shape (p,)
    variance: float

    @property
    def polynomials(self) -> tuple[FloatArray, FloatArray]:
        """``A = [1, -a]`` and ``B = [1, b]`` of A(q) v = B(q) e, q the delay, shapes (p + 1,) and (q + 1,)."""
        return np.concatenate([[1.0], -self.a]), np.concatenate([[1.0], self.b])

    @property
    def c(self) -> FloatArray:
        """E[v(k) e(k-j)] for j = 0 to q - 1, shape (q,)."""
        psi = np.zeros(len(self.b))
        for j in range(len(psi)):
            past = sum(self.a[i] * psi[j - 1 - i] for i in range(min(j, len(self.a))))
            psi[j] = (1.0 if j == 0 else self.b[j - 1]) + past
        return self.variance * psi

    def chain(self) -> tuple[FloatArray, FloatArray]:
        """Return v as the output of a chain of delays: its weights a_i and E[v(k) x_i(k+1)], both (max(p, q),).

        v = x_0 + e, x_i(k+1) = a_i v + x_(i+1) + b_i e; coefficients that are zero but for rounding are left out.
        """
        moving = np.trim_zeros(np.where(np.abs(self.b) > 1e-12, self.b, 0.0), "b")
        order, p, q = max(len(self.a), len(moving)), len(self.a), len(moving)
        a, b = np.pad(self.a, (0, order - p)), np.pad(moving, (0, order - q))
        gamma, c = np.pad(self.gamma, (0, order - p)), np.pad(self.c[:q], (0, order - q))
        heads = [float(a[i:] @ gamma[: order - i] + b[i:] @ c[: order - i]) for i in range(order)]
        return a, np.array(heads)

    def times(self, factor: float) -> ArmaNoise:
        """Return the same colour with `factor` times the power."""
        return replace(self, gamma=factor * self.gamma, variance=factor * self.variance)

    def whiten(self, x: FloatArray) -> FloatArray:
        """Return innovations of unit variance for a column or columns of v, shape (N,) or (N, m)."""
        A, B = self.polynomials
        white: FloatArray = lfilter(A, B, x) / np.sqrt(self.variance)
        return white

    def shape(self, x: FloatArray) -> FloatArray:
        """Return x passed through the filter that turns white noise of unit variance into v, shape as x."""
        A, B = self.polynomials
        shaped: FloatArray = lfilter(B, A, x) * np.sqrt(self.variance)
        return shaped

    def autocovariance(self, lags: int) -> FloatArray:
        """Return the autocovariance of v at lags 0 to `lags`, shape (lags + 1,)."""
        gamma, c, b = list(self.gamma), self.c, self.polynomials[1]
        psi = np.append(c, 0.0)
        for j in range(len(gamma), lags + 1):
            moving = sum(b[i] * psi[i - j] for i in range(j, len(b)))
            gamma.append(float(sum(self.a[i] * gamma[j - 1 - i] for i in range(len(self.a))) + moving))
        return np.array(gamma[: lags + 1])


def sample_autocovariance(runs: Sequence[FloatArray], lags: int) -> FloatArray:
    """Return the autocovariance of a zero-mean signal at lags 0 ... lags, over several runs, shape (lags + 1,)."""
    total = sum(len(run) for run in runs)
    products = [sum(float(run[lag:] @ run[: max(len(run) - lag, 0)]) for run in runs) for lag in range(lags + 1)]
    return np.array(products) / total


def long_run_inflation(x: FloatArray, lags: int) -> float:
    """Return the long-run variance of a signal over its variance, at least 1 (Newey and West, 1987)."""
    lags = min(lags, len(x) - 1)
    gamma = sample_autocovariance([x - x.mean()], lags)
    weight = 1.0 - np.arange(1, lags + 1) / (lags + 1.0)
    return max(1.0, 1.0 + 2.0 * float(gamma[1:] @ weight) / max(float(gamma[0]), np.finfo(np.float64).tiny))


def largest_autocorrelation(e: FloatArray, lags: int) -> float:
    """Return the largest autocorrelation of innovations (N,) at lags 1 ... lags, without its sign."""
    gamma = sample_autocovariance([e], lags)
    return float(np.abs(gamma[1:]).max() / gamma[0])


def yule_walker(gamma: FloatArray) -> ArmaNoise:
    """Return the autoregression with an autocovariance (p + 1,) at lags 0 ... p.

    A small white floor keeps strongly oversampled noise solvable.
    """
    from scipy.linalg import solve_toeplitz

    row = gamma[:-1].copy()
    row[0] *= 1.0 + 1e-9
    a = np.asarray(solve_toeplitz(row, gamma[1:]))
    variance = max(float(gamma[0] - a @ gamma[1:]), MIN_VARIANCE_SHARE * float(gamma[0]))
    return ArmaNoise(a, np.zeros(0), gamma[:-1].copy(), variance)


def residual_system(bank: FilterBank, theta: FloatArray) -> LinearSystem:
    """Return [u, y] -> v = eta - phi' theta; columns of friction and offset do not pass noise on."""
    return bank.linear.output(np.concatenate([[1.0], -theta])[None, :])


def arma_from_white_noise(bank: FilterBank, theta: FloatArray, noise: WhiteNoise, stride: int) -> ArmaNoise:
    """Return the model of v for white noise on u and y, by spectral factorisation.

    The poles are those of the regression's filters; the zeros are the roots inside the unit circle of what is left of
    the autocovariance when the poles are taken out of it (Kailath, Sayed and Hassibi, 2000, chapter 6).

    `theta`: coefficients of the plant, shape (n,).
    """
    system = residual_system(bank, theta)
    poles = bank.poles**stride
    a = -np.atleast_1d(np.poly(poles))[1:] if len(poles) else np.zeros(1)
    p = len(a)
    q = p + 1 if len(poles) else len(system.A)
    gamma = autocovariances(system.input(np.diag([noise.u_std, noise.y_std])), 2 * p + q, stride)[:, 0, 0]
    A = np.concatenate([[1.0], -a])
    both = np.convolve(A, A[::-1])  # of A(q) A(1/q), lags -p ... p
    moving = np.array([both @ gamma[np.abs(j + np.arange(-p, p + 1))] for j in range(q + 1)])
    zeros = np.roots(np.concatenate([moving[::-1], moving[1:]]))
    b = np.real(np.poly(zeros[np.argsort(np.abs(zeros))][:q]))
    variance = float(moving[0] / (b**2).sum())
    return ArmaNoise(a, b[1:], gamma[:p].copy(), max(variance, MIN_VARIANCE_SHARE * float(gamma[0])))


def arma_from_system(system: LinearSystem, stride: int) -> ArmaNoise:
    """Return the model of v, the one output of a stable system under unit white noise at every input.

    Kalman predictor of all of its states (Anderson and Moore, 1979, chapter 9): the poles are those of the system, the
    zeros those of the predictor; pairs that all but cancel are left out, or slow ones would never be forgotten.
    """
    scaled = scale_to_noise(system)
    gamma = autocovariances(scaled, 0)[:, 0, 0]
    unit = scaled.output(np.array([[float(gamma[0]) ** -0.5]]))
    A, Q, S, R = decimate_noise(unit, stride)
    K, variance = innovation_gain(A, unit.C, Q, S, R)
    poles, zeros = _cancel_pairs(*(np.linalg.eigvals(matrix).astype(np.complex128) for matrix in (A, A - K @ unit.C)))
    order = max(len(poles), 1)
    a, b = (np.pad(np.real(np.poly(roots))[1:], (0, order - len(roots))) for roots in (poles, zeros))
    # the autocovariance of what is left: with that of the whole system a recursion would lose its positive covariance
    chain = np.eye(order, k=1) - np.outer(a, np.eye(order)[0])
    process = LinearSystem(chain, (b - a)[:, None], np.eye(1, order), np.ones((1, 1)))
    power = float(variance[0, 0] * gamma[0])
    return ArmaNoise(-a, b, power * autocovariances(process, order - 1)[:, 0, 0], power)


def _cancel_pairs(poles: ComplexArray, zeros: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Leave out poles and zeros that are nearer to each other than a share of their distance from the unit circle."""
    kept, left = [], list(zeros)
    for pole in poles:
        near = [zero for zero in left if abs(zero - pole) < CANCELLATION_SHARE * (1.0 - abs(pole))]
        if near:
            left.remove(min(near, key=lambda zero: abs(zero - pole)))
        else:
            kept.append(pole)
    return np.array(kept), np.array(left)


def colour_error(model: ArmaNoise, system: LinearSystem, stride: int) -> float:
    """Return how far a model leaves the output of a system from white noise of unit variance.

    The largest of the error of the variance and the autocorrelations, up to `WHITENESS_LAGS`.
    """
    gamma = autocovariances(scale_to_noise(system), WHITENESS_LAGS + len(model.a) + RESPONSE_SAMPLES, stride)[:, 0, 0]
    A, B = model.polynomials
    impulse = np.zeros(RESPONSE_SAMPLES)
    impulse[0] = 1.0
    h = lfilter(A, B, impulse)
    pairs = np.correlate(h, h, "full")  # of the whitening filter with itself, by lag
    both = np.arange(1 - RESPONSE_SAMPLES, RESPONSE_SAMPLES)
    left = np.array([float(pairs @ gamma[np.abs(lag + both)]) for lag in range(WHITENESS_LAGS + 1)]) / model.variance
    return max(abs(float(left[0]) - 1.0), float(np.abs(left[1:]).max()))
