"""Chooses what runs kernels: Numba's machine code, or plain Python where that cannot be made.

`core.jit.compile` uses parts of Numba that are not public and may change in any release. `TESTED` are the releases that
the tests ran with. With any other a trial kernel is compiled first, and where that fails the same arithmetic runs
interpreted: to the same bits, some thousand times slower.
"""

from __future__ import annotations

import functools
import importlib
import logging
import os
from types import ModuleType
from typing import Any

import numpy as np

from servoscope.core.errors import ServoscopeError
from servoscope.core.jit.symbolic import fma, maximum, sqrt, where
from servoscope.core.jit.template import specialise

VARIABLE = "SERVOSCOPE_JIT"
CHOICES = ("auto", "numba", "plain")
TESTED = (0, 59), (0, 68)  # first and last series of Numba's releases

logger = logging.getLogger(__name__)


@functools.cache
def load_backend() -> ModuleType:
    """Return the module that `VARIABLE` selects: `core.jit.compile` or `core.jit.plain`.

    Raises ServoscopeError if it selects no backend, or demands Numba where that does not work.
    """
    choice = os.environ.get(VARIABLE, "auto")
    if choice not in CHOICES:
        raise ServoscopeError(f"{VARIABLE} = {choice!r}: unknown, choose from {', '.join(CHOICES)}")
    plain = importlib.import_module("servoscope.core.jit.plain")
    if choice == "plain":
        return plain
    try:
        import numba

        compiler = importlib.import_module("servoscope.core.jit.compile")
        if not is_tested(numba.__version__):
            first, last = (".".join(map(str, series)) for series in TESTED)
            logger.warning("Numba %s is untested, %s to %s are tested", numba.__version__, first, last)
            if not np.array_equal(run_trial(compiler), run_trial(plain)):
                raise ArithmeticError("a trial kernel gives wrong numbers")
    except Exception as error:  # whatever a changed interface, or a broken installation, leads to
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        if choice == "numba":
            raise ServoscopeError(f"{VARIABLE} = 'numba': Numba cannot compile kernels ({reason})") from None
        logger.warning("kernels run as plain Python, very slowly: Numba cannot compile them (%s)", reason)
        return plain
    return compiler


def is_tested(version: str) -> bool:
    """Return whether a release of Numba, as in ``numba.__version__``, is among those that were tested."""
    first, last = TESTED
    return first <= tuple(int(part) for part in version.split(".")[:2]) <= last


def run_trial(backend: Any) -> np.ndarray[Any, Any]:
    """Return what a kernel that uses every function of a backend computes."""
    names: dict[str, object] = {
        "_step": backend.trace_function(_trial_step, 8, kept=("s",)),
        "_any": backend.trace_function(_trial_any, 8, shared="c"),
        "_transpose": backend.make_transpose(8),
        "_stack_array": backend.stack_array,
        "_lane_view": backend.lane_view,
        "_prefetch": backend.prefetch,
    }
    names["_sum_rows"] = backend.subroutine(specialise(_trial_sum, names))
    for name in ("as_float", "load_word", "multiply_high", "leading_zeros", "trailing_zeros"):
        names[f"_{name}"] = getattr(backend, name)
    x = (np.arange(64.0).reshape(8, 8) - 30.0) / 7.0
    y, words = np.zeros((10, 8)), np.zeros(5, np.uint64)
    backend.kernel(specialise(_trial, names, "trial"), heap=False)(x, y)
    backend.kernel(specialise(_trial_words, names, "words"), heap=False)(np.arange(3, 15, dtype=np.uint8), words)
    return np.concatenate([y.ravel(), words.astype(np.float64)])


# what the templates of the trial are filled with
_any: Any = None
_as_float: Any = None
_lane_view: Any = None
_leading_zeros: Any = None
_load_word: Any = None
_multiply_high: Any = None
_prefetch: Any = None
_stack_array: Any = None
_step: Any = None
_sum_rows: Any = None
_trailing_zeros: Any = None
_transpose: Any = None


def _trial_step(s: Any, x: Any, i: Any) -> None:
    s[0] = fma(s[0], 0.3, x[i])
    s[1] = where((x[i] > 0.0) & (s[0] >= 1.0), maximum(s[1], sqrt(abs(x[i]))), s[1] / 3.0)


def _trial_any(c: Any, s: Any) -> Any:
    return (s[0] > c[0]) | (s[1] > c[1])


def _trial_sum(x: Any, s: Any) -> None:
    for i in range(2):
        for a in range(8):
            s[i, a] += x[i, a]


def _trial(x: Any, y: Any) -> None:
    s = _stack_array(x, 2, 8)
    for a in range(8):
        s[0, a] = s[1, a] = 0.0
    _prefetch(x, 1, 0)
    _step(0, s, x, 0, 8)
    _transpose(x, 0, 0, y, 2, 0)
    _sum_rows(s, y)
    if _any(0, _lane_view(x[0], 8, 0), s):
        y[0, 0] += 1.0


def _trial_words(data: Any, words: Any) -> None:
    words[0] = _load_word(data, 3)
    words[1] = _multiply_high(words[0], words[0])
    words[2] = _leading_zeros(words[1])
    words[3] = _trailing_zeros(words[0])
    words[4] = 2.0**200 * _as_float(words[0])
