"""How well an inverse model explains a recording: regression, order, free run, and what is left over."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray, IndexArray
from servoscope.estimation import filter_bank
from servoscope.estimation.filter_bank import FilterBank
from servoscope.estimation.kernel.sample_steps import USED
from servoscope.estimation.pipeline import Pipeline
from servoscope.estimation.recursion import Recursion
from servoscope.fit.tuning import sandwich_covariance
from servoscope.learning.inspection.signals import InspectionModel
from servoscope.models.loop import Loop, MonitorSettings
from servoscope.models.plants import Column
from servoscope.models.plants.polynomial import FrictionKind, PolynomialPlant
from servoscope.signals import Recording

MIN_ORDER_GAIN = 0.02  # share of the unexplained variance that one more power of s must take away
MIN_FRICTION_GAIN = 0.2  # and that Coulomb friction must: its sign is never quite right
MIN_USED_SHARE = 0.1  # share of the samples that must be left when rest is left out
FAST_SIGN = 50.0  # Hz, of the differentiator behind sign(y')


class ModelOrderFit(InspectionModel):
    """A generic inverse with offset, and the share of the filtered u that it explains."""

    order: int
    friction: FrictionKind
    stiffness: bool
    explained: float


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
class RegressionFit:
    """Least squares over the rows `used`."""

    names: tuple[str, ...]  # of the n coefficients
    # theta, covariance: shape (n,) and (n, n); the covariance counts residuals that hang together (batch means)
    theta: FloatArray
    covariance: FloatArray
    v: FloatArray  # residual, shape (N,), 0 where not used
    used: BoolArray  # shape (N,)
    explained: float  # share of the variance of eta
    condition: float  # condition number of R_phi with columns scaled to rms 1
    weakest: FloatArray  # its weakest direction in scaled coefficients, shape (n,)


def generic_loop(rate: float, cutoff: float, sign_speed: float = 0.0) -> Loop:
    """Build a loop around the most general inverse: order 3 with stiffness, Coulomb friction and offset."""
    plant = PolynomialPlant(
        order=3,
        stiffness=True,
        friction="coulomb",
        offset=True,
        sign_speed=sign_speed,
        sign_cutoff=min(FAST_SIGN, rate / 4.0),
    )
    monitor = MonitorSettings(cutoff=cutoff, evaluation_rate=min(10.0, rate), frequencies=(rate / 10.0,))
    return Loop(name="generic inverse", sample_rate=rate, plant=plant, monitor=monitor)


def form_regressors(recording: Recording, loop: Loop, delay: float | None = None) -> Regressors:
    """Form eta and phi with the state-variable filter, whatever structure and estimator the loop asks for."""
    monitor = loop.monitor.model_copy(update={"structure": "svf", "update_when": "always"})
    loop = loop.model_copy(update={"monitor": monitor, "delay": loop.delay if delay is None else delay})
    bank = filter_bank.build_filter_bank(loop)
    pipeline = Pipeline(loop, bank)
    constants = pipeline.constants(pipeline.blank())._replace(stride=1)  # here, every sample counts
    u = pipeline.input(recording.r, recording.u, recording.y, recording.restart)
    recursion = Recursion([constants])
    rows, said = recursion.regressors(recursion.start()[0], recording.r, u, recording.y, recording.restart)
    return Regressors(loop, bank, rows[:, 0], rows[:, 1 : 1 + bank.n], said == USED)


def motion_mask(g: Regressors, at_rest: BoolArray) -> BoolArray:
    """Return where neither the output rests nor the filters remember a rest, if enough is left then."""
    last = np.where(at_rest, np.arange(at_rest.size), -g.bank.wait - 1)
    moving = np.arange(at_rest.size) - np.maximum.accumulate(last) > g.bank.wait
    for mask in (moving, ~at_rest):
        if (g.ok & mask).sum() >= max(MIN_USED_SHARE * at_rest.size, 100):
            return np.asarray(mask)
    return np.ones_like(at_rest)


def fit_regression(
    names: tuple[str, ...], eta: FloatArray, phi: FloatArray, used: BoolArray, block: int
) -> RegressionFit | None:
    """Fit eta = phi theta; None if there are too few rows or eta does not vary."""
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
    covariance = sandwich_covariance(G, scores.T @ scores, size)
    return RegressionFit(
        names=names,
        theta=scaled / size,
        covariance=covariance,
        v=v,
        used=used,
        explained=1.0 - float(residual.var()) / spread,
        condition=float(value[-1] / max(value[0], np.finfo(np.float64).tiny)),
        weakest=vector[:, 0],
    )


def column_indices(g: Regressors, order: int, friction: FrictionKind, stiffness: bool = True) -> IndexArray:
    """Return which columns of the most general inverse belong to a smaller one."""
    n_powers = len(g.bank.powers)
    extras = [i + n_powers for i, extra in enumerate(g.bank.extras) if friction == "coulomb" or extra != Column.SIGN]
    return np.array([*range(0 if stiffness else 1, order + 1), *extras], dtype=np.intp)


def select_order(g: Regressors, used: BoolArray, block: int) -> tuple[tuple[ModelOrderFit, ...], ModelOrderFit | None]:
    """Fit the generic inverses of order 1 to 3, then the best with Coulomb friction and without stiffness.

    The best is the lowest whose successor takes away less than 2 % of the unexplained variance; stiffness
    stays if it takes away as much, friction if it takes away 20 %.
    """

    def attempt(order: int, friction: FrictionKind, stiffness: bool) -> ModelOrderFit | None:
        which = column_indices(g, order, friction, stiffness)
        fitted = fit_regression(tuple(g.bank.names[i] for i in which), g.eta, g.columns(which), used, block)
        if fitted is None:
            return None
        return ModelOrderFit(order=order, friction=friction, stiffness=stiffness, explained=fitted.explained)

    tried = [fit for order in (1, 2, 3) if (fit := attempt(order, "none", True)) is not None]
    if not tried:
        return (), None
    best = tried[0]
    for candidate in tried[1:]:
        if 1.0 - candidate.explained < (1.0 - MIN_ORDER_GAIN) * (1.0 - best.explained):
            best = candidate
    rough = attempt(best.order, "coulomb", True)
    if rough is not None:
        tried.append(rough)
        if 1.0 - rough.explained < (1.0 - MIN_FRICTION_GAIN) * (1.0 - best.explained):
            best = rough
    loose = attempt(best.order, best.friction, False)
    if loose is not None:
        tried.append(loose)
        if 1.0 - best.explained > (1.0 - MIN_ORDER_GAIN) * (1.0 - loose.explained):
            best = loose
    return tuple(tried), best
