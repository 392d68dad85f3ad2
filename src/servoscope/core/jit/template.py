"""Templates of kernels: plain functions whose sizes and parts are filled in later."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from types import FunctionType
from typing import Any


def specialise(template: Callable[..., Any], names: Mapping[str, object], variant: str = "") -> Callable[..., Any]:
    """Return a template, a plain function, with other objects in the place of some names of its module.

    Sizes become literals that way, and an estimator's `update` a direct call. `variant` tells apart the copies of one
    template that are kernels; it is part of the name under which they are cached.

    Raises TypeError if the template is compiled already, or no function.
    """
    if not isinstance(template, FunctionType):
        raise TypeError(f"a template is a plain function, not {type(template).__name__}")
    digest = hashlib.sha256(variant.encode()).hexdigest()[:12] if variant else ""
    name = "_".join(filter(None, (template.__name__.lstrip("_"), digest)))
    function = FunctionType(template.__code__, {**template.__globals__, **names}, name)
    function.__qualname__, function.__module__ = name, template.__module__
    return function
