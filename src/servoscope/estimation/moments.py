"""Mean and covariance of theta_hat, carried through the recursion sample by sample."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from servoscope.core.jit import dot, fma, maximum, sqrt, sum_products, tril_index, where
from servoscope.core.jit.array_function import ArrayFunction
from servoscope.core.jit.arrays import Variable

MIN_POWER = 2.2250738585072014e-308  # smallest variance by which units are evened out


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
        remainder = c[model + 1 + lags + k] - dot(phi, column)
        for i in range(n):
            s[here + i] = fma(K[i], remainder, column[i])


def propagate_initial_share(s: Any, at: int, phi: Sequence[Any], K: Sequence[Any]) -> None:
    """Carry Psi (n, n), the share of the initial value that is left in theta_hat, through one update."""
    n = len(phi)
    for j in range(n):
        left = dot(phi, [s[at + n * i + j] for i in range(n)])
        for i in range(n):
            s[at + n * i + j] = fma(-K[i], left, s[at + n * i + j])


@ArrayFunction
def add_products(printer: Any, rows: Any, columns: Any, weights: Any, x: Any, out: Any) -> None:
    """Add the elements of a matrix, one after the other, each times a row of x (m, K), to the rows of out (p, K)."""
    for e in printer.loop(0, weights.shape[0]):
        i, j, weight = rows[e], columns[e], weights[e]
        for k in printer.loop(0, x.shape[1]):
            out[i, k] = out[i, k] + weight * x[j, k]


@ArrayFunction
def whiten_each(printer: Any, covariance: Any, deviation: Any, L: Any, out: Any) -> Any:
    """Write L^-1 d of each of K deviations (K, n, m), where L L' is its covariance (K, n, n); return whether L exists.

    Units are evened out by the standard deviations; L (n, n) is scratch memory.
    """
    (K, n, m), failures = deviation.shape, Variable(printer, 0)
    for k in printer.loop(0, K):

        def size(i: Any, k: Any = k) -> Any:
            return sqrt(maximum(covariance[k, i, i], MIN_POWER))

        for i in printer.loop(0, n):
            for j in printer.loop(0, i + 1):
                start = covariance[k, i, j] / (size(i) * size(j)) + where(i.is_equal(j), 1e-12, 0.0)
                left = Variable(printer, start)
                for l in printer.loop(0, j):
                    left.value = left.value - L[i, l] * L[j, l]
                with printer.when(i.is_equal(j)):
                    failures.value = where(left.value > 0.0, failures.value, 1)
                    L[i, i] = sqrt(left.value)
                with printer.when(j < i):
                    L[i, j] = left.value / L[j, j]
            for c in printer.loop(0, m):
                remainder = Variable(printer, deviation[k, i, c] / size(i))
                for l in printer.loop(0, i):
                    remainder.value = remainder.value - L[i, l] * out[k, l, c]
                out[k, i, c] = remainder.value / L[i, i]
    return 1 - failures.value


@ArrayFunction
def mean_path(
    printer: Any, eta: Any, phi: Any, z: Any, ok: Any, which: Any, c: Any, S: Any, P_d: Any, R: Any, theta: Any,
    number: Any, every: Any, path: Any, *, n: int,
) -> None:  # fmt: skip
    """Follow the mean of theta_hat at P = P_d for noise-free regressors plus the noise's moments, to path (K, n).

    ``theta += (P_d z (eta - phi' theta) + P_d (c - S theta)) / (R + phi' P_d z + tr(P_d S))``; c (p, n) and S
    (p, n, n) are the noise's E[phi eta] and E[phi phi'] with the plant ``which[k]`` (N,). `theta` (n,) changes in
    place, `number` samples were before these.
    """
    done, weights = Variable(printer, 0), [[P_d[i, j] for j in range(n)] for i in range(n)]
    for k in printer.loop(0, phi.shape[0]):
        with printer.when(ok[k] > 0):
            p, e, denominator, pull, gain = which[k], eta[k], R, [], []
            old = [theta[i] for i in range(n)]
            for i in range(n):
                e = e - phi[k, i] * old[i]
                pull.append(c[p, i])
                gain.append(0.0)
                for j in range(n):
                    gain[i] = weights[i][j] * z[k, j] + gain[i]
                    pull[i] = pull[i] - S[p, i, j] * old[j]
                    denominator = denominator + weights[i][j] * S[p, j, i]
                denominator = denominator + phi[k, i] * gain[i]
            for i in range(n):
                theta[i] = old[i] + sum_products(weights[i], pull, gain[i] * e) / denominator
        with printer.when(((number + k + 1) % every).is_equal(0)):
            for i in range(n):
                path[done.value, i] = theta[i]
            done.value = done.value + 1
