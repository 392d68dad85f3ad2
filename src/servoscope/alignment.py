"""The delay between u as logged and u acting on y: the one that leaves the least residual variance."""

from __future__ import annotations

import math

import numpy as np

from servoscope.levels import Said
from servoscope.modelfit import Fitted, IndexArray, Regressors, regressors
from servoscope.plants import FloatArray
from servoscope.recording import Recording

FRACTIONS = 4  # of a sample, between which the residual variance is a parabola
EARLIEST = -3  # samples; negative: u is logged after it acted
LATEST_S = 0.05  # s, and at least
LATEST = 8  # samples
CHI2_95 = 3.841458820694124
PARABOLA = 1e-12  # curvature relative to the variance below which there is none
WIDEST = 1.5  # samples that the interval may span in total
PRIOR = 1.0  # standard deviation of a coefficient around its nominal value, relative to it


class Delay(Said):
    """Delay from u as logged to u acting.

    `samples` and `seconds` are None where the residual variance is flat or falls towards the end of the
    range, the 95 % interval `low_samples` ... `high_samples` in the latter case only. `gain` is the share of the
    residual variance that the delay takes away against the loop's own (`configured_samples`). The interval
    counts noise, not an inverse that is too simple: what the model lacks of the plant looks like delay.
    """

    samples: float | None
    seconds: float | None
    low_samples: float | None
    high_samples: float | None
    gain: float
    identifiable: bool
    configured_samples: float
    words: str


def estimate(recording: Recording, g: Regressors, which: IndexArray, fitted: Fitted, independent: float) -> Delay:
    """Search the delay, in quarters of a sample and between them by a parabola.

    Delay looks like more of the higher powers of s, and the other way round: with three of them free, all but
    the third power of the delay is absorbed. Where the plant has nominal values they therefore hold the
    coefficients, each within a standard deviation of 100 %.

    Parameters
    ----------
    recording
        N samples.
    g
        Regressors with the loop's own delay.
    which
        Columns of phi to use.
    fitted
        Fit of them.
    independent
        Number of independent residuals, for the interval.
    """
    rate, configured = recording.sample_rate, g.loop.delay * recording.sample_rate
    latest = max(LATEST, math.ceil(LATEST_S * rate), math.ceil(configured) + 4)
    stretch = np.cumsum(recording.restart)
    rows = np.flatnonzero(fitted.used)
    # One set of rows for all delays: those that stay in their stretch for each of them.
    early, late = rows - latest - 1, rows - EARLIEST
    inside = (early >= 0) & (late < recording.samples)
    rows = rows[inside]
    rows = rows[(stretch[rows - latest - 1] == stretch[rows]) & (stretch[rows - EARLIEST] == stretch[rows])]
    rows = rows[g.ok[rows - latest - 1]]
    if rows.size < 20 * (len(which) + 2):
        return _flat(configured, "not identifiable: too few samples between the gaps")
    Q, goal = _held(g, which, rows, fitted, independent)
    delays, variances = [], []
    for part in range(FRACTIONS):
        shifted = regressors(recording, g.loop, part / FRACTIONS / rate)
        for whole in range(EARLIEST, latest + 1):
            eta = shifted.eta[rows - whole]
            eta = eta - eta.mean()
            total = float(eta @ eta)
            eta = np.concatenate([eta, goal])
            left = eta - Q @ (Q.T @ eta)
            delays.append(whole + part / FRACTIONS)
            variances.append(float(left @ left) / max(total, np.finfo(np.float64).tiny))
    order = np.argsort(delays)
    return _described(np.array(delays)[order], np.array(variances)[order], configured, independent, rate)


def _held(
    g: Regressors, which: IndexArray, rows: IndexArray, fitted: Fitted, independent: float
) -> tuple[FloatArray, FloatArray]:
    """Return an orthonormal basis of the columns over rows that hold them, and what those rows aim at."""
    phi = g.columns(which)[rows]
    size = np.sqrt((phi**2).mean(axis=0))
    plant = g.loop.plant
    extra = np.zeros((0, len(which)))
    goal = np.zeros(0)
    if plant.has_physics and len(plant.theta()) == len(which):
        nominal = plant.theta()
        # Correlated residuals weigh as much as the independent ones among them.
        weight = math.sqrt(float(fitted.v[fitted.used].var()) * rows.size / max(independent, 1.0))
        pull = np.divide(weight, PRIOR * np.abs(nominal), out=np.zeros_like(nominal), where=nominal != 0.0)
        extra, goal = np.diag(pull), pull * nominal
    phi = np.vstack([phi, extra])[:, size > 0.0] / size[size > 0.0]
    Q, _ = np.linalg.qr(phi)
    return np.asarray(Q), goal


def _described(d: FloatArray, J: FloatArray, configured: float, independent: float, rate: float) -> Delay:
    best = int(np.argmin(J))
    if J[best] <= 0.0 or best in (0, d.size - 1):
        where = "short" if best == 0 else "long"
        words = f"not identifiable: the {where}est delay tried, {d[best]:g} samples, fits best"
        return _flat(configured, words)
    before, here, after = J[best - 1], J[best], J[best + 1]
    curvature = (before - 2.0 * here + after) * FRACTIONS**2
    offset = 0.5 * (before - after) / max(before - 2.0 * here + after, PARABOLA * here) / FRACTIONS
    least = max(here - 0.5 * curvature * offset**2, 0.5 * here)
    # Likelihood ratio: N log(J / J_min) = chi^2 at the ends of the interval.
    level = least * math.exp(CHI2_95 / max(independent, 1.0))
    samples = float(d[best] + offset)
    below = np.flatnonzero(level >= J)
    half = math.sqrt(2.0 * (level - least) / max(curvature, PARABOLA * least))
    low = min(samples - half, float(d[below[0]])) if below.size else samples - half
    high = max(samples + half, float(d[below[-1]])) if below.size else samples + half
    gain = 1.0 - least / float(np.interp(configured, d, J))
    if high - low > WIDEST:
        words = f"not identifiable: anything from {low:.2g} to {high:.2g} samples fits as well"
        return _flat(configured, words, low, high)
    sure = f"{low:.2f} to {high:.2f}"
    words = f"{samples:.2f} samples ({1e3 * samples / rate:.3g} ms), 95 % interval {sure} samples"
    return Delay(
        samples=samples,
        seconds=samples / rate,
        low_samples=low,
        high_samples=high,
        gain=max(gain, 0.0),
        identifiable=True,
        configured_samples=configured,
        words=words,
    )


def _flat(configured: float, words: str, low: float | None = None, high: float | None = None) -> Delay:
    return Delay(
        samples=None,
        seconds=None,
        low_samples=low,
        high_samples=high,
        gain=0.0,
        identifiable=False,
        configured_samples=configured,
        words=words,
    )
