"""Normalised least mean squares: a step along phi, no matrix at all; the floor to compare with."""

from __future__ import annotations

from typing import Any

from servoscope.core.jit import sum_products
from servoscope.estimation.update import Matrix, Numbers, Update

NAME = "nlms"
NEEDS_INSTRUMENT = False
EXCEPTIONS = {
    "contracts": "P is not used: it stays what it was at the start",
    "memory in weak directions": "the step goes along phi: directions that are hardly excited take (nearly) forever",
    "mean": "its gain knows no P_d: the expectation is good only where even the weak directions have converged",
}


def update(
    theta: Numbers, P: Matrix, P_d: Matrix, R: Any, memory: Any, eta: Any, phi: Numbers, z: Numbers, extra: Any
) -> Update:
    """Take one step K = phi/(N + phi' phi), N the memory.

    In the metric of P_d, NLMS is K = P_d phi/(R + phi' P_d phi): the AKF at P = P_d, to the last digit, so there would
    be nothing to compare. This is the plain one: the same with P_d = (R/N) I, which is (R/N) R_phi^-1 where the
    columns, scaled to a mean square of one as they are, are also uncorrelated. Along an eigenvector of their
    correlation matrix of eigenvalue m the memory is N/m: with strongly correlated columns the weak directions take
    (nearly) forever. N in the denominator keeps a small phi from making large steps of noise.

    **The statistic** detects, for S is right, but its faults remain unnamed: the expectation follows the gain at P_d,
    under which all directions converge alike.

    Source: Haykin, Adaptive Filter Theory (2002), chapter 6.
    """
    e = sum_products([-x for x in phi], theta, eta)
    denominator = sum_products(phi, phi, memory)
    K = [x / denominator for x in phi]
    return Update([x + gain * e for x, gain in zip(theta, K, strict=True)], P, K)
