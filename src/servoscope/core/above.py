"""Functions of packages above, for results that draw, print or write themselves: looked up when called."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any


def function_above(module: str, name: str) -> Callable[..., Any]:
    """Return a function of a module of servoscope, for example ``report.plots``."""
    function: Callable[..., Any] = getattr(import_module(f"servoscope.{module}"), name)
    return function
