"""Mean and covariance of theta_hat, carried through the recursion sample by sample."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.core.jit import dot, fma, kernel, tril_index


def propagate_covariance(c: Any, model: int, s: Any, at: int, lags: int, phi: Sequence[Any], K: Sequence[Any]) -> None:
    """Carry the covariance of theta_hat through one update of gain K (n), regressor phi (n), for coloured noise v.

    theta_err(k+1) = (I - K phi') theta_err(k) + K v(k), and v is an ARMA process with the state x of the filter that
    makes it of white noise e (transposed direct form II): v = x_0 + e, x_i(k+1) = a_i v + x_(i+1) + b_i e. The joint
    covariance of theta_err and x obeys a recursion of its own: S = Cov(theta_err), M = E[theta_err x']. It is exact for
    given phi, whatever the excitation and the gating.

    c[model:] are E[v^2], `lags` weights a_i and as many E[v(k) x_i(k+1)]; s[at:] is the lower triangle of S row by row,
    then M column by column.
    """
    n = len(phi)
    to_M = at + n * (n + 1) // 2
    S = [[s[at + tril_index(i, j)] for j in range(n)] for i in range(n)]
    m = [s[to_M + i] for i in range(n)]  # E[theta_err v]
    q = [dot(S[i], phi) for i in range(n)]
    half = (c[model] + dot(phi, q)) * 0.5 - dot(phi, m)
    b = [fma(K[i], half, m[i] - q[i]) for i in range(n)]
    for i in range(n):
        for j in range(i + 1):
            s[at + tril_index(i, j)] = fma(K[i], b[j], fma(b[i], K[j], S[i][j]))
    for k in range(lags):
        here, a = to_M + k * n, c[model + 1 + k]
        column = [fma(a, m[i], s[here + n + i]) if k < lags - 1 else a * m[i] for i in range(n)]
        rest = c[model + 1 + lags + k] - dot(phi, column)
        for i in range(n):
            s[here + i] = fma(K[i], rest, column[i])


def propagate_initial_share(s: Any, at: int, phi: Sequence[Any], K: Sequence[Any]) -> None:
    """Carry Psi (n, n), the share of the initial value that is left in theta_hat, through one update."""
    n = len(phi)
    for j in range(n):
        left = dot(phi, [s[at + n * i + j] for i in range(n)])
        for i in range(n):
            s[at + n * i + j] = fma(-K[i], left, s[at + n * i + j])


@functools.partial(kernel, heap=False)
def add_products(rows: IntArray, columns: IntArray, weights: FloatArray, x: FloatArray, out: FloatArray) -> None:
    """Add the elements of a matrix, one after the other, each times a row of x (m, K), to the rows of out (p, K)."""
    for e in range(len(weights)):
        i, j, weight = rows[e], columns[e], weights[e]
        for k in range(x.shape[1]):
            out[i, k] += weight * x[j, k]


@functools.partial(kernel, heap=False)
def whiten_each(
    covariance: FloatArray, deviation: FloatArray, size: FloatArray, L: FloatArray, out: FloatArray
) -> bool:
    """Write L^-1 d of each of K deviations (K, n, m), where L L' is its covariance (K, n, n); return whether L exists.

    Units are evened out by `size` (n,), scratch memory like `L` (n, n).
    """
    K, n, m = deviation.shape
    tiny = 2.2250738585072014e-308
    for k in range(K):
        for i in range(n):
            power = covariance[k, i, i]
            size[i] = math.sqrt(tiny if power < tiny else power)
        for i in range(n):
            for j in range(i + 1):
                left = covariance[k, i, j] / (size[i] * size[j]) + (1e-12 if i == j else 0.0)
                for l in range(j):
                    left -= L[i, l] * L[j, l]
                if i == j:
                    if not left > 0.0:
                        return False
                    L[i, i] = math.sqrt(left)
                else:
                    L[i, j] = left / L[j, j]
            for c in range(m):
                rest = deviation[k, i, c] / size[i]
                for l in range(i):
                    rest -= L[i, l] * out[k, l, c]
                out[k, i, c] = rest / L[i, i]
    return True


@functools.partial(kernel, heap=False)
def mean_path(
    eta: FloatArray, phi: FloatArray, z: FloatArray, ok: BoolArray, which: IntArray, c: FloatArray, S: FloatArray,
    P_d: FloatArray, R: float, theta: FloatArray, number: int, every: int, room: FloatArray, path: FloatArray,
) -> None:  # fmt: skip
    """Follow the mean of theta_hat at P = P_d for noise-free regressors plus the noise's moments, to path (K, n).

    ``theta += (P_d z (eta - phi' theta) + P_d (c - S theta)) / (R + phi' P_d z + tr(P_d S))``; c (p, n) and S
    (p, n, n) are the noise's E[phi eta] and E[phi phi'] with the plant ``which[k]`` (N,). `theta` (n,) changes in
    place, `number` samples were before these, and `room` (2, n) is scratch memory.
    """
    N, n = phi.shape
    done = 0
    for k in range(N):
        if ok[k]:
            p = which[k]
            e = eta[k]
            denominator = R
            for i in range(n):
                e -= phi[k, i] * theta[i]
                gain = 0.0
                pull = c[p, i]
                for j in range(n):
                    gain += P_d[i, j] * z[k, j]
                    pull -= S[p, i, j] * theta[j]
                    denominator += P_d[i, j] * S[p, j, i]
                denominator += phi[k, i] * gain
                room[0, i], room[1, i] = gain, pull
            for i in range(n):
                step = room[0, i] * e
                for j in range(n):
                    step += P_d[i, j] * room[1, j]
                theta[i] += step / denominator
        if (number + k + 1) % every == 0:
            for i in range(n):
                path[done, i] = theta[i]
            done += 1
