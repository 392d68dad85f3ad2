"""How well an inverse model explains a recording: regression, order, free run, and what is left over."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from servoscope import inverse
from servoscope.inverse import FilterBank
from servoscope.levels import BoolArray, Said
from servoscope.linear import sampled
from servoscope.loop import Loop, MonitorSettings
from servoscope.pipeline import Pipeline
from servoscope.plants import FloatArray
from servoscope.plants.polynomial import Friction, Polynomial
from servoscope.recording import Recording

WORTH = 0.02  # share of the unexplained variance that one more power of s must take away
FAST_SIGN = 50.0  # Hz, of the differentiator behind sign(y')
IndexArray = npt.NDArray[np.intp]


class OrderTried(Said):
    """A generic inverse, its friction, and the share of filtered u that it explains (None: not enough samples)."""

    order: int
    friction: Friction
    explained: float


class FreeRun(Said):
    """The estimated model driven by u alone: share of y that it explains, or why there is none."""

    explained: float | None
    words: str


@dataclass(frozen=True, eq=False)
class Regressors:
    """A bank and what it makes of a recording: eta (N,), phi (N, n), and usable (N,)."""

    loop: Loop
    bank: FilterBank
    eta: FloatArray
    phi: FloatArray
    ok: BoolArray

    def columns(self, which: IndexArray) -> FloatArray:
        """Return some columns of phi."""
        return self.phi[:, which]


@dataclass(frozen=True, eq=False)
class Fitted:
    """Least squares over the rows `used`.

    Parameters
    ----------
    names
        Of the n coefficients.
    theta, covariance
        Shape (n,) and (n, n); the covariance counts residuals that hang together (batch means).
    v
        Residual, shape (N,), 0 where not used.
    used
        Shape (N,).
    explained
        Share of the variance of eta.
    condition
        Condition number of R_phi with columns scaled to rms 1.
    weakest
        Its weakest direction in scaled coefficients, shape (n,).
    """

    names: tuple[str, ...]
    theta: FloatArray
    covariance: FloatArray
    v: FloatArray
    used: BoolArray
    explained: float
    condition: float
    weakest: FloatArray


def generic_loop(rate: float, cutoff: float, sign_speed: float = 0.0) -> Loop:
    """Build a loop around the most general inverse tried: order 3 with stiffness, Coulomb friction and offset."""
    plant = Polynomial(
        order=3,
        stiffness=True,
        friction="coulomb",
        offset=True,
        sign_speed=sign_speed,
        sign_cutoff=min(FAST_SIGN, rate / 4.0),
    )
    monitor = MonitorSettings(cutoff=cutoff, evaluation_rate=min(10.0, rate), frequencies=(rate / 10.0,))
    return Loop(name="generic inverse", sample_rate=rate, plant=plant, monitor=monitor)


def regressors(recording: Recording, loop: Loop, delay: float | None = None) -> Regressors:
    """Form eta and phi with the state-variable filter, whatever structure and estimator the loop asks for.

    Parameters
    ----------
    recording
        N samples.
    loop
        The loop; its gating at rest is left aside, because rest is looked for here.
    delay
        In place of the loop's [s].
    """
    monitor = loop.monitor.model_copy(update={"structure": "svf", "update_when": "always"})
    loop = loop.model_copy(update={"monitor": monitor, "delay": loop.delay if delay is None else delay})
    bank = inverse.build(loop)
    g = Pipeline(loop, bank).regression(recording.r, recording.u, recording.y, recording.restart)
    return Regressors(loop, bank, g.eta, g.phi, g.ok)


def fit(names: tuple[str, ...], eta: FloatArray, phi: FloatArray, used: BoolArray, block: int) -> Fitted | None:
    """Fit eta = phi theta; None if there are too few rows or eta does not vary.

    Parameters
    ----------
    names
        Of the n columns.
    eta, phi
        Shape (N,) and (N, n).
    used
        Rows that count, shape (N,).
    block
        Samples after which residuals have nothing to do with each other.
    """
    n = phi.shape[1]
    rows = int(used.sum())
    if rows < 10 * n + 10:
        return None
    size = np.sqrt((phi[used] ** 2).mean(axis=0))
    size[size == 0.0] = 1.0
    X, e = phi[used] / size, eta[used]
    spread = float(e.var())
    if not spread > 0.0:
        return None
    value, vector = np.linalg.eigh(X.T @ X / rows)
    kept = value > 1e-14 * value[-1]
    G = (vector[:, kept] / value[kept]) @ vector[:, kept].T / rows
    scaled = G @ (X.T @ e)
    residual = e - X @ scaled
    v = np.zeros_like(eta)
    v[used] = residual
    edges = np.arange(0, rows, max(block, rows // 200, 1))
    scores = np.add.reduceat(X * residual[:, None], edges, axis=0)
    covariance = G @ (scores.T @ scores) @ G / np.outer(size, size)
    return Fitted(
        names=names,
        theta=scaled / size,
        covariance=covariance,
        v=v,
        used=used,
        explained=1.0 - float(residual.var()) / spread,
        condition=float(value[-1] / max(value[0], np.finfo(np.float64).tiny)),
        weakest=vector[:, 0],
    )


def columns_of(g: Regressors, order: int, friction: Friction) -> IndexArray:
    """Return which columns of the most general inverse belong to a smaller one."""
    n_powers = len(g.bank.powers)
    extras = [i + n_powers for i, extra in enumerate(g.bank.extras) if friction == "coulomb" or extra != "sign_v"]
    return np.array([*range(order + 1), *extras], dtype=np.intp)


def try_orders(g: Regressors, used: BoolArray, block: int) -> tuple[list[OrderTried], OrderTried | None]:
    """Fit the generic inverses of order 1 to 3, then the best of them with Coulomb friction.

    The best is the lowest whose successor takes away less than 2 % of the unexplained variance.
    """
    tried: list[OrderTried] = []

    def attempt(order: int, friction: Friction) -> None:
        which = columns_of(g, order, friction)
        fitted = fit(tuple(g.bank.names[i] for i in which), g.eta, g.columns(which), used, block)
        if fitted is not None:
            tried.append(OrderTried(order=order, friction=friction, explained=fitted.explained))

    for order in (1, 2, 3):
        attempt(order, "none")
    if not tried:
        return tried, None
    best = tried[0]
    for candidate in tried[1:]:
        if 1.0 - candidate.explained < (1.0 - WORTH) * (1.0 - best.explained):
            best = candidate
    attempt(best.order, "coulomb")
    return tried, best


def free_run(recording: Recording, g: Regressors, fitted: Fitted, powers: tuple[int, ...]) -> FreeRun:
    """Simulate the estimated model with u alone and compare with y.

    Parameters
    ----------
    recording
        N samples.
    g
        Gives the columns beyond the powers of s, which are taken as measured.
    fitted
        Its first ``len(powers)`` coefficients are those of the powers.
    powers
        Powers of s.
    """
    from scipy.signal import lfilter, ss2tf

    order = max(powers)
    c = np.zeros(order + 1)
    c[list(powers)] = fitted.theta[: len(powers)]
    if c[-1] == 0.0:
        return FreeRun(explained=None, words=f"not possible: nothing excites the power {order} of s")
    # A pole that takes longer than ten recordings is an integrator for all that this one can tell.
    slow = 0.1 / recording.duration_s
    poles = np.roots(c[::-1])
    if poles.real.max() > slow:
        time = 1.0 / poles.real.max()
        return FreeRun(explained=None, words=f"not possible: the estimated model is unstable (grows in {time:.2g} s)")
    if (np.abs(poles) < slow).sum() > 1:
        return FreeRun(explained=None, words="not possible: the estimated model integrates twice, it would drift")
    A = np.eye(order, k=1)
    A[-1] = -c[:-1] / c[-1]
    B = np.zeros((order, 1))
    B[-1, 0] = 1.0 / c[-1]
    plant = sampled((A, B, np.eye(1, order)), recording.sample_rate, g.loop.hold, g.loop.delay)
    numerator, denominator = ss2tf(plant.A, plant.B, plant.C, plant.D)
    # What initial states and a constant input add dies out with these; they are fitted stretch by stretch.
    start = np.zeros((order, order))
    start[:, :] = np.eye(order)
    drive = g.bank.gain * recording.u - _extras(g, fitted, len(powers))
    starts = np.flatnonzero(recording.restart)
    left = whole = 0.0
    for begin, end in zip(starts, np.append(starts[1:], recording.samples), strict=True):
        if end - begin < 20 * (order + 1):
            continue
        y = recording.y[begin:end]
        y_u = lfilter(numerator[0], denominator, drive[begin:end])
        impulse = np.zeros(end - begin)
        impulse[0] = 1.0
        free = [lfilter(np.eye(order)[i], denominator, impulse) for i in range(order)]
        step = lfilter(numerator[0], denominator, np.ones(end - begin))
        nuisance = np.column_stack([*free, step])
        nuisance /= np.maximum(np.sqrt((nuisance**2).mean(axis=0)), np.finfo(np.float64).tiny)
        miss = y - y_u
        miss = miss - nuisance @ np.linalg.lstsq(nuisance, miss, rcond=1e-10)[0]
        left += float(miss @ miss)
        whole += float(((y - y.mean()) ** 2).sum())
    if not whole > 0.0 or not math.isfinite(left):
        return FreeRun(explained=None, words="not possible: no stretch without gaps is long enough")
    share = 1.0 - left / whole
    return FreeRun(explained=share, words=f"driven by u alone, the model explains {100 * max(share, 0.0):.3g} % of y")


def _extras(g: Regressors, fitted: Fitted, n_powers: int) -> FloatArray:
    """Return what friction and offset take from u, shape (N,), from their columns as filtered for the regression."""
    return np.asarray(g.phi[:, -len(fitted.theta[n_powers:]) :] @ fitted.theta[n_powers:]) * (
        1.0 if len(fitted.theta) > n_powers else 0.0
    )
