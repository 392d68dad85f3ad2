"""Arithmetic that is code or numbers: both agree, and code rounds alike however many lanes go together."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from servoscope.core.jit import Float, dot, fma, maximum, minimum, sqrt, tril_index, where
from servoscope.core.jit.llvm_text import LlvmPrinter
from servoscope.core.jit.memory import Memory, apply, repeat
from servoscope.core.jit.native import address, native_function
from servoscope.estimation.kernel.sparse_lti import advance_system, pack_coefficients, sparsity_pattern
from servoscope.models.lti import LinearSystem

LANES = 16
ELEMENTS = {np.dtype(np.float64): "double", np.dtype(np.float32): "float"}


def mixed(x: Any, y: Any) -> None:
    """Use every operation once; y becomes functions of x."""
    a, b, c = x[0], x[1], x[2]
    y[0] = fma(a, b, c) + 2.0 * a - b / (1.0 + abs(c))
    y[1] = maximum(a, minimum(b, 0.5)) - sqrt(abs(a) + 1.0)
    y[2] = where(a > b, where(c <= 0.0, where(a >= 0.0, where(b < 1.0, 1.0, 2.0), -1.0), c), 1.0 / (abs(b) + 0.1))
    y[3] = dot([a, b, c], [c, -a, b])


def lanes_of(
    body: Callable[[LlvmPrinter, list[Memory]], None], width: int, *arrays: np.ndarray[Any, Any], **numbers: int
) -> None:
    """Compile what a body writes for neighbouring lanes of arrays (rows, lanes), and run it over all of them."""
    names = tuple((f"a{k}", "ptr") for k in range(len(arrays))) + tuple((name, "i64") for name in numbers)
    printer = LlvmPrinter(names)
    body(printer, [Memory(printer, f"%a{k}", ELEMENTS[x.dtype], width) for k, x in enumerate(arrays)])
    printer.write("ret void")
    run = native_function(printer.text(), names)
    for first in range(0, arrays[0].shape[1], width):
        parts = [np.ascontiguousarray(x[:, first : first + width]) for x in arrays]
        run(*map(address, parts), *numbers.values())
        for x, part in zip(arrays, parts, strict=True):
            x[:, first : first + width] = part


@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_code_does_to_lanes_what_python_does_to_numbers(kind: Any) -> None:
    x = np.random.default_rng(0).standard_normal((3, LANES)).astype(kind)
    found = []
    for width in (1, 8, 16):
        y = np.zeros((4, LANES), dtype=kind)
        lanes_of(lambda printer, memories: apply(mixed, *memories), width, x, y)
        found.append(y)
    assert np.array_equal(found[0], found[1]) and np.array_equal(found[0], found[2])
    for a in range(LANES):
        plain = dict.fromkeys(range(4), 0.0)
        mixed([float(v) for v in x[:, a]], plain)
        assert found[0][:, a] == pytest.approx(
            list(plain.values()), rel=1e-14 if kind is np.float64 else 1e-5, abs=1e-6
        )


def test_a_multiply_add_is_rounded_once() -> None:
    a = 1.0 + 2.0**-30
    x, y = np.array([[a], [a], [-1.0 - 2.0**-29]]), np.zeros((1, 1))

    def multiply_add(x: Any, y: Any) -> None:
        y[0] = fma(x[0], x[1], x[2])

    lanes_of(lambda printer, memories: apply(multiply_add, *memories), 1, x, y)
    assert y[0, 0] == 2.0**-60


def add_up(s: Any, x: Any, i: Any) -> None:
    """Add sample i to a sum, and to that sum's sum."""
    s[0] = s[0] + x[i]
    s[2] = s[2] + s[0] * s[1]


@pytest.mark.parametrize("width", [1, 8])
def test_a_loop_leaves_what_its_steps_would(width: int) -> None:
    """Rows that it keeps in registers are read before it and stored behind it; a loop of no steps changes nothing."""
    rng = np.random.default_rng(0)
    x, s = rng.standard_normal((5, LANES)), rng.standard_normal((3, LANES))
    expected = s.copy()

    def body(printer: LlvmPrinter, memories: list[Memory]) -> None:
        repeat(add_up, printer.argument("begin"), printer.argument("end"), *memories, kept=memories[:1])

    for begin, end in ((1, 4), (2, 2), (4, 5)):
        for i in range(begin, end):
            expected[0] += x[i]
            expected[2] += expected[0] * expected[1]
        lanes_of(body, width, s, x, begin=begin, end=end)
        assert np.array_equal(s, expected)


def test_lanes_in_which_a_mask_does_not_hold_stay_as_they_are() -> None:
    x, y = np.arange(-4.0, 4.0)[None], np.full((1, 8), 7.0)

    def double(x: Any, y: Any) -> None:
        y[0] = x[0] * 2.0

    def body(printer: LlvmPrinter, memories: list[Memory]) -> None:
        positive = Float(printer, memories[0].load(0), memories[0].kind) > 0.0
        with printer.when(printer.holds("or", positive)):
            apply(double, *memories, mask=positive)

    lanes_of(body, 8, x, y)
    assert y[0].tolist() == [7.0] * 5 + [2.0, 4.0, 6.0]


def test_a_square_is_transposed() -> None:
    x = np.random.default_rng(0).standard_normal((8, 8))
    y = np.zeros((8, 8))

    def body(printer: LlvmPrinter, memories: list[Memory]) -> None:
        source, target = memories
        for row, text in enumerate(printer.transpose(source.kind, [source.load(row) for row in range(8)])):
            target.store(row, text)

    lanes_of(body, 8, x, y)
    assert np.array_equal(y, x.T)


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
