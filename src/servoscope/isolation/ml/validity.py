"""Whether the exact predictor explains the healthy recordings, and with which noise: only then is a refit worth it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.records import ExactPredictorFit
from servoscope.estimation.noise_model import LIKELIHOOD_DROP, WhiteNoise
from servoscope.isolation.ml.goodness_of_fit import misspecification_columns, score_test
from servoscope.isolation.ml.window import ChangeProfile, RefitWindow
from servoscope.signals import Recording

MAX_SAMPLES = 60_000  # samples of a recording that are looked at
NOISE_RATIO_RANGE = 20.0  # times more or less noise on u, relative to that on y, than the recursion's residual shows
BISECTIONS = 6
MIN_NOISE_SHARE = 1e-6  # of the noise; what is quieter was simulated without any


def fit_exact_predictor(baseline: Baseline, recordings: Sequence[Recording]) -> ExactPredictorFit | None:
    """Return the noise that makes the innovations of healthy recordings likeliest, and what they leave unexplained.

    None where the predictor cannot be written down: the noise is unknown, the plant is not linear, the input is not
    held. n_u is the loudest that the innovations allow: their likelihood has fallen by exp(-`LIKELIHOOD_DROP`) there.
    """
    from scipy.optimize import minimize_scalar

    loop, noise = baseline.loop, baseline.noise
    if noise is None or not noise.y_std > 0.0 or loop.monitor.model_error or loop.hold != "zoh":
        return None
    if not loop.plant.has_physics or not loop.plant.linear or loop.plant.extras:
        return None

    known = baseline.model_copy(update={"exact": ExactPredictorFit(noise=noise, misfit=0.0)})
    whole = [RefitWindow.from_recording(known, rec, 0, min(rec.samples, MAX_SAMPLES)) for rec in recordings]

    def windows(u_std: float, y_std: float) -> list[RefitWindow]:
        heard = WhiteNoise(u_std, y_std)
        return [replace(window, factory=replace(window.factory, noise=heard)) for window in whole]

    def parts(x: float) -> tuple[float, float]:
        """Return the sum of squares and of log S, for noise of u exp(x) times as loud as y's in their usual units."""
        each = windows(noise.y_std * usual * np.exp(x), noise.y_std)
        squares = sum(
            float((window.innovations(window.healthy, ChangeProfile(window.samples)) ** 2).sum()) for window in each
        )
        return squares, sum(window.samples * float(np.log(window.healthy.S[0, -1])) for window in each)

    def cost(x: float) -> float:
        squares, volume = parts(x)
        return samples * float(np.log(squares)) + volume

    samples = sum(window.samples for window in whole)
    usual = max(noise.u_std / noise.y_std, 1e-3 * float(np.mean([rec.u.std() for rec in recordings])) / noise.y_std)
    if parts(0.0)[0] < MIN_NOISE_SHARE * samples:
        return None
    reach = float(np.log(NOISE_RATIO_RANGE))
    split = float(minimize_scalar(cost, bounds=(-reach, reach), method="bounded", options={"xatol": 0.02}).x)
    # a minute hardly tells how loud n_u is: too much of it costs little, too little makes slow errors look certain
    likely, high = cost(split), reach
    for _ in range(BISECTIONS):
        middle = 0.5 * (split + high)
        split, high = (middle, high) if cost(middle) < likely + 2.0 * LIKELIHOOD_DROP else (split, middle)
    std = noise.y_std * float(np.sqrt(parts(split)[0] / samples))
    found = WhiteNoise(u_std=std * usual * float(np.exp(split)), y_std=std)
    return ExactPredictorFit(noise=found, misfit=max(_misfit(window) for window in windows(found.u_std, found.y_std)))


def _misfit(window: RefitWindow) -> float:
    """Return the score statistic of a healthy window over its limit."""
    m, always = window.nuisance_count, ChangeProfile(window.samples)
    nothing = np.zeros(m)
    residual = window.residual(nothing, (), always)
    jacobian = window.jacobian(nothing, (), always)
    noise_variance = float(residual @ residual) / window.samples
    Z = misspecification_columns(window, window.healthy, always, np.ones(window.samples, dtype=np.bool_))
    found = score_test(Z, jacobian, residual, noise_variance, 0.0)
    return found.statistic / found.limit
