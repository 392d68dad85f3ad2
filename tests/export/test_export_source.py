"""The exported source by itself: self-test, other compilers and processors, sanitizers, static checks, stack."""

from __future__ import annotations

import platform
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
from drives import compiler
from hypothesis import given
from hypothesis import strategies as st
from studies import export as benchmark
from test_export import demo

from servoscope.core.jit.c_source import c_literal
from servoscope.export import export_c

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.mark.slow
@pytest.mark.parametrize("level", ["-O0", "-O1", "-O2", "-O3"])
@pytest.mark.parametrize(
    ("name", "emulator"),
    [
        ("clang", ""),
        ("aarch64-linux-gnu-gcc", "qemu-aarch64"),
        ("arm-linux-gnueabihf-gcc", "qemu-arm"),  # with fused multiply-adds: in software they take long
    ],
)
def test_self_test_of_other_compilers_and_processors(tmp_path: Path, name: str, emulator: str, level: str) -> None:
    if emulator:
        compiler(emulator)
    export_c(demo()).save(tmp_path)
    flags = f"{level} -mfpu=vfpv4" if emulator == "qemu-arm" else level
    settings = f"CC={compiler(name)}", f"CFLAGS={flags}", f"EMULATOR={emulator}", "LDFLAGS=-static" * bool(emulator)
    command = ["make", "-s", "-C", tmp_path, "check", *filter(None, settings)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_hundred_thousand_samples_by_other_compilers_and_processors(tmp_path: Path) -> None:
    """The benchmark itself, short: its state goes through an image on the way."""
    for _, name, _, emulator in benchmark.PROCESSORS:
        for needed in (name, *emulator):
            compiler(needed)
    exported = export_c(demo())
    exported.save(tmp_path)
    made = benchmark.builds(tmp_path, 100_000, 100_000, levels=("-O2",))
    benchmark.compare(demo(), made, exported.mark)
    assert [(one.samples, one.different) for one in made] == [(100_000, 0)] * 4 + [(10_000, 0)]


def cppcheck(folder: Path, *options: str) -> str:
    """Return what Cppcheck says of the demo's source; it reads no system headers, whose sizes are given."""
    export_c(demo()).save(folder)
    sizes = ["-DDBL_MANT_DIG=53", "-DFLT_EVAL_METHOD=0", "--suppress=missingIncludeSystem"]
    command = [compiler("cppcheck"), "--std=c99", *sizes, *options, folder / "servo_monitor.c"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=True)
    return done.stderr


@pytest.mark.slow
def test_cppcheck_finds_nothing(tmp_path: Path) -> None:
    assert not cppcheck(tmp_path, "--enable=warning,portability,performance,information")


@pytest.mark.slow
def test_deviations_from_misra_are_those_of_the_page(tmp_path: Path) -> None:
    found = set(re.findall(r"misra-c2012-([\d.]+)", cppcheck(tmp_path, "--enable=style", "--addon=misra")))
    page = (DOCS / "how-to" / "drive.md").read_text(encoding="utf-8")
    assert found == set(re.findall(r"^\| (\d+\.\d+) \|", page, re.MULTILINE))


@pytest.mark.slow
def test_cppcheck_sees_what_is_wrong(tmp_path: Path) -> None:
    """It once gave up at the first line, and found nothing."""
    export_c(demo()).save(tmp_path)
    source = tmp_path / "servo_monitor.c"
    text = source.read_text(encoding="utf-8").replace(
        "evaluate(state->numbers", "state->numbers[100000] = 0.0; evaluate(state->numbers"
    )
    source.write_text(text, encoding="utf-8")
    command = [compiler("cppcheck"), "--std=c99", "-DDBL_MANT_DIG=53", "-DFLT_EVAL_METHOD=0", "-q", source]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=True)
    assert "arrayIndexOutOfBounds" in done.stderr


def test_self_test(tmp_path: Path) -> None:
    export_c(demo(), "axis_3").save(tmp_path)
    done = subprocess.run(
        ["make", "-s", "-C", tmp_path, "check", f"CC={compiler()}"], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "ok: " in done.stdout and "bytes" in done.stdout and "ns per sample" in done.stdout
    assert platform.machine() != "x86_64" or re.search(r"[1-9]\d* cycles per sample", done.stdout)


def test_the_stack_is_bounded_and_printed(tmp_path: Path) -> None:
    export_c(demo()).save(tmp_path)
    command = ["make", "-s", "-C", tmp_path, "stack", f"CC={compiler()}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    found = re.search(r"stack: no more than (\d+) bytes", done.stdout)
    assert found, done.stderr
    assert 500 < int(found[1]) < 4096


def test_self_test_finds_a_wrong_bit(tmp_path: Path) -> None:
    export_c(demo()).save(tmp_path)
    source = tmp_path / "servo_monitor.c"
    text = source.read_text(encoding="utf-8")
    numbers = text[text.index(": bank */") :]
    literal = next(word.rstrip(",") for word in numbers.split() if word.startswith("0x"))
    other = c_literal(np.nextafter(float.fromhex(literal), np.inf))
    source.write_text(text.replace(literal, other, 1), encoding="utf-8")
    done = subprocess.run(
        ["make", "-s", "-C", tmp_path, "check", f"CC={compiler()}"], capture_output=True, text=True, timeout=300
    )
    assert done.returncode != 0
    assert "WRONG" in done.stdout


def test_sanitizers_find_nothing(tmp_path: Path) -> None:
    export_c(demo()).save(tmp_path)
    flags = "-O1 -fsanitize=undefined,address -fno-sanitize-recover=all"
    done = subprocess.run(
        ["make", "-s", "-C", tmp_path, "check", f"CC={compiler()}", f"CFLAGS={flags}"],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr


@given(st.floats())
def test_literals_are_exact(number: float) -> None:
    text = c_literal(number)
    if np.isnan(number):
        assert text == "(double)NAN"
    elif np.isinf(number):
        assert text == ("HUGE_VAL" if number > 0 else "-HUGE_VAL")
    else:
        back = float.fromhex(text) if "0x" in text else float(text)
        assert np.float64(back).tobytes() == np.float64(number).tobytes()
