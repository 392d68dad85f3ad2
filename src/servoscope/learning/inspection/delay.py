"""The delay between u as logged and u acting on y: the one that leaves the least residual variance."""

from __future__ import annotations

import math

import numpy as np

from servoscope.core.arrays import FloatArray, IndexArray
from servoscope.core.messages import MessageText, message
from servoscope.learning.inspection.model_order import RegressionFit, Regressors, form_regressors
from servoscope.learning.inspection.signals import InspectionModel
from servoscope.signals import Recording

FRACTIONS = 4  # of a sample, between which the residual variance is a parabola
MIN_DELAY_SAMPLES = -3  # samples; negative: u is logged after it acted
MAX_DELAY_S = 0.05  # s, and at least
MIN_MAX_DELAY_SAMPLES = 8  # samples
CHI2_95_1DOF = 3.841458820694124  # chi-square quantile, 1 degree of freedom
PARABOLA = 1e-12  # curvature relative to the variance below which there is none
MAX_INTERVAL_SAMPLES = 1.5  # samples that the interval may span in total
PRIOR = 0.3  # standard deviation of a coefficient or parameter around its nominal value, relative to it
FLOOR = 0.005  # share of eta (rms) that the intersample model of y alone leaves unexplained


class Delay(InspectionModel):
    """Delay from u as logged to u acting.

    `samples` and `seconds` are None where the residual variance is flat or falls towards the end of the
    range, the 95 % interval `low_samples` ... `high_samples` in the latter case only. `gain` is the share of the
    residual variance that the delay takes away against the loop's own (`configured_samples`). The interval
    counts noise, not an inverse that is too simple: what the model lacks of the plant looks like delay.
    """

    samples: float | None = None
    seconds: float | None = None
    low_samples: float | None = None
    high_samples: float | None = None
    gain: float = 0.0
    identifiable: bool = False
    configured_samples: float
    words: MessageText

    @classmethod
    def within(cls, samples: float, low: float, high: float, rate: float, configured: float, gain: float) -> Delay:
        """Return a delay with its interval; the interval alone where it is too wide."""
        flat = message("inspection.delay_flat", low=low, high=high)
        interval = cls(low_samples=low, high_samples=high, configured_samples=configured, words=flat)
        if high - low > MAX_INTERVAL_SAMPLES:
            return interval
        words = message("inspection.delay_value", samples=samples, ms=1e3 * samples / rate, low=low, high=high)
        values = {"samples": samples, "seconds": samples / rate, "gain": max(gain, 0.0)}
        return interval.model_copy(update={**values, "identifiable": True, "words": words})


def estimate_delay(
    recording: Recording, g: Regressors, which: IndexArray, fitted: RegressionFit, independent: float
) -> Delay:
    """Search the delay, in quarters of a sample and between them by a parabola.

    Delay looks like more of the higher powers of s, and the other way round: with three of them free, all but
    the third power of the delay is absorbed. Where the plant has nominal values they therefore hold the
    coefficients, each within a standard deviation of 30 %; where it has not, the powers above the one that
    carries most of u are left out, and what they would explain counts as delay.
    """
    rate, configured = recording.sample_rate, g.loop.delay * recording.sample_rate
    latest = max(MIN_MAX_DELAY_SAMPLES, math.ceil(MAX_DELAY_S * rate), math.ceil(configured) + 4)
    stretch = np.cumsum(recording.restart)
    rows = np.flatnonzero(fitted.used)
    # One set of rows for all delays: those that stay in their stretch for each of them.
    early, late = rows - latest - 1, rows - MIN_DELAY_SAMPLES
    inside = (early >= 0) & (late < recording.samples)
    rows = rows[inside]
    rows = rows[(stretch[rows - latest - 1] == stretch[rows]) & (stretch[rows - MIN_DELAY_SAMPLES] == stretch[rows])]
    rows = rows[g.ok[rows - latest - 1]]
    if rows.size < 20 * (len(which) + 2):
        return Delay(configured_samples=configured, words=message("inspection.delay_few_samples"))
    Q, goal = _constrained_basis(g, which, rows, fitted, independent)
    delays, variances = [], []
    for part in range(FRACTIONS):
        shifted = form_regressors(recording, g.loop, part / FRACTIONS / rate)
        for whole in range(MIN_DELAY_SAMPLES, latest + 1):
            eta = np.concatenate([shifted.eta[rows - whole], goal])
            left = eta - Q @ (Q.T @ eta)
            delays.append(whole + part / FRACTIONS)
            variances.append(float(left @ left))
    order = np.argsort(delays)
    return _locate_minimum(np.array(delays)[order], np.array(variances)[order], configured, independent, rate)


def _constrained_basis(
    g: Regressors, which: IndexArray, rows: IndexArray, fitted: RegressionFit, independent: float
) -> tuple[FloatArray, FloatArray]:
    """Return an orthonormal basis of the columns over rows that hold them, and what those rows aim at."""
    phi = g.columns(which)[rows]
    size = np.sqrt((phi**2).mean(axis=0))
    n_powers, plant = len(g.bank.powers), g.loop.plant
    if not plant.has_physics:
        powers = [k for k, i in enumerate(which) if i < n_powers]
        carrier = max(powers, key=lambda k: abs(fitted.theta[k]) * size[k], default=0)
        keep = [k for k in range(len(which)) if (k <= carrier or k not in powers) and size[k] > 0.0]
        return np.asarray(np.linalg.qr(phi[:, keep] / size[keep])[0]), np.zeros(0)
    nominal = plant.theta()
    # Correlated residuals weigh as much as the independent ones among them.
    floor = FLOOR**2 * float((g.eta[rows] ** 2).mean())
    weight = max(float(fitted.v[fitted.used].var()), floor) * rows.size / max(independent, 1.0)
    spread = PRIOR * np.abs(nominal)
    pull = np.divide(math.sqrt(weight), spread, out=np.zeros_like(nominal), where=spread > 0.0)
    keep = list(np.flatnonzero(size > 0.0))
    held = np.vstack([phi, np.diag(pull)])[:, keep] / size[keep]
    return np.asarray(np.linalg.qr(held)[0]), pull * nominal


def _locate_minimum(d: FloatArray, J: FloatArray, configured: float, independent: float, rate: float) -> Delay:
    best = int(np.argmin(J))
    if J[best] <= 0.0 or best in (0, d.size - 1):
        end = "shortest" if best == 0 else "longest"
        words = message(f"inspection.delay_{end}", samples=float(d[best]))
        return Delay(configured_samples=configured, words=words)
    before, here, after = J[best - 1], J[best], J[best + 1]
    curvature = (before - 2.0 * here + after) * FRACTIONS**2
    offset = 0.5 * (before - after) / max(before - 2.0 * here + after, PARABOLA * here) / FRACTIONS
    least = max(here - 0.5 * curvature * offset**2, 0.5 * here)
    # Likelihood ratio: N log(J / J_min) = chi^2 at the ends of the interval.
    level = least * math.exp(CHI2_95_1DOF / max(independent, 1.0))
    samples = float(d[best] + offset)
    below = np.flatnonzero(level >= J)
    half = math.sqrt(2.0 * (level - least) / max(curvature, PARABOLA * least))
    low = min(samples - half, float(d[below[0]])) if below.size else samples - half
    high = max(samples + half, float(d[below[-1]])) if below.size else samples + half
    return Delay.within(samples, low, high, rate, configured, 1.0 - least / float(np.interp(configured, d, J)))
