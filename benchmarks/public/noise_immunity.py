"""Noise immunity at equal speed: estimators of servoscope beside those of other libraries, on the paper's conditions.

    python benchmarks public/noise_immunity [--seeds 3] [--json]

Conditions: the reference rig at 100 Hz with the paper's noise; the bilinear regression after a stage 1 by the AKF,
the same regressors for everybody. Each estimator runs with memories N from 1 to 12 s; its rise time is that of the
inverse frequency response at 1 Hz to half of a step of p_s by 40 %, its scatter the coefficient of variation over the
last 10 s of a healthy recording. Compared is the scatter at equal rise time: the geometric mean of the ratio over the
rise times that two curves share.

filterpy: Kalman filter of a random walk, Q = P_d/N; with a fading memory it is recursive least squares, l = 1 - 1/N.
statsmodels: the same Kalman filter in state space; least squares over a sliding window of N samples (RollingOLS).
river: BayesianLinearRegression with smoothing 1 - 1/N. python-control has no recursive estimator of parameters: its
Kalman filter asks for a constant output matrix, where the regressors change with every sample.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from tables import Table, parser, show

from servoscope.core.arrays import FloatArray
from servoscope.estimation import estimators
from servoscope.estimation.update import run_updates
from servoscope.research.paper import metrics
from servoscope.research.paper.conditions import FREQUENCIES, TRACKING_CASE, OperatingConditions, paper_loop
from servoscope.research.paper.method import ResidualGenerator, ResidualTrace
from servoscope.research.paper.tracking import TUNING_SEED_OFFSET
from servoscope.research.paper.tradeoff import MEMORIES, ifrf_rise_time

REFERENCES = ("profile", "multisine")
OWN = ("akf", "dfrls", "kf", "rls")
LOOK = 10  # samples from one evaluation to the next
LAST_S = (50.0, 60.0)  # where the scatter is taken


class Regression(NamedTuple):
    """What every estimator gets: a regression in units of its own scale, and where and how it starts."""

    eta: FloatArray  # shape (N,), of unit residual variance
    phi: FloatArray  # shape (N, n)
    theta: FloatArray  # shape (n,)
    P_d: FloatArray  # for a memory of `memory` samples, shape (n, n)
    memory: float


Estimator = Callable[[Regression], FloatArray]


def filterpy_kf(given: Regression) -> FloatArray:
    """Return theta (N, n) of filterpy's Kalman filter of a random walk."""
    return _filterpy(given, 1.0, given.P_d / given.memory)


def filterpy_rls(given: Regression) -> FloatArray:
    """Return theta (N, n) of filterpy's filter with a fading memory, as recursive least squares."""
    return _filterpy(given, (1.0 - 1.0 / given.memory) ** -0.5, np.zeros_like(given.P_d))


def _filterpy(given: Regression, alpha: float, Q: FloatArray) -> FloatArray:
    from filterpy.kalman import KalmanFilter

    n = given.theta.size
    peer = KalmanFilter(dim_x=n, dim_z=1)
    peer.x, peer.P, peer.F, peer.Q = given.theta[:, None].copy(), given.P_d.copy(), np.eye(n), Q
    peer.alpha, peer.R = alpha, np.array([[alpha**-2]])  # R of RLS is l
    theta = np.empty_like(given.phi)
    for k in range(len(theta)):
        peer.update(given.eta[k], H=given.phi[k : k + 1])
        peer.predict()
        theta[k] = peer.x[:, 0]
    return theta


def statsmodels_kf(given: Regression) -> FloatArray:
    """Return theta (N, n) of the same Kalman filter in statsmodels' state space."""
    from statsmodels.tsa.statespace.kalman_filter import KalmanFilter

    n = given.theta.size
    peer = KalmanFilter(k_endog=1, k_states=n, k_posdef=n)
    peer.bind(given.eta[:, None])
    peer["design"] = np.ascontiguousarray(given.phi.T[None])
    peer["transition"], peer["selection"], peer["state_cov"] = np.eye(n), np.eye(n), given.P_d / given.memory
    peer["obs_cov"] = np.eye(1)
    peer.initialize_known(given.theta.copy(), given.P_d.copy())
    return np.asarray(peer.filter().predicted_state[:, 1:].T)


def statsmodels_window(given: Regression) -> FloatArray:
    """Return theta (N, n) of least squares over a sliding window."""
    from statsmodels.regression.rolling import RollingOLS

    found = RollingOLS(given.eta, given.phi, window=round(given.memory)).fit(method="lstsq", params_only=True)
    return np.where(np.isfinite(found.params), found.params, given.theta)


def river_bayes(given: Regression) -> FloatArray:
    """Return theta (N, n) of river's Bayesian regression with smoothing, beginning at theta and an isotropic prior."""
    from river.linear_model import BayesianLinearRegression

    # it starts at zero, so that it is given the distance from where the others start
    names, theta = [f"{i}" for i in range(given.theta.size)], np.empty_like(given.phi)
    peer = BayesianLinearRegression(alpha=given.memory, beta=1.0, smoothing=1.0 - 1.0 / given.memory)
    left = given.eta - given.phi @ given.theta
    for k, row in enumerate(given.phi):
        peer.learn_one(dict(zip(names, row.tolist(), strict=True)), float(left[k]))
        theta[k] = peer._ss_inv_arr[: given.theta.size, : given.theta.size] @ peer._eta_arr[: given.theta.size]
    return theta + given.theta


def own(name: str) -> Estimator:
    """Return an estimator of servoscope, as the recursion runs it."""
    estimator = estimators.load_estimator(name)

    def estimate(given: Regression) -> FloatArray:
        n = given.theta.size
        theta, P, K, out = given.theta.copy(), given.P_d.copy(), np.zeros(n), np.empty_like(given.phi)
        extra = np.zeros(estimators.extra_state_size(name, n, given.memory))
        for k in range(len(given.phi)):
            signals = given.eta[k : k + 1], given.phi[k : k + 1], given.phi[k : k + 1]
            run_updates(estimator, theta, P, given.P_d, 1.0, given.memory, *signals, K, extra)
            out[k] = theta
        return out

    return estimate


ESTIMATORS: dict[tuple[str, str], Estimator] = {
    **{("servoscope", name): own(name) for name in OWN},
    ("filterpy", "Kalman filter, random walk"): filterpy_kf,
    ("filterpy", "fading memory (RLS)"): filterpy_rls,
    ("statsmodels", "Kalman filter, state space"): statsmodels_kf,
    ("statsmodels", "RollingOLS"): statsmodels_window,
    ("river", "BayesianLinearRegression"): river_bayes,
}


class Curve(NamedTuple):
    """Rise time and scatter of one estimator over the memory."""

    rise: list[float]
    cv_theta: list[float]
    cv_H: list[float]


def trace_of(generator: ResidualGenerator, signals: FloatArray, estimator: Estimator, memory: float) -> ResidualTrace:
    """Return what an estimator makes of a recording; `signals`: t, eta, and phi in columns."""
    tuning, scale = generator.tuning, np.sqrt(np.diag(generator.tuning.P_d))
    t, eta, phi = signals[:, 0], signals[:, 1], signals[:, 2:]
    root = np.sqrt(tuning.R)
    given = Regression(
        eta / root, phi * scale / root, tuning.theta / scale, tuning.P_d / np.outer(scale, scale), memory
    )
    # a rise time depends on how often one looks: as often as servoscope's evaluations
    t, theta = t[::LOOK], (estimator(given) * scale)[::LOOK]
    H = theta @ generator.pipeline.bank.E(FREQUENCIES).T
    return ResidualTrace(t, theta, H, H - generator.nominal)


def signals_of(generator: ResidualGenerator, conditions: OperatingConditions, seed: int, faulty: bool) -> FloatArray:
    """Return t, eta and phi of a simulated recording, where they may be used."""
    recording = conditions.simulate(generator.pipeline.loop, seed, TRACKING_CASE if faulty else None)
    found = generator.pipeline.regression(recording.r, recording.u, recording.y, recording.restart)
    return np.column_stack([recording.t, found.eta, found.phi])[found.ok]


def curves(reference: str, seed: int, chosen: dict[tuple[str, str], Estimator]) -> dict[tuple[str, str], Curve]:
    """Return the curves of all estimators on the recordings of one seed."""
    conditions, found = OperatingConditions(reference), dict[tuple[str, str], Curve]()
    for memory in MEMORIES:
        loop = paper_loop("akf", memory)
        generator = ResidualGenerator.from_loop(loop, conditions.simulate(loop, seed + TUNING_SEED_OFFSET))
        both = [signals_of(generator, conditions, seed, False)]
        both.append(signals_of(generator, conditions, seed + 3 * TUNING_SEED_OFFSET, True))
        for key, estimator in chosen.items():
            traces = [trace_of(generator, each, estimator, memory * loop.sample_rate) for each in both]
            _add(found.setdefault(key, Curve([], [], [])), generator, *traces)
    return found


def _add(curve: Curve, generator: ResidualGenerator, healthy: ResidualTrace, faulty: ResidualTrace) -> None:
    part = healthy.between(*LAST_S)
    curve.rise.append(ifrf_rise_time(generator, faulty))
    curve.cv_theta.append(metrics.cv_theta(part.theta))
    curve.cv_H.append(metrics.cv_H(part.H[:, 0]))


def rows_of(reference: str, of_seeds: Sequence[dict[tuple[str, str], Curve]]) -> list[tuple[str, ...]]:
    """Return the rows of a reference: medians over the seeds of the ratio to servoscope's AKF."""
    rows = []
    for key in of_seeds[0]:
        cells = []
        for what in ("cv_theta", "cv_H"):
            ratios = []
            for each in of_seeds:
                one, akf = each[key], each["servoscope", "akf"]
                ratios.append(metrics.ratio_at_equal_rise(one.rise, getattr(one, what), akf.rise, getattr(akf, what)))
            cells.append("no common rise time" if np.isnan(ratios).all() else f"{np.nanmedian(ratios):.2f}")
        rises = np.nanmedian([each[key].rise for each in of_seeds], axis=0)
        rows.append((reference, *key, f"{np.nanmin(rises):.1f} to {np.nanmax(rises):.1f} s", *cells))
    return rows


def main() -> None:
    """Run the command line of this process."""
    command = parser(__doc__)
    command.add_argument("--seeds", type=int, default=3, help="recordings of which the median is taken")
    given = command.parse_args()
    names = ("control", "filterpy", "statsmodels", "river")
    there = [name for name in names if importlib.util.find_spec(name)]
    absent = [name for name in names if name not in there]
    chosen = {key: estimator for key, estimator in ESTIMATORS.items() if key[0] in ("servoscope", *there)}
    rows = []
    for reference in REFERENCES:
        rows += rows_of(reference, [curves(reference, seed, chosen) for seed in range(given.seeds)])
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in there)
    versions += f"; not installed: {', '.join(absent)}" if absent else ""
    note = (
        f"Scatter relative to servoscope's AKF at equal rise time; below 1 is quieter. Medians of {given.seeds} seeds, "
        f"memories of {MEMORIES[0]:g} to {MEMORIES[-1]:g} s. {versions}."
    )
    heads = ("reference", "library", "estimator", "rise times", "CV of theta", "CV of H at 1 Hz")
    show([Table("Noise immunity", note, heads, tuple(rows))], given.json)
