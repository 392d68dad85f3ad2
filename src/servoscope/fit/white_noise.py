"""White noises of u and y, fitted to residuals by the likelihood of their spectrum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.estimation.noise_model import MIN_VARIANCE_SHARE, ArmaNoise, WhiteNoise
from servoscope.fit.search import raise_unknown
from servoscope.models.lti import LinearSystem, autocovariances

RESPONSE_TAIL = 1e-4  # of a closed loop's answer that an autocovariance may leave out
MIN_LOG_POWER, MAX_LOG_POWER = -25.0, 3.0  # of a noise relative to all of the residual, in the search
MAX_LOUDEST = 5.0  # the same of an upper bound
BISECTIONS = 30  # of an upper bound


def _spectra(system: LinearSystem, stride: int, samples: int) -> FloatArray:
    """Return the power spectra of v under unit noise on each input, at rfft's frequencies of a run, shape (M, m)."""
    slowest = float(np.abs(np.linalg.eigvals(system.A)).max(initial=0.0)) ** stride
    memory = np.log(RESPONSE_TAIL) / np.log(slowest) if 0.0 < slowest < 1.0 else 1.0
    lags = int(min(max(64, memory), max(samples // 2, 1)))
    columns = []
    for unit in np.eye(system.B.shape[1]):
        gamma = autocovariances(system.input(unit[:, None]), lags, stride)[:, 0, 0]
        whole = np.zeros(samples)
        whole[: lags + 1] += gamma
        whole[samples - lags :] += gamma[:0:-1]
        columns.append(np.maximum(np.fft.rfft(whole).real, 0.0))
    return np.stack(columns, axis=1)


def _periodogram(v: FloatArray) -> FloatArray:
    """Return |V(f)|^2 of a run under a Hann window, against leakage from strong frequencies."""
    window = np.hanning(len(v))
    return np.asarray(np.abs(np.fft.rfft(v * window)) ** 2 / (window**2).sum())


@dataclass(frozen=True)
class WhiteNoiseFit:
    """White noises of u and y fitted to residuals."""

    noise: WhiteNoise
    # upper bounds of each: Whittle's likelihood falls by the factor exp(-`LIKELIHOOD_DROP`) there
    loudest: WhiteNoise
    cost: float  # minus the logarithm of the likelihood


def fit_white_noise(system: LinearSystem, runs: Sequence[FloatArray], stride: int) -> WhiteNoiseFit:
    """Fit n_u and n_y to residuals v, one array per recording, by Whittle's likelihood (1953).

    `system` leads from noise on u and on y to v, for example `residual_system`.
    """
    from scipy.optimize import minimize

    I = np.concatenate([_periodogram(v)[1:-1] for v in runs])
    S = np.concatenate([_spectra(system, stride, len(v))[1:-1] for v in runs])
    size, level = S.mean(axis=0), float(I.mean())
    S = S / size + MIN_VARIANCE_SHARE
    I = I / level

    def cost(x: FloatArray) -> tuple[float, FloatArray]:
        parts = S * np.exp(x)
        model = parts.sum(axis=1)
        return float((np.log(model) + I / model).sum()), ((1.0 / model - I / model**2) @ parts)

    # of a residual that is no sum of white noises this search stops at a bound, and the autoregression is preferred:
    # the optimum beyond that bound explains the spectrum, but not the power
    bounds = [(MIN_LOG_POWER, MAX_LOG_POWER)] * 2
    likely = np.asarray(minimize(cost, np.full(2, np.log(0.5)), jac=True, method="L-BFGS-B", bounds=bounds).x)
    most = [raise_unknown(lambda x: cost(x)[0], likely, i, MAX_LOUDEST, BISECTIONS)[i] for i in (0, 1)]
    noise, loudest = np.sqrt(np.exp(np.array([likely, most])) * level / size).tolist()
    return WhiteNoiseFit(WhiteNoise(*noise), WhiteNoise(*loudest), cost(likely)[0] + len(I) * float(np.log(level)))


def whittle_cost(model: ArmaNoise, runs: Sequence[FloatArray]) -> float:
    """Return minus the logarithm of Whittle's likelihood of a model."""
    from scipy.signal import freqz

    total = 0.0
    A, B = model.polynomials
    for v in runs:
        w = 2.0 * np.pi * np.arange(len(v) // 2 + 1)[1:-1] / len(v)
        S = model.variance * np.abs(freqz(B, A, w)[1]) ** 2
        total += float((np.log(S) + _periodogram(v)[1:-1] / S).sum())
    return total
