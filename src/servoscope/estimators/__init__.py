"""The toolroom of recursive estimators: a file here is an estimator; they know eta, phi, z, theta, P and nothing else.

Each module offers ``NAME`` (as in a loop file), ``NEEDS_INSTRUMENT`` and a compiled

    update(theta, P, P_d, R, memory, eta, phi, z, K) -> status

that changes `theta` (n,) and `P` (n, n) in place, writes the gain it used into `K` (n,), and returns 0 when it
updated or 1 when a guard made it skip (then theta and P are untouched and K is zero).
"""

from __future__ import annotations

import importlib
import pkgutil
from types import ModuleType

from servoscope.errors import LoopError


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
