"""The estimated model driven by u alone: what it explains of y, or why it cannot be run."""

from __future__ import annotations

import numpy as np

from servoscope.core.arrays import FloatArray, IndexArray
from servoscope.core.messages import MessageText, message
from servoscope.learning.inspection.model_order import RegressionFit, Regressors
from servoscope.learning.inspection.signals import InspectionModel
from servoscope.models.lti import sample_system
from servoscope.signals import Recording
from servoscope.signals.defects import mask_spans


class FreeRun(InspectionModel):
    """The estimated model driven by u alone: share of y that it explains, or why there is none."""

    explained: float | None
    words: MessageText


def free_run(recording: Recording, g: Regressors, which: IndexArray, fitted: RegressionFit) -> FreeRun:
    """Simulate the estimated model with u alone and compare with y, both behind the state-variable filter.

    Friction is driven by the measured speed. A plant without stiffness only accumulates its errors in y, so
    its speed is compared. Initial states and a constant input are fitted stretch by stretch.
    """
    names = [g.bank.names[i] for i in which]
    columns = dict(zip(names, g.columns(which).T, strict=True))
    theta = dict(zip(names, fitted.theta, strict=True))
    powers = [g.bank.powers[i] for i in which if i < len(g.bank.powers)]
    c = np.zeros(max(powers) + 1)
    for name, power in zip(names, powers, strict=False):
        c[power] = theta.pop(name)
    y = columns[names[powers.index(0)]] if 0 in powers else None
    speed = columns[names[powers.index(1)]] if 1 in powers else None
    directions = ("viscous_friction_forward", "viscous_friction_backward")
    if directions[0] in theta:
        c[1] = 0.5 * (theta[directions[0]] + theta[directions[1]])
        speed = columns[directions[0]] + columns[directions[1]]
        for name in directions:
            theta[name] -= c[1]
    drive = g.eta - sum(theta[name] * columns[name] for name in theta)
    output = y if y is not None else speed
    if output is None:
        return _not_simulated("no_output")
    if y is None:
        c = c[1:]
    if c[-1] == 0.0:
        return _not_simulated("no_highest_power")
    # A pole that takes longer than ten recordings is an integrator for all that this one can tell.
    slow = 0.1 / recording.duration_s
    poles = np.roots(c[::-1])
    if poles.size and poles.real.max() > slow:
        return _not_simulated("unstable", time_s=1.0 / float(poles.real.max()))
    if (np.abs(poles) < slow).sum() > 1:
        return _not_simulated("double_integrator")
    share = _simulated_share(g, c, drive, output)
    if share is None:
        return _not_simulated("no_stretch")
    key = "simulated_speed" if y is None else "simulated_y"
    return FreeRun(explained=share, words=message(f"inspection.{key}", share=share))


def _not_simulated(reason: str, **values: float) -> FreeRun:
    text = message("inspection.not_simulated", reason=message(f"inspection.{reason}", **values))
    return FreeRun(explained=None, words=text)


def _simulated_share(g: Regressors, c: FloatArray, drive: FloatArray, output: FloatArray) -> float | None:
    """Return the share of the output that ``1/sum c_i s^i`` makes of `drive`; None without a long stretch."""
    from scipy.signal import lfilter, ss2tf

    order = len(c) - 1
    numerator, denominator = np.array([1.0 / c[0] if order == 0 else 0.0]), np.ones(1)
    if order:
        A = np.eye(order, k=1)
        A[-1] = -c[:-1] / c[-1]
        B = np.zeros((order, 1))
        B[-1, 0] = 1.0 / c[-1]
        plant = sample_system((A, B, np.eye(1, order)), g.bank.sample_rate, "foh")
        numerators, denominator = ss2tf(plant.A, plant.B, plant.C, plant.D)
        numerator = numerators[0]
    left = whole = 0.0
    for begin, end in mask_spans(g.ok):
        if end - begin < 20 * (order + 2):
            continue
        y = output[begin:end]
        impulse = np.zeros(end - begin)
        impulse[0] = 1.0
        free = [lfilter(np.eye(order)[i], denominator, impulse) for i in range(order)]
        nuisance = np.column_stack([*free, lfilter(numerator, denominator, np.ones(end - begin))])
        nuisance /= np.maximum(np.sqrt((nuisance**2).mean(axis=0)), np.finfo(np.float64).tiny)
        miss = y - lfilter(numerator, denominator, drive[begin:end])
        if not np.isfinite(miss).all():
            return None
        miss = miss - nuisance @ np.linalg.lstsq(nuisance, miss, rcond=1e-10)[0]
        left += float(miss @ miss)
        whole += float(((y - y.mean()) ** 2).sum())
    return 1.0 - left / whole if whole > 0.0 else None
