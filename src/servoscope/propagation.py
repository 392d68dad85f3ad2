"""Mean and covariance of theta_hat, carried through the recursion sample by sample; compiled."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from servoscope.compiled import kernel
from servoscope.plants import FloatArray

IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


@kernel
def spread(
    weights: FloatArray,
    heads: FloatArray,
    lags: int,
    K: FloatArray,
    phi: FloatArray,
    S: FloatArray,
    M: FloatArray,
    Psi: FloatArray,
) -> None:
    """Carry the covariance of theta_hat through one update of gain K, for coloured noise v.

    With theta_err(k+1) = (I - K phi') theta_err(k) + K v(k) and v(k) = sum a_j v(k-j) + e(k) + sum b_j e(k-j), the
    joint covariance of theta_err, the last p values of v and the last q of e obeys a recursion of its own:
    S = Cov(theta_err), M = E[theta_err [v_past e_past]']. It is exact for given phi, whatever the excitation and the
    gating. `weights` are [a b], `heads` are E[v(k) v(k-j)] and E[v(k) e(k-j)], `lags` is p. Psi is the share of the
    starting value that is left.
    """
    n, past = M.shape
    m = np.empty(n)  # E[theta_err(k) v(k)]
    q = np.empty(n)  # S phi
    h = np.empty(n)  # phi' Psi
    phi_m = 0.0
    phi_q = 0.0
    for i in range(n):
        m[i] = 0.0
        for j in range(past):
            m[i] += M[i, j] * weights[j]
        q[i] = 0.0
        h[i] = 0.0
        for j in range(n):
            q[i] += S[i, j] * phi[j]
            h[i] += phi[j] * Psi[j, i]
    for i in range(n):
        phi_m += phi[i] * m[i]
        phi_q += phi[i] * q[i]
    for i in range(n):
        for j in range(i + 1):
            am_i = m[i] - K[i] * phi_m
            am_j = m[j] - K[j] * phi_m
            S[i, j] += (phi_q + heads[0]) * K[i] * K[j] - K[i] * q[j] - q[i] * K[j] + am_i * K[j] + K[i] * am_j
            S[j, i] = S[i, j]
        for j in range(n):
            Psi[i, j] -= K[i] * h[j]
    for j in range(past - 1, 0, -1):
        if j == lags:  # e(k) is new: nothing before knew it
            for i in range(n):
                M[i, j] = K[i] * heads[j]
        else:
            phi_M = 0.0
            for i in range(n):
                phi_M += phi[i] * M[i, j - 1]
            for i in range(n):
                M[i, j] = M[i, j - 1] - K[i] * phi_M + K[i] * heads[j]
    for i in range(n):
        M[i, 0] = m[i] - K[i] * phi_m + K[i] * heads[0]


@kernel
def mean_path(
    eta: FloatArray,
    phi: FloatArray,
    z: FloatArray,
    ok: BoolArray,
    which: IntArray,
    c: FloatArray,
    S: FloatArray,
    P_d: FloatArray,
    R: float,
    start: FloatArray,
    every: int,
) -> FloatArray:
    """Follow the mean of theta_hat at P = P_d for noise-free regressors plus the noise's moments, shape (K, n).

    ``theta += (P_d z (eta - phi' theta) + P_d (c - S theta)) / (R + phi' P_d z + tr(P_d S))``; c (p, n) and S
    (p, n, n) are the noise's E[phi eta] and E[phi phi'] with the plant ``which[k]`` (N,).
    """
    N, n = phi.shape
    theta = start.copy()
    path = np.empty((N // every, n))
    gain = np.empty(n)
    pull = np.empty(n)
    for k in range(N):
        if ok[k]:
            p = which[k]
            e = eta[k]
            denominator = R
            for i in range(n):
                e -= phi[k, i] * theta[i]
                gain[i] = 0.0
                pull[i] = c[p, i]
                for j in range(n):
                    gain[i] += P_d[i, j] * z[k, j]
                    pull[i] -= S[p, i, j] * theta[j]
                    denominator += P_d[i, j] * S[p, j, i]
                denominator += phi[k, i] * gain[i]
            for i in range(n):
                step = gain[i] * e
                for j in range(n):
                    step += P_d[i, j] * pull[j]
                theta[i] += step / denominator
        if (k + 1) % every == 0:
            path[(k + 1) // every - 1] = theta
    return path
