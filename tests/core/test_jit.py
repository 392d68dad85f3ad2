"""Machine code: what its cache depends on, and what happens where there is none, or a damaged one."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from servoscope.core.cache_folders import warn_of_missing_cache
from servoscope.core.jit import Int, maximum, native, where
from servoscope.core.jit.array_function import ArrayFunction
from servoscope.core.jit.arrays import Variable, add_terms
from servoscope.core.jit.llvm_text import LlvmPrinter
from servoscope.core.jit.memory import Memory, apply
from servoscope.core.jit.native import address, native_function, object_code


def doubling(factor: float) -> tuple[str, tuple[tuple[str, str], ...]]:
    """Return the text of a function that multiplies a number by a factor, and its arguments."""
    arguments = (("x", "ptr"),)
    printer = LlvmPrinter(arguments)

    def multiply(x: list[float]) -> None:
        x[0] = x[0] * factor

    apply(multiply, Memory(printer, "%x", "double"))
    printer.write("ret void")
    return printer.text(), arguments


def product(factor: float) -> float:
    x = np.array([3.0])
    native_function(*doubling(factor))(address(x))
    return float(x[0])


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of its own, empty."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    return tmp_path / "objects"


def made(name: str, text: str) -> tuple[bytes, int]:
    """Return the machine code of a text, and how often the compiler was needed."""
    with pytest.MonkeyPatch.context() as patch:
        calls, compile_text = [0], native._compile
        patch.setattr(native, "_compile", lambda *given: (calls.append(1), compile_text(*given))[1])
        code = object_code(name, text)
    return code, sum(calls)


def test_equal_text_is_compiled_once(folder: Path) -> None:
    text, _ = doubling(2.0)
    first, count = made("a", text)
    assert count == 1 and [path.name for path in folder.iterdir()] == ["a.o"]
    assert made("a", text) == (first, 0)


def test_another_text_is_another_function(folder: Path) -> None:
    assert [product(factor) for factor in (2.25, 2.5, 2.25)] == [6.75, 7.5, 6.75]
    assert len(list(folder.iterdir())) == 2


@pytest.mark.parametrize("damage", [b"", b"x", b"y" * 5000])
def test_a_damaged_object_file_is_made_anew(folder: Path, damage: bytes) -> None:
    text, _ = doubling(2.0)
    first, _ = made("a", text)
    (folder / "a.o").write_bytes(damage)
    assert made("a", text) == (first, 1)
    assert made("a", text) == (first, 0)


def test_without_a_folder_it_compiles_for_this_process(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/proc/nowhere")
    warn_of_missing_cache.cache_clear()
    assert product(5.0) == 15.0
    warn_of_missing_cache.cache_clear()


def test_the_folder_is_the_users_where_none_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert native.object_folder() == tmp_path / "servoscope"


def test_a_function_refuses_what_is_no_number() -> None:
    x = np.array([3.0])
    double = native_function(*doubling(2.0))
    with pytest.raises(TypeError):
        double("x")
    with pytest.raises(TypeError):
        double(address(x), 1)
    assert x[0] == 3.0


class Scales(NamedTuple):
    """A named tuple of numbers, an array and a flag."""

    factor: float
    offsets: Any
    shifted: bool


@ArrayFunction
def scale_rows(printer: Any, x: Any, scales: Scales, out: Any) -> Any:
    for i in printer.loop(0, x.shape[0]):
        for k in printer.loop(0, x.shape[1]):
            value = x[i, k] * scales.factor
            out[i, k] = value + scales.offsets[k] if scales.shifted else value
    return x.shape[0]


@pytest.mark.parametrize("shifted", [False, True])
@pytest.mark.parametrize("dtype", [np.float64, np.complex128])
def test_loops_over_arrays(shifted: bool, dtype: Any) -> None:
    rng = np.random.default_rng(1)
    x = rng.standard_normal((4, 3)).astype(dtype)
    offsets, out = rng.standard_normal(3), np.empty_like(x)
    if dtype is np.complex128:
        x += 1j
    assert scale_rows(x, Scales(2.0, offsets, shifted), out) == 4
    assert np.array_equal(out, 2.0 * x + offsets * shifted)
    strided = np.zeros((4, 6), dtype=dtype)
    scale_rows(x.T.copy().T, Scales(2.0, offsets, shifted), strided[:, ::2])  # in no C order, either of them
    assert np.array_equal(strided[:, ::2], out) and not strided[:, 1::2].any()


@ArrayFunction
def complex_arithmetic(printer: Any, a: Any, b: Any, out: Any) -> None:
    for i in printer.loop(0, a.shape[0]):
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = a[i] + b[i], a[i] - b[i], a[i] * b[i], a[i] / b[i]
        out[i, 4], out[i, 5], out[i, 6] = 1.0 - a[i], a[i].real * b[i], 1.0 / (-a[i])


def test_complex_numbers() -> None:
    rng = np.random.default_rng(2)
    a, b = rng.standard_normal((2, 5)) + 1j * rng.standard_normal((2, 5))
    out = np.empty((5, 7), dtype=np.complex128)
    complex_arithmetic(a, b, out)
    assert np.allclose(out, np.array([a + b, a - b, a * b, a / b, 1.0 - a, a.real * b, -1.0 / a]).T, rtol=1e-14)


STATE = np.dtype([("count", np.float64), ("ends", np.float64, (2,))])


@ArrayFunction
def follow_range(printer: Any, states: Any, x: Any, flags: Any, numbers: Any) -> Any:
    s, longest, run = states[0], Variable(printer, 0), Variable(printer, 0)
    for k in printer.loop(0, x.shape[0]):
        with printer.when(flags[k] > 0):
            s.count = s.count + 1.0
            s.ends[0], s.ends[1] = where(x[k] < s.ends[0], x[k], s.ends[0]), maximum(s.ends[1], x[k])
        run.value = where(flags[k] > 0, run.value + 1, 0)
        longest.value = maximum(longest.value, run.value)
        flags[k] = where(numbers[k].is_equal(3) | ~(flags[k] > 0), 1, Int(printer, "0"))
    return add_terms(printer, printer.number(longest.value), x.shape[0], lambda k: x[k])


def test_records_flags_and_whole_numbers() -> None:
    x, flags = np.array([1.0, -2.0, 5.0, 0.5]), np.array([True, True, False, True])
    states, numbers = np.zeros(1, dtype=STATE), np.array([1, 3, 2, 4], dtype=np.int32)
    assert follow_range(states, x, flags, numbers) == 2.0 + x.sum()
    assert states["count"][0] == 3.0 and states["ends"].tolist() == [[-2.0, 1.0]]
    assert flags.tolist() == [False, True, True, False]


def test_other_threads_go_on_meanwhile() -> None:
    """Machine code that may take long gives the interpreter free."""
    x, beats, ended = np.zeros((2_000, 2_000)), [0], threading.Event()

    def beat() -> None:
        while not ended.wait(0.0001):
            beats[0] += 1

    thread = threading.Thread(target=beat)
    thread.start()
    scale_rows(x, Scales(2.0, np.zeros(2_000), False), np.empty_like(x))
    before = beats[0]
    for _ in range(40):
        scale_rows(x, Scales(2.0, np.zeros(2_000), False), np.empty_like(x))
    ended.set()
    thread.join()
    assert beats[0] - before > 40
