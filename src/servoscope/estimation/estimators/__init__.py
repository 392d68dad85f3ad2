"""Recursive estimators, one file each; they know eta, phi, z, theta and P, and nothing of plants and loops.

Each module offers ``NAME`` (as in a loop file), ``NEEDS_INSTRUMENT`` and a traced function (`core.jit.symbolic`)

    update(theta, P, P_d, R, memory, eta, phi, z, extra) -> Update

that returns theta (n,) and P (n, n) after an update, the gain K (n,) it used, and whether a guard made it skip (then
theta and P are as before and K is zero). It starts at P = P_d, and `memory` N, in updates, means the same in all of
them: what was true N updates ago weighs 1/e under the excitation that P_d was tuned on. P carries R: where a textbook
has unit residual variance, its P is P/R here. `run_updates` (`estimation.update`) takes one through samples by itself.

Optional: ``extra_state_size(n, memory)``, the size of a private state that arrives as `extra` and is changed in place,
zero at the start (without it, `extra` has no numbers); ``steady_gain(R, phi) -> K``, the gain where P stays at P_d
once it is there, in coordinates in which P_d is the identity (a recursion that starts there needs no P); and
``EXCEPTIONS``: which of the `CHECKS` that estimators have in common it cannot pass, and why.

A monitor runs with any of them. Without "covariance" and "mean" among its exceptions, an estimator's statistic and
fault sizes are valid under any excitation; the others are for comparison.

Another package adds estimators by entry points in the group ``servoscope.estimators``: name -> module.
"""

from __future__ import annotations

import functools
import importlib
import pkgutil
from collections.abc import Mapping
from importlib import metadata
from types import ModuleType

from servoscope.core.errors import LoopError

GROUP = "servoscope.estimators"
CHECKS = {
    "positive": "P stays symmetric and positive",
    "no windup": "at phi = 0 theta and P stand still",
    "contracts": "P approaches P_d along excited directions and stays there, eq. (12)",
    "covariance": "K is all that `moments.propagate_covariance` needs to carry the covariance of theta_hat",
    "mean": "from P = P_d on its gain is that of the AKF, which the expectation (`moments.mean_path`) follows",
    "textbook": "it computes the same as its obvious version in tests/support/naive.py",
    "converges": "without noise theta_hat reaches theta",
    "memory": "N updates leave 1/e of what was true before",
    "memory in weak directions": "the same in directions that are hardly excited, where P_d = (R/N) R_phi^-1",
    "private state": "theta, P and `extra` are all that it remembers, and its inputs stay as they are",
}


def estimator_names() -> list[str]:
    """Return the names of the estimators that exist, sorted; this imports none of them."""
    return sorted({*_own_names(), *(entry.name for entry in metadata.entry_points(group=GROUP))})


@functools.cache
def _own_names() -> list[str]:
    return [module.name.replace("_", "-") for module in pkgutil.iter_modules(__path__)]


def load_estimator(name: str) -> ModuleType:
    """Return the module of an estimator by its name in a loop file.

    Raises
    ------
    LoopError
        If there is no such estimator.
    """
    if name in _own_names():
        return importlib.import_module(f"{__name__}.{name.replace('-', '_')}")
    for entry in metadata.entry_points(group=GROUP, name=name):
        module: ModuleType = entry.load()
        return module
    raise LoopError(f"[monitor] estimator = {name!r}: unknown, choose from {', '.join(estimator_names())}")


def extra_state_size(name: str, n: int, memory: float) -> int:
    """Return how many floats of private state an estimator of n coefficients needs."""
    size = getattr(load_estimator(name), "extra_state_size", None)
    return 0 if size is None else int(size(n, memory))


def exceptions(name: str) -> Mapping[str, str]:
    """Return which of the `CHECKS` an estimator cannot pass -> why."""
    return dict(getattr(load_estimator(name), "EXCEPTIONS", {}))
