"""Covariance windup: P of AKF, DFRLS, KF and RLS at rest, without any excitation, and along eq. (12)."""

from __future__ import annotations

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.estimation import estimators
from servoscope.estimation.update import run_updates
from servoscope.research.paper.conditions import PAPER, rig_loop
from servoscope.research.paper.method import INITIAL_COVARIANCE_FACTOR, ResidualGenerator
from servoscope.simulation import simulate

ESTIMATORS = ("akf", "dfrls", "kf", "rls")
MOTION_S, REST_S = 30.0, 600.0  # s
ZERO_REGRESSOR_UPDATES = 20_000  # updates at phi = 0


def covariance_at_rest(estimator: str, seed: int) -> tuple[FloatArray, FloatArray]:
    """Return times [s] and the largest eigenvalue of P relative to P_d: 30 s of motion, then ten minutes of rest.

    At rest the reference stands still; phi still carries the position and the noise.
    """
    from servoscope.estimation.recursion import Recursion

    loop = rig_loop(structure="tustin", estimator=estimator, memory=10.0, evaluation_rate=1.0)
    r = PAPER.reference_signal()
    moving = r[: round(MOTION_S * loop.sample_rate)]
    whole = np.concatenate([moving, np.full(round(REST_S * loop.sample_rate), moving[-1])])
    generator = ResidualGenerator.from_loop(loop, PAPER.simulate(loop, seed + 1000))
    recording = simulate(loop, whole, seed=seed)[0]
    c = generator.pipeline.constants(generator.tuning, steady=False)
    recursion = Recursion([c])
    state = recursion.start()
    every, n = generator.pipeline.every, len(c.theta)
    L = np.asarray(np.linalg.cholesky(c.P_d))
    sizes = []
    for begin in range(0, recording.samples, every):
        signals = (getattr(recording, name)[None, begin : begin + every] for name in ("r", "u", "y", "restart"))
        state, _ = recursion.run(state, *signals)
        sizes.append(_largest_eigenvalue(L, recursion.named(state)["P"][0].reshape(n, n)))
    return recording.t[every - 1 :: every], np.array(sizes)


def covariance_without_excitation(
    estimator: str, updates: int = ZERO_REGRESSOR_UPDATES, memory: float = 1000.0
) -> float:
    """Return how much P has grown after so many updates at phi = 0."""
    n = 4
    theta, P, P_d, phi, K = np.zeros(n), np.eye(n), np.eye(n), np.zeros((updates, n)), np.zeros(n)
    extra = np.zeros(estimators.extra_state_size(estimator, n, memory))
    module, eta = estimators.load_estimator(estimator), np.zeros(updates)
    run_updates(module, theta, P, P_d, 1.0, memory, eta, phi, phi, K, extra)
    return float(np.abs(P).max())


def contraction(seed: int) -> dict[str, float]:
    """Return what is left of P - P_d, started at 99 P_d, by eigenvalue: eq. (12) measured on the paper's profile.

    The largest and the smallest eigenvalue of P_d^-1/2 (P - P_d) P_d^-1/2, relative to the start, after 10 s (one
    memory) and 60 s of the profile, and after 10 s of phi = 0.
    """
    from servoscope.estimation.estimators import akf

    loop = rig_loop(structure="tustin", memory=10.0)
    generator = ResidualGenerator.from_loop(loop, PAPER.simulate(loop, seed + 1000))
    recording = PAPER.simulate(loop, seed)
    tuning = generator.tuning
    g = generator.pipeline.regression(recording.r, recording.u, recording.y, recording.restart)
    phi = np.ascontiguousarray(g.phi[g.ok] / tuning.scale)
    eta = np.ascontiguousarray(g.eta[g.ok])
    P_d = np.ascontiguousarray(tuning.P_d * np.outer(tuning.scale, tuning.scale))
    L = np.asarray(np.linalg.cholesky(P_d))
    values: dict[str, float] = {}
    for name, rows in (("motion", phi), ("dark", 0.0 * phi)):
        theta, P, K, extra = np.zeros(4), INITIAL_COVARIANCE_FACTOR * P_d, np.zeros(4), np.zeros(0)
        for after, part in (("10", slice(1000)), ("60", slice(1000, None))):
            signals = eta[part], rows[part], rows[part]
            run_updates(akf, theta, P, P_d, tuning.R, generator.pipeline.memory, *signals, K, extra)
            error = np.asarray(_whiten(L, P) - np.eye(4), dtype=np.float64)
            left = np.linalg.eigvalsh(error) / (INITIAL_COVARIANCE_FACTOR - 1.0)
            values[f"eq12.{name}.{after}.largest"] = float(left[-1])
            values[f"eq12.{name}.{after}.smallest"] = float(left[0])
    return values


def windup_metrics(seed: int) -> dict[str, float]:
    """Return the growth of P per estimator, at rest and in the dark, and what eq. (12) leaves."""
    values = contraction(seed)
    for estimator in ESTIMATORS:
        t, sizes = covariance_at_rest(estimator, seed)
        values[f"windup.rest.{estimator}"] = float(sizes[-1] / sizes[t <= MOTION_S][-1])
        values[f"windup.dark.{estimator}"] = covariance_without_excitation(estimator)
    return values


def _whiten(L: FloatArray, P: FloatArray) -> FloatArray:
    half = np.linalg.solve(L, P)
    return np.asarray(np.linalg.solve(L, half.T))


def _largest_eigenvalue(L: FloatArray, P: FloatArray) -> float:
    white = _whiten(L, P)
    return float(np.linalg.eigvalsh((white + white.T) / 2.0)[-1]) if np.isfinite(white).all() else float("inf")
