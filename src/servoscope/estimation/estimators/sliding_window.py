"""Least squares over the last `memory` samples, exactly: no sample is ever subtracted, so no rounding piles up."""

from __future__ import annotations

import math
import sys
from typing import Any

from servoscope.core.jit import Bool, Int, maximum, minimum, sqrt, sum_products, where
from servoscope.estimation.update import Matrix, Numbers, Update, symmetric, write_matrix

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


MIN_COLUMN_SHARE = 8.0 * math.sqrt(sys.float_info.epsilon)  # of a column: what a sample has to say of a coefficient


def extra_state_size(n: int, memory: float) -> int:
    """Return the size of the private state: a place, the running factor, and one factor for each of N samples."""
    return 1 + (max(1, int(memory + 0.5)) + 1) * (n * (n + 3) // 2)


def rotate_row(F: Matrix, row: Numbers, first: int = 0) -> Matrix:
    """Return a triangular factor after one more row [phi' eta] (Givens).

    F holds the n rows of the upper triangular factor of [phi' eta], each from its diagonal on; `first` is the first
    column in which `row` may differ from zero.
    """
    new, row = F[:first], list(row)
    for i in range(first, len(F)):
        length = sqrt(F[i][0] * F[i][0] + row[i] * row[i])
        turns = length > 0.0
        divisor = where(turns, length, 1.0)
        c, s = where(turns, F[i][0] / divisor, 1.0), where(turns, row[i] / divisor, 0.0)
        tail = row[i:]
        new.append([c * old + s * x for old, x in zip(F[i], tail, strict=True)])
        row[i:] = [c * x - s * old for old, x in zip(F[i], tail, strict=True)]
    return new


def prior_factor(theta: Numbers, P: Matrix, R: Any) -> Matrix:
    """Return the factor of the information R P^-1 about theta."""
    n = len(theta)
    zero = 0.0 * R
    L: Matrix = []  # P = L L'
    inverse: Matrix = []
    F = [[zero] * (n + 1 - i) for i in range(n)]
    for i in range(n):
        L.append([])
        for j in range(i + 1):
            remainder = sum_products([-x for x in L[i]], L[j][:j], P[i][j])
            L[i].append(sqrt(remainder) if i == j else remainder / L[j][j])
        above = [[inverse[k][j] for k in range(i)] for j in range(n)]
        inverse.append(
            [sum_products([-x for x in L[i][:i]], above[j], zero + float(i == j)) / L[i][i] for j in range(n)]
        )
        row = [sqrt(R) * x for x in inverse[i]]
        F = rotate_row(F, [*row, sum_products(row, theta)])
    return F


def solve_factor(F: Matrix) -> tuple[Numbers, Matrix, Bool]:
    """Solve the triangular system of a factor: its solution (n,), the inverse of its triangle (n, n), and its validity.

    It is not valid where the factor says too little of one coefficient beside the others; it is so at any units.
    """
    n = len(F)
    sizes = [sum_products([F[i][j - i] for i in range(j + 1)], [F[i][j - i] for i in range(j + 1)]) for j in range(n)]
    valid = abs(F[0][0]) > 0.0
    for j in range(n):
        valid = valid & (abs(F[j][0]) > MIN_COLUMN_SHARE * sqrt(sizes[j]))
    pivots = [where(abs(row[0]) > 0.0, row[0], 1.0) for row in F]
    w, S = [0.0 * F[0][0]] * n, [[0.0 * F[0][0]] * n for _ in range(n)]
    for i in range(n - 1, -1, -1):
        right = [-x for x in F[i][1:-1]]
        w[i] = sum_products(right, w[i + 1 :], F[i][-1]) / pivots[i]
        for k in range(i, n):
            S[i][k] = sum_products(right[: k - i], [S[j][k] for j in range(i + 1, k + 1)], float(i == k)) / pivots[i]
    return w, S, valid


def update(
    theta: Numbers, P: Matrix, P_d: Matrix, R: Any, memory: Any, eta: Any, phi: Numbers, z: Numbers, extra: Any
) -> Update:
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
    p, n = extra.printer, len(theta)
    size = n * (n + 3) // 2
    start, N = Int(p, "0"), maximum(p.truncate(memory + 0.5), 1)

    def read_factor(at: Any) -> Matrix:
        numbers = [extra[at + k] for k in range(size)]
        return [[numbers.pop(0) for _ in range(n + 1 - i)] for i in range(n)]

    with p.when(extra[start] <= 0.0):  # slot j holds the share 1 - j/N of what is known before
        prior = prior_factor(theta, P, R)
        for j in p.loop(0, N):
            share = sqrt(p.number(N - j) / p.number(N))
            write_matrix(extra, [[x * share for x in row] for row in prior], j * size + (1 + size))
        extra[start] = 1.0
    k = p.truncate(extra[start]) - 1  # samples in the running block
    for i, number in enumerate((*phi, eta)):
        extra[k * size + (1 + size + i)] = number
    running = rotate_row(read_factor(start + 1), [*phi, eta])
    write_matrix(extra, running, start + 1)
    goes_on = k + 1 < N
    joined = running
    for i, row in enumerate(read_factor(minimum(k + 1, N - 1) * size + (1 + size))):
        joined = rotate_row(joined, [*([0.0 * R] * i), *(where(goes_on, x, 0.0) for x in row)], i)
    extra[start] = p.number(k + 2)
    with p.when(k + 1 >= N):
        write_matrix(extra, [[0.0 * x for x in row] for row in running], start + 1)
        for i in p.loop(0, N):
            at = (N - 1 - i) * size + (1 + size)
            factor = rotate_row(read_factor(start + 1), [extra[at + j] for j in range(n + 1)])
            write_matrix(extra, factor, start + 1)
            write_matrix(extra, factor, at)
        write_matrix(extra, [[0.0 * x for x in row] for row in running], start + 1)
        extra[start] = 1.0
    w, S, valid = solve_factor(joined)
    G = symmetric(lambda i, j: sum_products(S[i][i:], S[j][i:]), n)
    gain = [sum_products(row, phi) for row in G]
    factor = 2.0 / (1.0 + 2.0 * sum_products(phi, gain))
    new = Update(w, [[R * x for x in row] for row in G], [x * factor for x in gain])
    return new.where(valid, theta, P, where(valid, 0.0, 1.0))
