"""The compiled sampling of plants: their transition under a held input, and the Kalman gains after a restart."""

from __future__ import annotations

import numpy as np

from servoscope.core.jit import kernel, subroutine
from servoscope.fit.kernels import Array

GAIN_TOLERANCE = 1e-6  # relative change of the gain from which it stays as it is
MAX_SERIES_NORM = 0.25  # norm of a matrix up to which so many terms of the exponential are exact to the last digit
TERMS = 13


@kernel
def sample_plants(
    F: Array, g: Array, period: float, late: float, c: Array, u_variance: float, y_variance: float, P: Array,
    A: Array, b: Array, b_late: Array, K: Array, S: Array,
) -> None:  # fmt: skip
    """Fill the sampled plants and their gains, for an input that is held between samples.

    `F` (p, n, n), `g` and `c` (p, n): ``x' = F x + g u,  y = c x``, states in units of like size; `period`: of the
    samples [s]; `late`: share of it by which u arrives late; `u_variance`, `y_variance`: of the noise on both; `P`
    (n, n): covariance of the first state. A (p, n, n), b and b_late (p, n), K (p, L, n) and S (p, L) are overwritten.
    """
    plants, n = g.shape
    M = np.zeros((n + 1, n + 1), F.dtype)
    E, power, first = np.zeros_like(M), np.zeros_like(M), np.zeros_like(F[0])
    Q, start = np.zeros_like(F[0]), np.zeros_like(F[0])
    for p in range(plants):
        unit = 1e-300  # of the input: a large one would be halved more often than the plant asks for
        for i in range(n):
            unit = max(unit, abs(g[p, i].real) * period)
        for part in range(2 if late > 0.0 else 1):  # the end of a sample, then its beginning, when u is still the last
            duration = period * (late if part else 1.0 - late)
            for i in range(n):
                for k in range(n):
                    M[i, k] = F[p, i, k] * duration
                M[i, n] = g[p, i] * duration / unit
            exponentiate(M, E, power)
            for i in range(n):
                if not part:
                    b[p, i], b_late[p, i] = E[i, n] * unit, 0.0 * E[i, n]
                    for k in range(n):
                        A[p, i, k] = E[i, k]
                else:
                    for k in range(n):
                        first[i, k] = 0.0 * A[p, i, k]
                        b_late[p, i] += A[p, i, k] * E[k, n] * unit
                        for o in range(n):
                            first[i, k] += A[p, i, o] * E[o, k]
            if part:
                A[p] = first
        for i in range(n):
            for k in range(n):
                Q[i, k] = u_variance * (b[p, i] * b[p, k] + b_late[p, i] * b_late[p, k])
                start[i, k] = P[i, k]
        gains(A[p], Q, c[p], y_variance, start, K[p], S[p])


@subroutine
def exponentiate(M: Array, E: Array, power: Array) -> None:
    """Put exp(M) into E, both (n, n): a Taylor series of M halved until it is small, then squared as often.

    Scaling and squaring: Moler and Van Loan, 2003, method 3. M and `power` (n, n) are overwritten.
    """
    n, norm, halvings = len(M), 0.0, 0
    for i in range(n):
        total = 0.0
        for k in range(n):
            total += abs(M[i, k])
        norm = max(norm, total)
    while norm > MAX_SERIES_NORM and halvings < 64:
        norm *= 0.5
        halvings += 1
    part = 0.5**halvings
    for i in range(n):
        for k in range(n):
            M[i, k] *= part
            E[i, k] = 0.0 * M[i, k] + (1.0 if i == k else 0.0)
    for term in range(TERMS, -halvings, -1):  # Horner's scheme: 1 + M/1 (1 + M/2 (1 + ...)), then the squares
        for i in range(n):
            for k in range(n):
                total = 0.0 * M[i, k]
                for o in range(n):
                    total += (M[i, o] if term > 0 else E[i, o]) * E[o, k]
                power[i, k] = total
        for i in range(n):
            for k in range(n):
                E[i, k] = power[i, k] / term + (1.0 if i == k else 0.0) if term > 0 else power[i, k]


@kernel
def gains(A: Array, Q: Array, c: Array, r: float, P: Array, K: Array, S: Array) -> None:
    """Fill Kalman gains K (L, n) and innovation variances S (L,) for the samples after a restart.

    ``S = c P c' + r,  K = A P c'/S,  P <- A P A' + Q - K S K'`` from the covariance P (n, n) of the first state, which
    is overwritten (Anderson and Moore, 1979, chapter 4). The last gain stands for all later samples.
    """
    n, L = len(c), len(S)
    zero = 0.0 * A[0, 0]
    Pc, AP = np.zeros_like(c), np.zeros_like(A)
    for j in range(L):
        s = zero + r
        for i in range(n):
            total = zero
            for k in range(n):
                total += P[i, k] * c[k]
            Pc[i] = total
            s += c[i] * total
        S[j] = s
        by, settled = 1.0 / s, True
        for i in range(n):
            total = zero
            for k in range(n):
                total += A[i, k] * Pc[k]
            K[j, i] = total * by
            if j > 0:
                ratio = abs(K[j, i].real - K[j - 1, i].real)
                settled = settled and ratio <= GAIN_TOLERANCE * abs(K[j, i].real)
        if j > n and settled:
            for later in range(j + 1, L):
                S[later] = s
                for i in range(n):
                    K[later, i] = K[j, i]
            return
        for i in range(n):
            for k in range(n):
                total = zero
                for q in range(n):
                    total += A[i, q] * P[q, k]
                AP[i, k] = total
        for i in range(n):
            for k in range(n):
                total = Q[i, k] - K[j, i] * s * K[j, k]
                for q in range(n):
                    total += AP[i, q] * A[k, q]
                P[i, k] = total
