"""The compiled sampling of plants: their transition under a held input, and the Kalman gains after a restart."""

from __future__ import annotations

# ruff: noqa: B023 - the functions in loops are called at once, while they are traced
from collections.abc import Callable
from typing import Any

from servoscope.core.jit import Int, maximum, where
from servoscope.core.jit.array_function import ArrayFunction
from servoscope.core.jit.arrays import Array, Variable, add_terms
from servoscope.core.jit.symbolic import Complex

GAIN_TOLERANCE = 1e-6  # relative change of the gain from which it stays as it is
MAX_SERIES_NORM = 0.25  # norm of a matrix up to which so many terms of the exponential are exact to the last digit
TERMS = 13
MAX_HALVINGS = 64


@ArrayFunction
def sample_plants(
    printer: Any, F: Any, g: Any, period: Any, late: Any, c: Any, u_variance: Any, y_variance: Any, P: Any,
    A: Any, b: Any, b_late: Any, K: Any, S: Any, *, n: int,
) -> None:  # fmt: skip
    """Fill the sampled plants and their gains, for an input that is held between samples.

    `F` (p, n, n), `g` and `c` (p, n): ``x' = F x + g u,  y = c x``, states in units of like size; `period`: of the
    samples [s]; `late`: share of it by which u arrives late; `u_variance`, `y_variance`: of the noise on both; `P`
    (n, n): covariance of the first state. A (p, n, n), b and b_late (p, n), K (p, L, n) and S (p, L) are overwritten.
    """
    M, E, power = (Array.scratch(printer, F.kind, n + 1, n + 1) for _ in range(3))
    first, Q, covariance, AP = (Array.scratch(printer, F.kind, n, n) for _ in range(4))

    def fill(out: Any, element: Callable[[Any, Any], Any]) -> None:
        for i, k in pairs(printer, n):
            out[i, k] = element(i, k)

    for p in printer.loop(0, F.shape[0]):
        unit = Variable(printer, 1e-300)  # of the input: a large one would be halved more often than the plant asks for
        for i in range(n):
            unit.value = maximum(unit.value, abs(real(g[p, i])) * period)

        for part in printer.loop(0, where(late > 0.0, Int(printer, "2"), 1)):
            ends = part.is_equal(0)  # the end of a sample, then its beginning, when u is still the last
            duration = where(ends, 1.0 - late, late) * period
            for i in printer.loop(0, n):
                for k in printer.loop(0, n):
                    M[i, k] = F[p, i, k] * duration
                M[i, n], M[n, i] = g[p, i] * duration / unit.value, 0.0
            M[n, n] = 0.0
            exponentiate(printer, M, E, power, n + 1)
            with printer.when(ends):
                for i in printer.loop(0, n):
                    b[p, i], b_late[p, i] = E[i, n] * unit.value, 0.0
                fill(A[p], lambda i, k: E[i, k])
            with printer.when(~ends):
                for i in printer.loop(0, n):
                    b_late[p, i] = add_terms(printer, b_late[p, i], n, lambda k: A[p, i, k] * E[k, n] * unit.value)
                fill(first, lambda i, k: add_terms(printer, zero(F), n, lambda o: A[p, i, o] * E[o, k]))
                fill(A[p], lambda i, k: first[i, k])
        fill(Q, lambda i, k: (b[p, i] * b[p, k] + b_late[p, i] * b_late[p, k]) * u_variance)
        fill(covariance, lambda i, k: P[i, k])
        write_gains(printer, A[p], Q, c[p], y_variance, covariance, AP, K[p], S[p], n)


def pairs(printer: Any, n: int) -> Any:
    """Write two loops, one in the other."""
    for i in printer.loop(0, n):
        for k in printer.loop(0, n):
            yield i, k


def real(number: Any) -> Any:
    """Return the real part."""
    return number.real if isinstance(number, Complex) else number


def zero(of: Any) -> Any:
    """Return a number 0 of an array's kind, from which a sum starts."""
    return Complex(0.0, 0.0) if of.kind == "complex" else 0.0


def exponentiate(printer: Any, M: Any, E: Any, power: Any, n: int) -> None:
    """Put exp(M) into E, both (n, n): a Taylor series of M halved until it is small, then squared as often.

    Scaling and squaring: Moler and Van Loan, 2003, method 3. M and `power` (n, n) are overwritten.
    """
    norm, halvings, part = (Variable(printer, start) for start in (0.0, 0, 1.0))
    for i in printer.loop(0, n):
        norm.value = maximum(norm.value, add_terms(printer, 0.0, n, lambda k: magnitude(M[i, k])))
    for _ in printer.loop_while(lambda: (norm.value > MAX_SERIES_NORM) & (halvings.value < MAX_HALVINGS)):
        norm.value, part.value, halvings.value = norm.value * 0.5, part.value * 0.5, halvings.value + 1
    for i, k in pairs(printer, n):
        M[i, k] = M[i, k] * part.value
        E[i, k] = where(i.is_equal(k), 1.0, 0.0)
    for term in printer.loop(0, TERMS):  # Horner's scheme: 1 + M/1 (1 + M/2 (1 + ...)), then the squares
        multiply(printer, M, E, power, n)
        for i, k in pairs(printer, n):
            E[i, k] = power[i, k] / (TERMS - printer.number(term)) + where(i.is_equal(k), 1.0, 0.0)
    for _ in printer.loop(0, halvings.value):
        multiply(printer, E, E, power, n)
        for i, k in pairs(printer, n):
            E[i, k] = power[i, k]


def magnitude(number: Any) -> Any:
    """Return the absolute value, or the sum of the parts', which is no smaller."""
    return abs(number.real) + abs(number.imag) if isinstance(number, Complex) else abs(number)


def multiply(printer: Any, left: Any, right: Any, out: Any, n: int) -> None:
    """Write the product of two matrices (n, n)."""
    for i, k in pairs(printer, n):
        out[i, k] = add_terms(printer, zero(out), n, lambda o: left[i, o] * right[o, k])


def write_gains(printer: Any, A: Any, Q: Any, c: Any, r: Any, P: Any, AP: Any, K: Any, S: Any, n: int) -> None:
    """Fill Kalman gains K (L, n) and innovation variances S (L,) for the samples after a restart.

    ``S = c P c' + r,  K = A P c'/S,  P <- A P A' + Q - K S K'`` from the covariance P (n, n) of the first state, which
    is overwritten (Anderson and Moore, 1979, chapter 4). The last gain stands for all later samples.
    """
    Pc, settled = Array.scratch(printer, A.kind, n), Variable(printer, 0)
    for j in printer.loop(0, S.shape[0]):
        before = maximum(j - 1, 0)
        with printer.when(settled.value > 0):
            S[j] = S[before]
            for i in range(n):
                K[j, i] = K[before, i]
        with printer.when(settled.value <= 0):
            for i in printer.loop(0, n):
                Pc[i] = add_terms(printer, zero(A), n, lambda k: P[i, k] * c[k])
            s = add_terms(printer, zero(A) + r, n, lambda i: c[i] * Pc[i])
            S[j], by, same = s, 1.0 / s, Variable(printer, 1)
            for i in printer.loop(0, n):
                K[j, i] = add_terms(printer, zero(A), n, lambda k: A[i, k] * Pc[k]) * by
                gain = real(K[j, i])
                change = abs(gain - real(K[before, i]))
                same.value = where(change <= abs(gain) * GAIN_TOLERANCE, same.value, 0)
            settled.value = where(j > n, same.value, 0)
            for i, k in pairs(printer, n):
                AP[i, k] = add_terms(printer, zero(A), n, lambda q: A[i, q] * P[q, k])
            for i, k in pairs(printer, n):
                start = Q[i, k] - K[j, i] * s * K[j, k]
                P[i, k] = add_terms(printer, start, n, lambda q: AP[i, q] * A[k, q])
