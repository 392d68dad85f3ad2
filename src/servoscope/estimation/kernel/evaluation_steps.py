"""Evaluations of a state: coefficients, T^2 and frequency response, or the recursion's own numbers for a diagnosis.

Traced arithmetic, as `estimation.kernel.sample_steps`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

from servoscope.core.jit import dot, maximum, sqrt, tril_index, where
from servoscope.estimation.kernel.sample_steps import CROSSED, SKIPPED, UPDATES
from servoscope.estimation.kernel.spec import KernelSpec

MIN_VARIANCE = 1e-30  # no variance is smaller; a number of single precision, too


class EvaluationSteps:
    """The steps that write an evaluation q; c are constants, s is the state, h its counters."""

    def __init__(self, spec: KernelSpec) -> None:
        self.size, self.to, self.at = spec.sizes, SimpleNamespace(**dict(spec.to)), SimpleNamespace(**dict(spec.at))

    def write_evaluation(self, c: Any, s: Any, h: Any, q: Any) -> None:
        """Write one complete evaluation but for the frequency response, in physical units.

        T^2 = d' Cov^-1 d by Cholesky's factor of Cov = S + that of the baseline, where d is theta minus the baseline's.
        """
        n, at = self.size.n, self.at
        d = [s[self.to.theta + i] for i in range(n)]
        Cov = self._covariance(c, s, h)
        G: list[list[Any]] = [[] for _ in range(n)]
        white: list[Any] = []
        for j in range(n):
            column = [Cov[i][j] for i in range(j, n)]
            remainder = d[j]
            if j:
                column = [x - dot(G[j + i], G[j]) for i, x in enumerate(column)]
                remainder = remainder - dot(G[j], white)
            inverse = 1.0 / sqrt(maximum(column[0], MIN_VARIANCE))
            white.append(remainder * inverse)
            for i, x in enumerate(column):
                G[j + i].append(x * inverse)
        q[0] = h[UPDATES]
        q[1] = where(h[UPDATES] > 0.0, dot(white, white), 0.0)
        q[2] = s[self.to.peak]
        q[3] = where(h[CROSSED] > 0.0, (h[CROSSED] - 1.0) / c[at.rate], math.nan)
        basis = [[c[at.basis + n * i + j] for j in range(n)] for i in range(n)]
        for i, row in enumerate(basis):
            q[4 + i] = c[at.origin + i] + dot(row, d)
        self._write_congruence(basis, Cov, q, 4 + n)

    def write_response(self, c: Any, s: Any, h: Any, f: Any, q: Any) -> None:
        """Write Re H, Im H at frequency f and their covariance (2, 2) behind the rest of the evaluation."""
        n = self.size.n
        begin, end = f * (2 * (n + 1)) + self.at.response, f * 6 + (4 + n + n * n)
        E = [[c[begin + (n * part + j)] for j in range(n)] for part in range(2)]
        for part in range(2):
            q[end + part] = c[begin + (2 * n + part)] + dot(E[part], [s[self.to.theta + j] for j in range(n)])
        self._write_congruence(E, self._covariance(c, s, h), q, end + 2)

    def write_internal(self, s: Any, h: Any, q: Any) -> None:
        """Write the numbers that a diagnosis takes, in the recursion's own coordinates."""
        n = self.size.n
        numbers = [h[UPDATES], h[SKIPPED], s[self.to.power], s[self.to.peak], h[CROSSED]]
        numbers += [s[self.to.theta + i] for i in range(n)]
        numbers += [s[self.to.S + tril_index(i, j)] for i in range(n) for j in range(n)]
        numbers += [s[self.to.Psi + i] for i in range(n * n)]
        for i, number in enumerate(numbers):
            q[i] = number

    def _covariance(self, c: Any, s: Any, h: Any) -> list[list[Any]]:
        n, covariance = self.size.n, [[None] * self.size.n for _ in range(self.size.n)]
        for i, j in _lower_triangle(n):
            known = c[self.at.prior + n * i + j]
            if self.size.fades:
                known = where(h[UPDATES] > c[self.at.settled], c[self.at.settled_prior + n * i + j], known)
            covariance[i][j] = covariance[j][i] = s[self.to.S + tril_index(i, j)] + known
        return covariance

    def _write_congruence(self, E: Sequence[Sequence[Any]], Cov: Sequence[Sequence[Any]], q: Any, at: Any) -> None:
        """Write E Cov E' to q[at:], row by row."""
        halves = [[dot(row, column) for column in Cov] for row in E]
        for i, j in _lower_triangle(len(E)):
            q[at + (len(E) * i + j)] = dot(halves[i], E[j])
            if i != j:
                q[at + (len(E) * j + i)] = q[at + (len(E) * i + j)]


def _lower_triangle(n: int) -> list[tuple[int, int]]:
    """Return the places of a lower triangle, diagonal included."""
    return [(i, j) for i in range(n) for j in range(i + 1)]
