"""What a baseline can promise: the smallest change it sees, the budget its data support, the model error they show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servoscope.baseline import Promise
from servoscope.detection import SECONDS_PER_YEAR, noncentrality, required_noncentrality, statistic, threshold
from servoscope.inverse import cutoff_of
from servoscope.linear import autocovariances
from servoscope.loop import Loop
from servoscope.pipeline import Estimates, Pipeline
from servoscope.plants import FloatArray
from servoscope.signatures import solve_scaled
from servoscope.tuning import Fit

WORTH_TELLING = 1.0 / 3.0  # standard deviations that noise in phi may move the iFRF in silence
WORTH_A_LOOK = 2.0  # T^2 per coefficient on healthy data above which the model is said to be wrong


def misfit_of(
    estimates: Sequence[Estimates], deviations: Sequence[FloatArray], covariance: FloatArray, found: Fit
) -> tuple[float, float]:
    """Return T^2 per coefficient on the healthy data themselves, and the model error that would bring it to one."""
    from scipy.optimize import brentq

    learned = [e.updates > 0 for e in estimates]
    S = np.concatenate([e.S[ok] for e, ok in zip(estimates, learned, strict=True)])
    d = np.concatenate([each[ok] for each, ok in zip(deviations, learned, strict=True)])
    if not len(d):
        return 0.0, 0.0
    unit = np.diag((found.rms_eta / found.tuning.scale) ** 2)

    def mean(rho: float) -> float:
        T2 = statistic(d, np.zeros_like(d), S + covariance + rho**2 * unit)
        return float(T2.mean()) / float(d.shape[1])

    excess = mean(0.0)
    if excess <= 1.0 or mean(0.5) > 1.0:
        return excess, 0.0 if excess <= 1.0 else 0.5
    root = brentq(lambda rho: mean(rho) - 1.0, 0.0, 0.5, xtol=1e-4)
    return excess, float(root)


def supported_budget(n: int, loop: Loop, dof: float, excess: float) -> float:
    """Return the smallest budget that the data speak for [false alarms per year].

    The tail of T^2 is extrapolated from the estimated noise; that is trusted while the noise's own uncertainty raises
    the threshold by less than half, and not at all where healthy data contradict the noise model.
    """
    if excess > WORTH_A_LOOK:
        return SECONDS_PER_YEAR / loop.monitor.memory
    looks = loop.monitor.evaluation_rate, loop.monitor.memory
    for exponent in np.arange(-3.0, 9.0, 0.5):
        budget = float(10.0**exponent)
        if threshold(n, *looks, budget, dof) <= 1.5 * threshold(n, *looks, budget, 1e9):
            return budget
    return SECONDS_PER_YEAR * looks[0]


def noise_bias(pipeline: Pipeline, found: Fit, estimates: Sequence[Estimates]) -> tuple[FloatArray, FloatArray]:
    """Return what noise in phi does to the iFRF, and the standard deviation of one estimate, both relative to |H|.

    Least squares are off by -(R_phi + S)^-1 S theta, S the covariance that the sensor's white noise has behind the
    filters (errors in variables; Soderstrom, 2007). Shapes (F,), (F,); zeros with an instrument and where the noise is
    not known.
    """
    loop, bank, n = pipeline.loop, pipeline.bank, pipeline.bank.n
    nothing = np.zeros(len(loop.monitor.frequencies))
    last = [e.S[-1] for e in estimates if len(e.S) and e.updates[-1] > 0]
    if bank.has_instrument or found.noises is None or not last:
        return nothing, nothing
    of_y = bank.linear.input(np.eye(2, 1, -1)).output(np.eye(n, 1 + n, 1))
    S = found.noises.noise.y_std**2 * autocovariances(of_y, 0)[0]
    R_phi = np.asarray(found.tuning.R / pipeline.memory * np.linalg.inv(found.tuning.P_d), dtype=np.float64)
    E = bank.E(loop.monitor.frequencies)
    H = np.abs(E @ found.tuning.theta)
    bias = np.abs(E @ solve_scaled(R_phi, S @ found.tuning.theta))
    spread = np.mean(last, axis=0)
    std = np.sqrt(np.einsum("fi,ij,fj->f", E, spread, E.conj()).real)
    return bias / H, std / H


def noise_notes(pipeline: Pipeline, found: Fit, estimates: Sequence[Estimates], simulated: bool) -> list[str]:
    """Say where noise in phi moves the iFRF by more than a third of its standard deviation, and what helps."""
    loop = pipeline.loop
    bias, std = noise_bias(pipeline, found, estimates)
    if not np.any(bias > WORTH_TELLING * std):
        return []
    at = int(np.argmax(bias / np.maximum(std, 1e-12)))
    told = (
        f"noise in y moves the estimated iFRF by {bias[at]:.2g} of its size at {loop.monitor.frequencies[at]:g} Hz, "
        f"where one estimate scatters by {std[at]:.2g}"
    )
    if simulated:
        return [f"{told}: diagnose takes it out, as the loop can be simulated"]
    if loop.controller is not None:
        return [f"{told}: estimator = 'iv-akf' removes it"]
    slower = cutoff_of(loop) / 2.0
    return [f"{told}: try [monitor] cutoff = {slower:g}, or give [controller] and the plant's nominal values"]


def promises(
    loop: Loop,
    directions: dict[str, FloatArray],
    estimates: Sequence[Estimates],
    covariance: FloatArray,
    limit: float,
) -> tuple[Promise, ...]:
    """Return the smallest change of each fault's parameter that the baseline's own excitation shows."""
    rows = np.array(list(directions.values()))
    seen = []
    for e in estimates:
        half = slice(len(e.theta) // 2, None)
        if len(e.theta[half]):
            seen.append(np.median(noncentrality(e.S[half] + covariance, e.Psi[half], rows), axis=0))
    needed = required_noncentrality(covariance.shape[0], limit)
    best = np.max(seen, axis=0) if seen else np.zeros(len(rows))
    return tuple(
        Promise(
            name=fault.name,
            parameter=fault.parameter,
            change=float(np.sqrt(needed / information)) if information > 0.0 else None,
        )
        for fault, information in zip(loop.plant.faults, best, strict=True)
    )
