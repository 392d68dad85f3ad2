"""The toolroom of recursive estimators: a file here is an estimator; they know eta, phi, z, theta, P and nothing else.

Each module offers ``NAME`` (as in a loop file), ``NEEDS_INSTRUMENT`` and a compiled

    update(theta, P, P_d, R, memory, eta, phi, z, K, extra) -> status

that changes `theta` (n,) and `P` (n, n) in place, writes the gain it used into `K` (n,), and returns 0 when it
updated or 1 when a guard made it skip (then theta and P are untouched and K is zero). It starts at P = P_d, and
`memory` N, in updates, means the same in all of them: what was true N updates ago weighs 1/e under the excitation
that P_d was tuned on (nothing in a sliding window, whose length it is). P carries R: where a textbook has unit
residual variance, its P is P/R here.

Optional: ``EXTRA(n, memory)``, the size of a private state that arrives as `extra`, zero at the start (without it,
`extra` has length zero); ``steady(R, phi) -> K``, the gain where P never leaves P_d once it is there, in coordinates
in which P_d is the identity (a recursion that starts there needs no P); and ``EXCEPTIONS``, which of the `CHECKS` that
all estimators share it cannot pass, and why.

A monitor runs with any of them; those without "covariance" and "mean" among their exceptions are the ones whose
statistic and fault sizes mean what they say under any excitation, the others are for comparison.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Mapping
from types import ModuleType

from servoscope.errors import LoopError

CHECKS = {
    "positive": "P stays symmetric and positive",
    "no windup": "at phi = 0 theta and P stand still",
    "contracts": "P approaches P_d along excited directions and stays there, eq. (12)",
    "covariance": "K is all that `propagation.spread` needs to carry the covariance of theta_hat",
    "mean": "from P = P_d on its gain is that of the AKF, which the expectation (`propagation.mean_path`) follows",
}


def names() -> list[str]:
    """Return the names of the estimators that exist, sorted; finding them imports none of them."""
    return sorted(module.name.replace("_", "-") for module in pkgutil.iter_modules(__path__))


def load(name: str) -> ModuleType:
    """Return the module of an estimator by its name in a loop file.

    Raises
    ------
    LoopError
        If there is no such estimator.
    """
    if name not in names():
        raise LoopError(f"[monitor] estimator = {name!r}: unknown, choose from {', '.join(names())}")
    return importlib.import_module(f"{__name__}.{name.replace('-', '_')}")


def extra(name: str, n: int, memory: float) -> int:
    """Return how many floats of private state an estimator of n coefficients asks for.

    Raises
    ------
    LoopError
        If there is no such estimator.
    """
    size = getattr(load(name), "EXTRA", None)
    return 0 if size is None else int(size(n, memory))


def exceptions(name: str) -> Mapping[str, str]:
    """Return which of the `CHECKS` an estimator cannot pass -> why.

    Raises
    ------
    LoopError
        If there is no such estimator.
    """
    return dict(getattr(load(name), "EXCEPTIONS", {}))
