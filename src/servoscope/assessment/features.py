"""One log to numbers: gates, oscillation, shapes, competing models; what the posterior is computed from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal

from servoscope.assessment import indices, models
from servoscope.assessment.indices import Oscillation
from servoscope.assessment.models import thin
from servoscope.core.arrays import BoolArray, FloatArray

MAX_SAMPLES = 1500  # that models are fitted to
SCALES = (1, 4, 16)  # samples that are averaged before models are fitted: jumps hide in the noise of single samples
SCALE_NAMES = ("", "4: ", "16: ")
MIN_SCALED = 50  # samples at a scale
SAMPLES_PER_PERIOD = 120.0  # that a long record is thinned to
ROUNDING = 1e-7  # of a signal's range, below which two numbers are the same


@dataclass(frozen=True)
class Analysis:
    """What was computed from one log."""

    features: dict[str, float]  # by name; bounded numbers for the posterior
    oscillation: Oscillation | None  # of the control error, in samples of the log as thinned
    evidence: models.ModelComparison  # at the scale at which stick-slip explains most
    linear: models.ModelFit  # at the finer scale
    margins: models.Margins
    thinned: int  # samples of the log in one sample of the analysis


def _runs(same: BoolArray) -> tuple[float, float]:
    """Return the share of true values, and the longest run of them as a share."""
    if not same.any():
        return 0.0, 0.0
    edges = np.flatnonzero(np.diff(np.r_[0, same.astype(int), 0]))
    return float(same.mean()), float(np.max(edges[1::2] - edges[::2]) / same.size)


def gate_shares(r: FloatArray, u: FloatArray, y: FloatArray) -> dict[str, float]:
    """Return how much of a log is constant, linear, on a coarse grid, or at a limit of u; shares from 0 to 1."""
    gates: dict[str, float] = {}
    for name, x in (("u", u), ("y", y)):
        span = float(np.ptp(x)) or 1.0
        step = np.abs(np.diff(x)) <= ROUNDING * span
        gates[f"{name} constant"], gates[f"{name} longest"] = _runs(step)
        bend = np.abs(np.diff(x, 2)) <= 10.0 * ROUNDING * span
        gates[f"{name} linear"] = float(np.mean(bend & ~step[1:]))
        steps = np.diff(np.unique(np.round(x / (ROUNDING * span)))) * ROUNDING * span
        local = float(np.std(np.diff(x))) / np.sqrt(2.0)
        coarse = float(np.quantile(steps, 0.05)) if steps.size else span
        gates[f"{name} grid"] = min(coarse / max(local, 1e-12 * span), 3.0)
    span = float(np.ptp(u)) or 1.0
    at_limit = [_limit_share(u, edge, span) for edge in (u.min(), u.max())]
    gates["saturated"] = max(at_limit) if gates["u longest"] < 0.98 else 1.0
    return gates


def _limit_share(u: FloatArray, edge: float, span: float) -> float:
    at = np.abs(u - edge) <= 1e-4 * span
    return _runs(at)[0] if at.sum() >= 5 else 0.0


def analyse(r: FloatArray | None, u: FloatArray, y: FloatArray) -> Analysis:
    """Analyse equidistant samples without gaps, shape (N,); r may be missing."""
    has_reference = r is not None
    reference = r if r is not None else np.full(y.size, float(np.mean(y)))
    gates = gate_shares(reference, u, y)
    oscillation = indices.find_oscillation(reference - y if has_reference else y)
    thinned = _thinning(y.size, oscillation)
    reference, u, y = (thin(x, thinned) for x in (reference, u, y))
    e = reference - y
    if thinned > 1:
        oscillation = indices.find_oscillation(e)
    period = oscillation.period if oscillation is not None else min(y.size / 8.0, 50.0)
    f = dict(gates)
    f["oscillates"] = float(np.log(np.clip(oscillation.regularity, 0.2, 20.0))) if oscillation else -1.6
    f["share"] = oscillation.share if oscillation else 0.0
    f["has cycles"] = float(np.log10(max(y.size / period, 1.0)))
    f["per period"] = float(np.log10(np.clip(period, 2.0, 300.0)))
    for name, x in (("u", u), ("y", y if not has_reference else -e)):
        f[f"{name} triangle"], f[f"{name} rectangle"] = indices.shape_index(x, period)
        second, third = indices.harmonics(x, period)
        f[f"{name} second"], f[f"{name} third"] = (float(np.log10(np.clip(h, 1e-4, 3.0))) for h in (second, third))
    band_u, band_y = indices.smooth_to(u, period), indices.smooth_to(y, period)
    f["odd"] = indices.cross_correlation_index(band_u, band_y)
    f["correlation"] = float(
        abs(np.corrcoef(band_u + 1e-12 * np.arange(u.size), band_y + 1e-12 * np.arange(u.size))[0, 1])
    )
    f["width"] = indices.ellipse_width(band_u, band_y, period) / max(float(np.ptp(band_u)), 1e-300)
    f["steady"] = _steady_share(band_u, band_y)
    fast = np.std(np.diff(y)) / max(float(np.std(y)), 1e-300)
    f["roughness"] = float(np.log10(np.clip(fast, 1e-4, 2.0)))
    f["u roughness"] = float(np.log10(np.clip(np.std(np.diff(u)) / max(float(np.std(u)), 1e-300), 1e-4, 2.0)))
    scales = [scale for scale in SCALES if scale == 1 or y.size // scale >= MIN_SCALED]
    fits = models.compare_models(u - u.mean(), y - y.mean(), period, scales)
    margins = [models.estimate_margins(fit.linear, thin(e, k), thin(u, k)) for fit, k in zip(fits, scales, strict=True)]
    for i, name in enumerate(SCALE_NAMES):
        at = min(i, len(scales) - 1)  # a short record repeats its coarsest scale
        f |= {f"{name}{key}": value for key, value in _scale_features(fits[at], margins[at], u, y, scales[at]).items()}
    best = max(fits, key=lambda fit: fit.gain(fit.stick, 2))
    f["damping"] = _damping(e, period)
    rho, lag = _decay(e)
    f["memory"] = float(np.log10(lag))
    f["slowness"] = float(np.log10(lag / (fits[0].linear.delay + 1.0)))
    f["y tails"], f["u tails"] = _tails(band_y), _tails(band_u)
    f["rest"] = rho
    f["error"] = float(np.log10(np.clip(np.std(e) / max(float(np.std(y)), 1e-300), 0.01, 10.0)))
    f["moving reference"] = float(
        np.mean(np.abs(np.diff(reference)) > ROUNDING * max(float(np.ptp(reference)), 1e-300))
    )
    f["offset"] = float(np.clip(abs(np.mean(e)) / max(float(np.std(e)), 1e-300), 0.0, 3.0))
    f["still"] = _unanswered(u, y)
    return Analysis(f, oscillation, best, fits[0].linear, margins[0], thinned)


def _thinning(samples: int, oscillation: Oscillation | None) -> int:
    wanted = oscillation.period / SAMPLES_PER_PERIOD if oscillation is not None else 1.0
    return max(int(min(wanted, samples / 400.0)), -(-samples // MAX_SAMPLES), 1)


def _scale_features(
    fit: models.ModelComparison, margins: models.Margins, u: FloatArray, y: FloatArray, scale: int
) -> dict[str, float]:
    f: dict[str, float] = {}
    for name, model, parameters in (
        ("stick", fit.stick, 2),
        ("dead band", fit.dead_band, 1),
        ("clip", fit.clip, 1),
        ("outside", fit.outside, 2),
    ):
        gain = max(fit.gain(model, parameters), 0.0)
        f[f"{name} gain"] = min(float(np.sqrt(gain / fit.samples)), 1.0)
        f[f"{name} evidence"] = float(np.log1p(gain))
    f["slip"] = _signed_log(fit.between(fit.dead_band, fit.stick))
    f["size"] = min(max(fit.stick.size, fit.dead_band.size) / max(float(np.ptp(u)), 1e-300), 1.0)
    f["jump"] = fit.stick.jump / fit.stick.size
    f["response"] = float(np.log1p(max(fit.between(fit.alone, fit.linear), 0.0)))
    f["margin"] = float(np.log10(np.clip(margins.gain, 0.3, 100.0)))
    f["peak"] = float(np.log10(np.clip(margins.peak, 1.0, 100.0)))
    f["law"] = float(np.clip(margins.explained, 0.0, 1.0))
    f["y jumps"] = _tails(np.diff(thin(y, scale)))
    f["u corners"] = _tails(np.diff(thin(u, scale), 2))
    return f


def _signed_log(gain: float) -> float:
    return float(np.sign(gain) * np.log1p(abs(gain)))


def _steady_share(u: FloatArray, y: FloatArray) -> float:
    """Return the share of the samples at which u moves in which y does not (as Yamashita's patterns, 2006)."""
    du, dy = np.abs(np.gradient(u)), np.abs(np.gradient(y))
    moves = du > np.median(du)
    return float(np.mean(dy[moves] < 0.25 * dy.mean())) if moves.any() else 0.0


def _tails(x: FloatArray) -> float:
    """Return ln of the kurtosis: 0 of a square wave, 0.4 of a sine, 1.1 of Gaussian noise, more of rare jumps."""
    x = x - x.mean()
    if not (largest := float(np.abs(x).max())) > 0.0:
        return 0.0
    x = x / largest  # the fourth power of a signal may be more than a number holds
    return float(np.clip(np.log(np.mean(x**4) / np.mean(np.square(x)) ** 2), 0.0, 4.0))


def _damping(e: FloatArray, period: float) -> float:
    """Return log10 of the damping of the autoregression's pole next to the oscillation's frequency."""
    step = max(int(period / 12.0), 1)
    e = thin(e - e.mean(), step)
    order = 8
    if e.size < 6 * order or not e.var() > 0.0:
        return 0.0
    rows = np.stack([e[order - i - 1 : -i - 1] for i in range(order)], axis=1)
    poles = np.roots(np.r_[1.0, -np.linalg.lstsq(rows, e[order:], rcond=None)[0]])
    s = np.log(np.where(np.abs(poles) > 1e-9, poles, 1e-9).astype(complex))
    near = np.argmin(np.abs(np.abs(s.imag) - 2.0 * np.pi * step / period) + np.maximum(-s.real, 0.0))
    return float(np.log10(np.clip(-s.real[near] / max(abs(s[near]), 1e-9), 1e-3, 1.0)))


def _decay(e: FloatArray) -> tuple[float, float]:
    """Return the autocorrelation's deepest minimum, and the lag at which it falls to 1/e [samples]."""
    x = e - e.mean()
    rho = np.fft.irfft(np.abs(np.fft.rfft(x, 2 * x.size)) ** 2)[: x.size // 3]
    if not rho[0] > 0.0:
        return 0.0, 1.0
    rho = rho / rho[0]
    below = np.flatnonzero(rho < np.exp(-1.0))
    return float(rho.min()), float(below[0] if below.size else rho.size)


def _unanswered(u: FloatArray, y: FloatArray) -> float:
    """Return how far u moves in one direction while y does not follow, relative to what the whole record shows."""
    slow = max(u.size // 40, 2)
    up, of_y = (signal.detrend(thin(x, slow), type="constant") for x in (u, y))
    du, dy = np.diff(up), np.diff(of_y)
    scale = float(np.abs(dy).max())
    noise = float(np.std(np.diff(y))) / np.sqrt(2.0 * slow)
    if not scale > 0.0:
        return 1.0
    rests = np.abs(dy) < max(0.1 * scale, 2.0 * noise)
    return float(np.abs(du[rests]).sum() / max(float(np.abs(du).sum()), 1e-300))
