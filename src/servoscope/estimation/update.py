"""What an estimator returns of one update: theta, P and the gain, as traced arithmetic; and many updates at once."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

from servoscope.core.arrays import FloatArray
from servoscope.core.jit import where
from servoscope.core.jit.array_function import ArrayFunction
from servoscope.core.jit.arrays import Variable

Numbers = list[Any]
Matrix = list[Numbers]


class Update(NamedTuple):
    """theta (n,) and P (n, n) after an update, its gain K (n,), and 1 in `refused` where a guard made it skip."""

    theta: Numbers
    P: Matrix
    K: Numbers
    refused: Any = 0.0

    def where(self, condition: Any, theta: Numbers, P: Matrix, refused: Any) -> Update:
        """Return this update where a condition holds; elsewhere theta and P are as before, and K is zero."""
        return Update(
            [where(condition, new, old) for new, old in zip(self.theta, theta, strict=True)],
            symmetric(lambda i, j: where(condition, self.P[i][j], P[i][j]), len(theta)),
            [where(condition, gain, 0.0) for gain in self.K],
            refused,
        )


def symmetric(element: Callable[[int, int], Any], n: int) -> Matrix:
    """Return a matrix (n, n) by the elements of its lower triangle: symmetric to the last bit."""
    lower = [[element(i, j) for j in range(i + 1)] for i in range(n)]
    return [[lower[max(i, j)][min(i, j)] for j in range(n)] for i in range(n)]


def read_matrix(rows: Any, n: int, begin: int = 0, apart: int = 0) -> Matrix:
    """Return a matrix (n, n) that stands row by row from some place on, rows n or more `apart`."""
    return [[rows[begin + (apart or n) * i + j] for j in range(n)] for i in range(n)]


def write_matrix(rows: Any, matrix: Matrix, begin: Any = 0) -> None:
    """Write a matrix row by row from some place on."""
    for i, number in enumerate(number for row in matrix for number in row):
        rows[begin + i] = number


def run_updates(
    estimator: ModuleType, theta: FloatArray, P: FloatArray, P_d: FloatArray, R: float, memory: float, eta: FloatArray,
    phi: FloatArray, z: FloatArray, K: FloatArray, extra: FloatArray,
) -> int:  # fmt: skip
    """Take an estimator through samples, eta (N,), phi and z (N, n); return how many of them it refused.

    theta, P, the gain K of the last update and the private state `extra` are changed in place.
    """
    arrays = theta, P, P_d, float(R), float(memory), eta, phi, z, K, extra
    return int(_run_updates(*arrays, estimator=estimator, n=len(theta)))


@ArrayFunction
def _run_updates(
    printer: Any, theta: Any, P: Any, P_d: Any, R: Any, memory: Any, eta: Any, phi: Any, z: Any, K: Any, extra: Any, *,
    estimator: ModuleType, n: int,
) -> Any:  # fmt: skip
    refused = Variable(printer, 0)
    for k in printer.loop(0, eta.shape[0]):
        vectors = [[x[i] for i in range(n)] for x in (theta, phi[k], z[k])]
        matrices = [[[x[i, j] for j in range(n)] for i in range(n)] for x in (P, P_d)]
        new = estimator.update(vectors[0], *matrices, R, memory, eta[k], *vectors[1:], extra)
        for i in range(n):
            theta[i], K[i] = new.theta[i], new.K[i]
            for j in range(n):
                P[i, j] = new.P[i][j]
        refused.value = refused.value + printer.truncate(R * 0.0 + new.refused)
    return refused.value
