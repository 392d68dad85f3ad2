"""How kernels are compiled: strict arithmetic, cached on disk where a folder can be written."""

from __future__ import annotations

import hashlib
from pathlib import Path
from types import FunctionType, ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

import numba

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

F = TypeVar("F", bound="Callable[..., object]")


def kernel(function: F) -> F:
    """Compile a function on its first call; without a folder for the cache, for this process only."""
    try:
        compiled = numba.njit(cache=True, error_model="numpy")(function)
    except RuntimeError:  # Numba found no folder that it can write
        compiled = numba.njit(error_model="numpy")(function)
    return compiled  # type: ignore[no-any-return]


def around(estimator: ModuleType, template: Callable[..., Any], parts: Sequence[ModuleType] = ()) -> Callable[..., Any]:
    """Compile a template with an estimator's `update` in the place of its `_update`.

    Numba's cache sees only the file of the function itself, so the sources of all that it inlines are part of its
    name: a change in any of them compiles anew.

    Parameters
    ----------
    estimator
        A module of `servoscope.estimators`.
    template
        Function that calls ``_update`` of its own module.
    parts
        Other modules whose kernels it inlines.

    Raises
    ------
    TypeError
        If the template is compiled already or no function.
    """
    if not isinstance(template, FunctionType):
        raise TypeError(f"a template is a plain function, not {type(template).__name__}")
    sources = [str(part.__file__) for part in (*parts, estimator)] + [template.__code__.co_filename]
    digest = hashlib.sha256(b"".join(Path(source).read_bytes() for source in sources)).hexdigest()[:12]
    name = f"{template.__name__.lstrip('_')}_{estimator.NAME.replace('-', '_')}"
    function = FunctionType(template.__code__, {**template.__globals__, "_update": estimator.update}, name)
    function.__qualname__ = f"{name}_{digest}"
    function.__module__ = template.__module__
    return kernel(function)
