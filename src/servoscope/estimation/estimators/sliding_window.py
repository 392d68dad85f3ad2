"""Least squares over the last `memory` samples, exactly: no sample is ever subtracted, so no rounding piles up."""

from __future__ import annotations

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.jit import kernel

NAME = "sliding-window"
NEEDS_INSTRUMENT = False
EXCEPTIONS = {
    "no windup": "at phi = 0 the window runs empty; then theta and P are held",
    "contracts": "P is R times the inverse of the window's own sum of phi phi'",
    "memory": "a window forgets all at once: after N updates nothing is left of what was before",
    "memory in weak directions": "as for memory: after N updates nothing is left in any direction",
    "covariance": "theta_hat also changes through the samples that leave, which one gain K cannot say; see `update`",
    "mean": "a change enters in a straight line and is complete after N; the expectation takes it exponentially",
}


def extra_state_size(n: int, memory: float) -> int:
    """Return the size of the private state: a place, the running factor, and one factor for each of N samples."""
    return 1 + (max(1, round(memory)) + 1) * (n * (n + 3) // 2)


@kernel
def givens_update(F: FloatArray, row: FloatArray, first: int) -> None:
    """Rotate one row [phi' eta] into a triangular factor (Givens); `row` is used up.

    F holds the n rows of the upper triangular factor of [phi' eta], each from its diagonal on, end to end; `first` is
    the first column in which `row` may differ from zero.
    """
    n = len(row) - 1
    at = 0
    for i in range(first):
        at += n + 1 - i
    for i in range(first, n):
        if row[i] != 0.0:
            length = np.sqrt(1.0 * F[at] * F[at] + 1.0 * row[i] * row[i])  # in double precision
            if length > 0.0:
                c = F[at] / length
                s = row[i] / length
                for j in range(i, n + 1):
                    old = F[at + j - i]
                    F[at + j - i] = c * old + s * row[j]
                    row[j] = c * row[j] - s * old
        at += n + 1 - i


@kernel
def fill_prior(theta: FloatArray, P: FloatArray, R: float, slots: FloatArray) -> None:
    """Fill the window with the prior: slot j holds the share 1 - j/N of the information R P^-1 about theta."""
    n = len(theta)
    N = len(slots)
    L = np.zeros_like(P)  # P = L L'
    inverse = np.zeros_like(P)
    for i in range(n):
        for j in range(i + 1):
            rest = P[i, j]
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            L[i, j] = np.sqrt(rest) if i == j else rest / L[j, j]
    row = np.empty(n + 1, dtype=theta.dtype)
    slots[0, :] = 0.0
    for i in range(n):
        row[n] = 0.0
        for j in range(n):
            rest = 1.0 if i == j else 0.0
            for k in range(i):
                rest -= L[i, k] * inverse[k, j]
            inverse[i, j] = rest / L[i, i]
            row[j] = np.sqrt(R) * inverse[i, j]
            row[n] += row[j] * theta[j]
        givens_update(slots[0], row, 0)
    for j in range(N - 1, -1, -1):
        slots[j] = slots[0] * np.sqrt((N - j) / N)


@kernel
def solve_factor(F: FloatArray, w: FloatArray, S: FloatArray) -> bool:
    """Solve the triangular system of a factor: w (n,), and S = the inverse of its triangle (n, n).

    Returns False where the factor says too little of one coefficient beside the others; it does so at any units.
    """
    n = len(w)
    T = np.zeros_like(S)
    at = 0
    for i in range(n):
        for j in range(i, n):
            T[i, j] = F[at + j - i]
        w[i] = F[at + n - i]
        at += n + 1 - i
    weakest = 8.0 * np.sqrt(np.finfo(F.dtype).eps)
    for j in range(n):
        size = 0.0
        for i in range(j + 1):
            size += 1.0 * T[i, j] * T[i, j]
        if not abs(T[j, j]) > weakest * np.sqrt(size):
            return False
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            w[i] -= T[i, j] * w[j]
        w[i] /= T[i, i]
        for k in range(n):
            rest = 1.0 if i == k else 0.0
            for j in range(i + 1, k + 1):
                rest -= T[i, j] * S[j, k]
            S[i, k] = rest / T[i, i] if k >= i else 0.0
    return True


@kernel
def update(
    theta: FloatArray, P: FloatArray, P_d: FloatArray, R: float, memory: float, eta: float,
    phi: FloatArray, z: FloatArray, K: FloatArray, extra: FloatArray,
) -> int:  # fmt: skip
    """Make theta the least-squares fit to the last N = memory samples and P = R (sum phi phi')^-1.

    At the start the window is full of the baseline, R P^-1 about theta; each of the first N samples pushes out 1/N of
    it. The window is the running block of samples and what is left of the block before it. Of the former the
    triangular factor of [phi' eta] is updated; of the latter there is one factor for each number of samples left, all
    made backwards when it was complete (in the place of the samples themselves). The two factors are joined by
    rotations at every sample: no sample is subtracted, no condition number is squared, and nothing is older than 2 N.
    A window that does not determine theta is a skipped step.

    **The statistic is a stand-in.** K is the gain of the exponential window of half the memory, 2 G phi/(1 + 2 phi' G
    phi) with G = P/R: under steady excitation it has the variance and the mean age of the rectangular window, so S and
    T^2 are about right there. While excitation comes and goes they are not: samples that leave at rest raise the
    variance of theta_hat, and no gain tells.
    """
    n = len(theta)
    size = n * (n + 3) // 2
    running = extra[1 : 1 + size]
    slots = extra[1 + size :].reshape((-1, size))
    N = len(slots)
    if extra[0] == 0.0:
        fill_prior(theta, P, R, slots)
        extra[0] = 1.0
    k = int(extra[0]) - 1  # samples in the running block
    row = np.empty(n + 1, dtype=theta.dtype)
    row[:n] = phi
    row[n] = eta
    slots[k, : n + 1] = row
    givens_update(running, row, 0)
    joined = running.copy()
    if k + 1 < N:
        at = 0
        for i in range(n):
            for j in range(i, n + 1):
                row[j] = slots[k + 1, at + j - i]
            givens_update(joined, row, i)
            at += n + 1 - i
        extra[0] += 1.0
    else:
        running[:] = 0.0
        for i in range(N - 1, -1, -1):
            row[:] = slots[i, : n + 1]
            givens_update(running, row, 0)
            slots[i] = running
        running[:] = 0.0
        extra[0] = 1.0
    w = np.empty_like(theta)
    S = np.empty_like(P)
    if not solve_factor(joined, w, S):
        for i in range(n):
            K[i] = 0.0
        return 1
    leverage = 0.0
    for i in range(n):
        theta[i] = w[i]
        K[i] = 0.0
        for j in range(n):
            G = 0.0
            for m in range(max(i, j), n):
                G += S[i, m] * S[j, m]
            P[i, j] = R * G
            K[i] += G * phi[j]
        leverage += phi[i] * K[i]
    for i in range(n):
        K[i] *= 2.0 / (1.0 + 2.0 * leverage)
    return 0
