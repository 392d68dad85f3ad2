"""What an estimator returns of one update: theta, P and the gain, as traced arithmetic; and many updates at once."""

from __future__ import annotations

import functools
from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.jit import where
from servoscope.core.jit.arrays import Variable
from servoscope.core.jit.llvm_text import LlvmPrinter
from servoscope.core.jit.memory import Memory, apply
from servoscope.core.jit.native import address, native_function
from servoscope.core.jit.symbolic import Float

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


def write_matrix(rows: Any, matrix: Matrix, begin: int = 0) -> None:
    """Write a matrix row by row from some place on."""
    for i, number in enumerate(number for row in matrix for number in row):
        rows[begin + i] = number


ARRAYS = ("theta", "P", "P_d", "eta", "phi", "z", "K", "extra")


def run_updates(
    estimator: ModuleType, theta: FloatArray, P: FloatArray, P_d: FloatArray, R: float, memory: float, eta: FloatArray,
    phi: FloatArray, z: FloatArray, K: FloatArray, extra: FloatArray,
) -> int:  # fmt: skip
    """Take an estimator through samples, eta (N,), phi and z (N, n); return how many of them it refused.

    theta, P, the gain K of the last update and the private state `extra` are changed in place.
    """
    arrays = theta, P, P_d, *map(np.ascontiguousarray, (eta, phi, z)), K, extra
    places = (address(array) for array in arrays)
    return int(_compile_updates(estimator, len(theta))(*places, R, memory, len(eta)))


@functools.cache
def _compile_updates(estimator: ModuleType, n: int) -> Callable[..., int]:
    arguments = (*((name, "ptr") for name in ARRAYS), ("R", "double"), ("memory", "double"), ("samples", "i64"))
    p = LlvmPrinter(arguments, "i64")
    R, memory = (Float(p, f"%{name}", "double") for name in ("R", "memory"))
    refused = Variable(p, 0)

    def step(theta: Any, P: Any, P_d: Any, eta: Any, phi: Any, z: Any, K: Any, extra: Any) -> Any:
        signals = eta[0], [phi[i] for i in range(n)], [z[i] for i in range(n)]
        new = estimator.update(
            [theta[i] for i in range(n)], read_matrix(P, n), read_matrix(P_d, n), R, memory, *signals, extra
        )
        for i in range(n):
            theta[i], K[i] = new.theta[i], new.K[i]
        write_matrix(P, new.P)
        return new.refused

    for k in p.loop(0, p.argument("samples")):
        memories = [Memory(p, f"%{name}", "double") for name in ARRAYS]
        memories[3:6] = memories[3].behind(k), memories[4].behind(k * n), memories[5].behind(k * n)
        refused.value = refused.value + p.truncate(R * 0.0 + apply(step, *memories))
    p.write(f"ret i64 {refused.value}")
    return native_function(p.text(), arguments, "i64")
