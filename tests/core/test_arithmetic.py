"""Arithmetic that is code or numbers: both agree, and code rounds alike however many lanes go together."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from servoscope.core.jit import (
    dot,
    fma,
    kernel,
    make_transpose,
    maximum,
    minimum,
    specialise,
    sqrt,
    trace_function,
    tril_index,
    where,
)
from servoscope.estimation.kernel.sparse_lti import advance_system, pack_coefficients, sparsity_pattern
from servoscope.models.lti import LinearSystem

LANES = 16


def mixed(x: Any, y: Any) -> None:
    """Use every operation once; y becomes functions of x."""
    a, b, c = x[0], x[1], x[2]
    y[0] = fma(a, b, c) + 2.0 * a - b / (1.0 + abs(c))
    y[1] = maximum(a, minimum(b, 0.5)) - sqrt(abs(a) + 1.0)
    y[2] = where(a > b, where(c <= 0.0, where(a >= 0.0, where(b < 1.0, 1.0, 2.0), -1.0), c), 1.0 / (abs(b) + 0.1))
    y[3] = dot([a, b, c], [c, -a, b])


def apply(x: np.ndarray[Any, Any], y: np.ndarray[Any, Any], step: int) -> None:
    for a in range(0, x.shape[1], step):
        _part(a, x, y)


_part: Any = None


@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_code_does_to_lanes_what_python_does_to_numbers(kind: Any) -> None:
    x = np.random.default_rng(0).standard_normal((3, LANES)).astype(kind)
    found = []
    for width in (1, 8, 16):
        y = np.zeros((4, LANES), dtype=kind)
        kernel(specialise(apply, {"_part": trace_function(mixed, width)}, f"{width}"), heap=False)(x, y, width)
        found.append(y)
    assert np.array_equal(found[0], found[1]) and np.array_equal(found[0], found[2])
    for a in range(LANES):
        plain = dict.fromkeys(range(4), 0.0)
        mixed([float(v) for v in x[:, a]], plain)
        assert found[0][:, a] == pytest.approx(
            list(plain.values()), rel=1e-14 if kind is np.float64 else 1e-5, abs=1e-6
        )


def add_up(s: Any, x: Any, i: Any) -> None:
    """Add sample i to a sum, and to that sum's sum."""
    s[0] = s[0] + x[i]
    s[2] = s[2] + s[0] * s[1]


def run_over(s: np.ndarray[Any, Any], x: np.ndarray[Any, Any], begin: int, end: int, step: int) -> None:
    for a in range(0, x.shape[1], step):
        _part(a, s, x, begin, end)


@pytest.mark.parametrize("width", [1, 8])
def test_a_loop_leaves_what_its_steps_would(width: int) -> None:
    """Rows that it keeps in registers are read before it and stored behind it; a loop of no steps changes nothing."""
    rng = np.random.default_rng(0)
    x, s = rng.standard_normal((5, LANES)), rng.standard_normal((3, LANES))
    run = kernel(
        specialise(run_over, {"_part": trace_function(add_up, width, kept=("s",))}, f"kept {width}"), heap=False
    )
    expected = s.copy()
    for begin, end in ((1, 4), (2, 2), (4, 5)):
        for i in range(begin, end):
            expected[0] += x[i]
            expected[2] += expected[0] * expected[1]
        run(s, x, begin, end, width)
        assert np.array_equal(s, expected)


@pytest.mark.parametrize("kinds", [("f8", "f8"), ("f8", "f4"), ("f4", "f8"), ("f4", "f4")])
@pytest.mark.parametrize("width", [8, 16])
def test_a_square_is_transposed_and_rounded(width: int, kinds: tuple[str, str]) -> None:
    x = np.random.default_rng(0).standard_normal((20, 30)).astype(kinds[0])
    y = np.zeros((30, 40), dtype=kinds[1])

    def transpose(x: np.ndarray[Any, Any], y: np.ndarray[Any, Any]) -> None:
        _part(x, 3, 5, y, 7, 11)

    kernel(specialise(transpose, {"_part": make_transpose(width)}, f"{width}"), heap=False)(x, y)
    expected = np.zeros_like(y)
    expected[7 : 7 + width, 11 : 11 + width] = x[3 : 3 + width, 5 : 5 + width].T
    assert np.array_equal(y, expected)


def test_a_symmetric_matrix_is_stored_once() -> None:
    assert sorted({tril_index(i, j) for i in range(4) for j in range(4)}) == list(range(10))
    assert tril_index(1, 3) == tril_index(3, 1)


def test_straight_line_code_leaves_out_zeros_and_nothing_else() -> None:
    rng = np.random.default_rng(1)
    A, B, C, D = (rng.standard_normal(s) * (rng.random(s) < 0.5) for s in ((5, 5), (5, 2), (3, 5), (3, 2)))
    system = LinearSystem(0.4 * A, B, C, D)
    found = sparsity_pattern([system])
    assert len(pack_coefficients(found, system)) == sum(np.count_nonzero(x) for x in (A, B, C, D))
    x, w = rng.standard_normal(5), rng.standard_normal((20, 2))
    state = dict(enumerate(x.tolist()))
    for w_k in w:
        v = advance_system(found, pack_coefficients(found, system).tolist(), 0, state, 0, w_k.tolist())
        assert v == pytest.approx((system.C @ x + system.D @ w_k).tolist())
        x = system.A @ x + system.B @ w_k
    assert list(state.values()) == pytest.approx(x.tolist())
