"""Other libraries that estimate the same coefficients from the same regressors, those of them that are installed."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable

import numpy as np

from servoscope.core.arrays import FloatArray
from tools import oracle

Peer = Callable[[], FloatArray]


def kalman_jobs(eta: FloatArray, phi: FloatArray, P_d: FloatArray, R: float, memory: float) -> dict[str, Peer]:
    """Return the Kalman filter of a random walk in n coefficients, Q = P_d/memory, P(0) = P_d, by whom it is there."""
    n, N, Q = phi.shape[1], len(eta), P_d / memory

    def filterpy() -> FloatArray:
        from filterpy.kalman import KalmanFilter

        f = KalmanFilter(dim_x=n, dim_z=1)
        f.P, f.Q, f.R = P_d.copy(), Q, np.array([[R]])
        for k in range(N):
            f.H = phi[k : k + 1]
            f.update(eta[k])
            f.predict()
        return np.asarray(f.x[:, 0])

    def pykalman() -> FloatArray:
        from pykalman import KalmanFilter

        one = np.eye(n)
        f = KalmanFilter(one, phi[:, None, :], Q, np.array([[R]]), np.zeros(n), np.zeros(1), np.zeros(n), P_d)
        return np.asarray(f.filter(eta[:, None])[0][-1])

    def statsmodels() -> FloatArray:
        from statsmodels.tsa.statespace.kalman_filter import KalmanFilter

        f = KalmanFilter(k_endog=1, k_states=n)
        f.bind(eta)
        f["design"], f["transition"], f["selection"] = np.ascontiguousarray(phi.T[None]), np.eye(n), np.eye(n)
        f["obs_cov"], f["state_cov"] = np.array([[R]]), Q
        f.initialize_known(np.zeros(n), P_d)
        return np.asarray(f.filter().predicted_state[:, -1])

    found: dict[str, Peer] = {
        "servoscope": _servoscope_job("kf", eta, phi, P_d, R, memory),
        "numpy loop": lambda: np.asarray(oracle.kalman_loop(eta, phi, P_d, Q, R)),
    }
    for peer in (filterpy, pykalman, statsmodels):
        if importlib.util.find_spec(peer.__name__):
            found[peer.__name__] = peer
    return found


def least_squares_jobs(eta: FloatArray, phi: FloatArray, memory: float) -> dict[str, Peer]:
    """Return recursive least squares with exponential forgetting, by whom it is there; P(0) = 100 I, R = 1."""
    n = phi.shape[1]

    def padasip() -> FloatArray:
        import padasip as pa

        f = pa.filters.FilterRLS(n, mu=1.0 - 1.0 / memory, eps=0.01, w="zeros")
        f.run(eta, phi)
        return np.asarray(f.w)

    found: dict[str, Peer] = {"servoscope": _servoscope_job("rls", eta, phi, 100.0 * np.eye(n), 1.0, memory)}
    if importlib.util.find_spec("padasip"):
        found["padasip"] = padasip
    return found


def _servoscope_job(name: str, eta: FloatArray, phi: FloatArray, P_d: FloatArray, R: float, memory: float) -> Peer:
    from servoscope.estimation import estimators
    from servoscope.estimation.update import run_updates

    estimator = estimators.load_estimator(name)

    def servoscope() -> FloatArray:
        theta, P = np.zeros(phi.shape[1]), P_d.copy()
        run_updates(estimator, theta, P, P_d, R, memory, eta, phi, phi, np.empty_like(theta), np.zeros(0))
        return theta

    return servoscope
