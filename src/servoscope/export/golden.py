"""Golden samples: what a monitor makes of them, for the self-test of an exported one."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.covariates import CovariateModel
from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.core.errors import BaselineError
from servoscope.detection.covariate_monitor import CovariateMonitor
from servoscope.detection.statistic import apply_alarm_delays, consecutive_exceedances, t2_statistic
from servoscope.export.constants import ExportConstants
from servoscope.signals.quality import QualityLimits, QualitySettings, check_block, init_state

MIN_GOLDEN_SAMPLES, MAX_GOLDEN_SAMPLES = 2000, 20_000  # samples
SEED = 27
MAX_FACTOR = 1.1  # in the rate of false alarms, of single precision
TOLERANCE = 1e-9  # of T^2 beside covariates, relative above 1
FROZEN = {"frozen_y": 1, "frozen_u": 2}
WAITING, HEALTHY, FAULT = range(3)
FNV_OFFSET, FNV_PRIME = 14695981039346656037, 1099511628211


def golden_signals(
    baseline: Baseline, samples: int, seed: int = SEED
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Return r, u, y and restarts (samples,): a healthy loop, then a weaker u, and all that can be wrong with data.

    Where the loop can be simulated, that is its multisine; else sines with noise. Missing values, infinities, values
    that are no physical signal, restarts, a rest and zeros of both signs are among them.
    """
    rng, loop = np.random.default_rng(seed), baseline.loop
    if loop.controller is not None and loop.plant.has_physics:
        from servoscope.simulation import reference, simulate

        recording = simulate(loop, reference("multisine", samples / loop.sample_rate, loop.sample_rate), seed=seed)[0]
        r, u, y = (x[:samples].copy() for x in (recording.r, recording.u, recording.y))
    else:
        t = np.arange(samples) / loop.sample_rate
        cutoff = max(baseline.loop.monitor.frequencies)
        r = sum(np.sin(2.0 * np.pi * f * t + f) for f in np.linspace(0.1, 1.0, 5) * cutoff)
        y = r + 1e-3 * rng.standard_normal(samples)
        u = np.gradient(r) * loop.sample_rate + 1e-2 * rng.standard_normal(samples)
    u[samples // 2 :] *= 0.8
    restart = np.zeros(samples, dtype=np.bool_)
    restart[rng.integers(0, samples, 3)] = True
    dropout = slice(3 * samples // 4, 3 * samples // 4 + samples // 20)
    r[dropout], u[dropout], y[dropout] = 0.0, -0.0, 0.0
    for signal, wrong in zip((r, u, y, u), (np.nan, np.inf, np.nan, 1e150), strict=True):
        begin = int(rng.integers(samples // 10, samples - 20))
        signal[begin : begin + int(rng.integers(1, 6))] = wrong
    return r, u, y, restart


@dataclass(frozen=True, eq=False)
class GoldenRun:
    """Samples, and what a monitor makes of them."""

    signals: tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]]
    restart: BoolArray
    rows: FloatArray  # evaluations, shape (K, row)
    verdicts: tuple[int, ...]
    state: FloatArray  # at the end
    alarm: tuple[float, float]  # counters of the alarm at the end
    held: int  # sample at which y, and then u, is held to look frozen
    stretch: int  # samples of each of four stretches; y is held in the second, u in the last
    frozen: IntArray  # what is found to be frozen at each of them, 1 y, 2 u
    covariates: FloatArray | None = None  # at each sample, shape (N, k)

    @classmethod
    def from_baseline(cls, made: ExportConstants) -> GoldenRun:
        """Run a monitor over its golden samples."""
        baseline, recursion, limit = made.baseline, made.recursion, made.baseline.thresholds.statistic
        c, monitor, covariates = recursion.constants[0], made.covariates, None
        samples = int(np.clip(8 * c.wait + 20 * c.every, MIN_GOLDEN_SAMPLES, MAX_GOLDEN_SAMPLES))
        *signals, restart = golden_signals(baseline, samples)
        with np.errstate(over="ignore"):  # of values that are no physical signal
            r, u, y = (x.astype(recursion.number) for x in signals)
        begin, taken = recursion.start(), r
        if monitor is not None:
            covariates = golden_covariates(monitor.model, samples)
            beside = monitor.start()
            channels = dict(zip(monitor.model.names, covariates.T, strict=True))
            averages, theta = monitor.run(beside, (r, u, y), restart, channels)
            taken = np.where(np.isnan(averages).any(axis=1), np.nan, r)
            if theta is not None:
                recursion.named(begin)["theta"][0] = np.linalg.solve(c.basis, theta - c.origin)
        index = recursion.rows(begin, samples)
        state, rows = recursion.run(begin, taken[None], u[None], y[None], restart[None])
        if monitor is not None:
            state = np.concatenate([state, beside[None]], axis=1)
            rows = rows.copy()
            _move_rows(monitor, rows[0], averages[index], made.expected)
        verdicts, alarm = judge(rows[0], limit, made.delays)
        limits = QualitySettings().limits(baseline.loop.sample_rate)
        held, stretch = samples // 3, limits.frozen + samples
        frozen = frozen_signals(limits, *held_signals((r, u, y), held, stretch))
        return cls(
            (r, u, y), restart, rows[0].copy(), verdicts, state[0].copy(), alarm, held, stretch, frozen, covariates
        )


def golden_covariates(model: CovariateModel, samples: int) -> FloatArray:
    """Return covariates (samples, k): none at first, then a new value at each tenth sample, at the end outside."""
    at = np.arange(samples)[:, None] / samples
    low, high = np.array(model.low), np.array(model.high)
    values = low + (high - low) * np.where(at < 0.8, at / 0.8, 2.0)
    return np.where((np.arange(samples)[:, None] % 10 == 0) & (at > 0.01), values, np.nan)


def _move_rows(monitor: CovariateMonitor, rows: FloatArray, averages: FloatArray, expected: FloatArray) -> None:
    """Compare evaluations (K, row) with what is healthy at averages of the covariates (K, k), in place.

    Where they are not known, or outside of what was learned, there are no updates.
    """
    n = len(expected)
    moved, covariates, known = monitor.expect(averages)
    covariance = rows[:, 4 + n : 4 + n + n * n]
    covariance += covariates.reshape(len(rows), -1)
    T2 = t2_statistic(rows[:, 4 : 4 + n], expected + moved, covariance.reshape(-1, n, n))
    rows[:, 1] = np.where((rows[:, 0] > 0.0) & known, T2, 0.0)
    rows[:, 0] = np.where(known, rows[:, 0], 0.0)


def held_signals(
    signals: tuple[npt.NDArray[Any], ...], held: int, stretch: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the signals again and again, (4 stretch,); y is held in the second of four stretches, u in the last."""
    at = np.arange(4 * stretch) % len(signals[0])
    r, u, y = (x.astype(np.float64)[at] for x in signals)
    y[stretch : 2 * stretch], u[3 * stretch :] = signals[2][held], signals[1][held]
    return r, u, y


def frozen_signals(limits: QualityLimits, r: FloatArray, u: FloatArray, y: FloatArray) -> IntArray:
    """Return what the check of data quality calls frozen at each sample, shape (N,): 0, 1 y, 2 u, 3 both."""
    _, findings = check_block(limits, init_state(), np.arange(len(r)) * limits.period, r, u, y)
    changes = np.zeros(len(r), dtype=np.int64)
    for finding in findings:
        if finding.kind in FROZEN:
            changes[round(finding.time / limits.period)] += FROZEN[finding.kind] * (1 if finding.begins else -1)
    return np.cumsum(changes)


def judge(rows: FloatArray, limit: float, delays: tuple[int, int]) -> tuple[tuple[int, ...], tuple[float, float]]:
    """Return the verdict of each evaluation, and the counters of the alarm behind the last."""
    on, off = delays
    ready = rows[:, 0] > 0.0
    exceeded = ready & ((rows[:, 1] > limit) | (rows[:, 2] >= 1.0))
    verdict = np.where(ready, np.where(apply_alarm_delays(exceeded, on, off), FAULT, HEALTHY), WAITING)
    exceeding = consecutive_exceedances(exceeded)
    raised = np.flatnonzero(exceeding > on)
    since = min(len(rows) - 1 - raised[-1], off + 1) if raised.size else off + 1
    return tuple(verdict.tolist()), (float(exceeding[-1]) if len(rows) else 0.0, float(since))


def digest(numbers: Iterable[int]) -> int:
    """Return FNV-1a, 64 bits, over small numbers."""
    value = FNV_OFFSET
    for number in numbers:
        value = ((value ^ number) * FNV_PRIME) & 0xFFFFFFFFFFFFFFFF
    return value


def golden_words(run: GoldenRun) -> dict[str, Any]:
    """Return what the header with the golden samples and results names beside the image of the state."""
    samples_of = np.ascontiguousarray(np.stack(run.signals, axis=1))
    rows = samples_of.view(np.dtype(f"u{samples_of.itemsize}")).tolist()
    digits = 2 * samples_of.itemsize
    return {
        "run": run,
        "tolerance": TOLERANCE,
        "samples": ["{" + ", ".join(f"0x{bits:0{digits}X}u" for bits in row) + "}" for row in rows],
        "digests": [f"0x{digest(row.astype(row.dtype.newbyteorder('<')).tobytes()):016X}u" for row in run.rows],
        "frozen": f"0x{digest(run.frozen.tolist()):016X}u",
    }


def describe_rounding(made: ExportConstants, only_coefficients: bool, golden: GoldenRun) -> str:
    """Return what single precision does to the golden samples; raise BaselineError where that eats the promise.

    T^2 and the sequential test are log-likelihoods: an error of d multiplies the rate of false alarms by exp(d/2), or
    by exp(d h) where d is in units of a CUSUM's limit h.
    """
    double = ExportConstants.from_baseline(made.baseline, only_coefficients)
    exact = GoldenRun.from_baseline(double)
    limit = made.baseline.thresholds.statistic
    near = exact.rows[:, 1] < 2.0 * limit  # far above it, nothing hangs on an error
    watch = double.recursion.constants[0].watch
    h = 0.0 if watch is None else float(watch.limits.max())
    errors = np.abs(golden.rows.astype(np.float64) - exact.rows)[near][:, 1:3].max(axis=0, initial=0.0)
    factor = math.exp(max(0.5 * errors[0], h * errors[1]))
    if not factor <= MAX_FACTOR:
        raise BaselineError(
            f"{made.baseline.loop.name}: in single precision T^2 is off by up to {errors[0]:.2g} on golden samples, "
            f"and the rate of false alarms by a factor of {factor:.2g}: export double precision"
        )
    return (
        f"\n * Numbers are of single precision. On the golden samples that moves T^2 by no more than {errors[0]:.2g}"
        f" near its limit\n * {limit:.4g}, and the level of the sequential test by no more than"
        f" {errors[1]:.2g}: a factor of {factor:.4g} in the rate of false alarms.\n *"
    )
