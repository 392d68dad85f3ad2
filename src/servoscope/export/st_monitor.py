"""The monitor of one baseline as a function block of Structured Text (IEC 61131-3)."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.core.arrays import FloatArray
from servoscope.core.files import atomic_write, make_folder
from servoscope.core.jit.st_source import st_literal
from servoscope.estimation.kernel.sample_steps import HEADER_SIZE
from servoscope.export.c_monitor import NAME, fill_template, wrapped
from servoscope.export.constants import ExportConstants, check_name, common_words, plain_text, refuse_covariates
from servoscope.export.steps import StepTexts
from servoscope.export.steps_st import step_texts, temporaries

__all__ = ["export_st", "save_st"]


def export_st(baseline: Baseline, name: str = NAME, *, only_coefficients: bool = False) -> str:
    """Return the monitor of a baseline as a function block of Structured Text, in LREAL.

    It computes what `Monitor` computes, but for the rounding of multiply-adds, which are not fused there.

    Parameters
    ----------
    baseline
        Of one operating point.
    name
        Of the function block.
    only_coefficients
        As for `export_c`.

    Raises
    ------
    BaselineError
        If the baseline has something that cannot be exported; the message names it.
    """
    refuse_covariates(baseline, "function block")
    check_name(name)
    made = ExportConstants.from_baseline(baseline, only_coefficients)
    return fill_template("monitor.st", common_words(made, name) | _words(made))


def _words(made: ExportConstants) -> dict[str, Any]:
    """Return what the template names beside the words of all languages."""
    size, (on, off), baseline = made.spec.sizes, made.delays, made.baseline
    n, F, begin = size.n, size.frequencies, HEADER_SIZE + size.floats
    texts = step_texts(made.spec, made.members)
    last = {
        "theta": n,
        "shadow": made.spec.shadow_rows,
        "covariance": n * n,
        "response": 6 * F,
        "gamma": 2 * F,
        "number": size.floats,
        "counter": HEADER_SIZE,
        "cusum": max(size.watched, 1),
        "private": max(size.extra, 1),
        "regressor": size.rows,
        "whitened": made.spec.columns + 1,
        "constant": len(made.table),
    }
    return (
        _blocks(texts, made.recursion.constants[0].every if made.spec.sums else 0)
        | {f"last_{array}": count - 1 for array, count in last.items()}
        | {
            "rate": f"{baseline.loop.sample_rate:g}",
            "units": plain_text("; ".join(f"{coefficient} {unit}" for coefficient, unit in made.coefficients)),
            "limit": st_literal(baseline.thresholds.statistic),
            "on_delay": f"{on}.0",
            "off_delay": f"{off}.0",
            "off_delay_and_one": f"{off + 1}.0",
            "numbers": _list(made.start[HEADER_SIZE:begin]),
            "counters": _list(made.start[:HEADER_SIZE]),
            "cusums": _list(np.zeros(last["cusum"])),
            "private": f"[{last['private']}(0.0)]",
            "healthy": _list(x for H in made.healthy.H for x in (H.real, H.imag)),
            "constants": "\n".join(wrapped(map(st_literal, made.table))).rstrip(","),
            "temporaries": _declarations(texts),
            "gamma": "\n".join(
                f"    gamma[{i}] := response[{6 * (i // 2) + i % 2}] - healthy[{i}];" for i in range(2 * F)
            ),
        }
    )


def save_st(baseline: Baseline, folder: str | Path, name: str = NAME, *, only_coefficients: bool = False) -> Path:
    """Write the function block into a folder, which is made if there is none; return its path.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    text = export_st(baseline, name, only_coefficients=only_coefficients)
    make_folder(Path(folder))
    path = Path(folder) / f"{name}.st"
    atomic_write(path, text.encode())
    return path


def _blocks(texts: StepTexts, by_evaluation: int) -> dict[str, str]:
    """Return the statements of each step, indented as its place in the template asks.

    `by_evaluation`: samples of an evaluation, if CUSUMs step once in each, else 0.
    """
    depths = {"begin_filters": 2, "advance_filters": 1, "update_estimate": 1, "reset_noise": 1, "evaluate": 1}
    blocks = {name: _indented(texts[name], depth) for name, depth in depths.items()}
    test = [line for name in ("update_cusums", "update_alarm", "end_evaluation") for line in texts.get(name, ())]
    if test and by_evaluation:
        test = [f"IF evaluation_phase + 1 >= {by_evaluation} THEN", *(f"    {line}" for line in test), "END_IF;"]
    test = [*texts.get("store_residual", ()), *test]
    begin = texts.get("begin_evaluation", [])
    if begin:
        begin = ["IF evaluation_phase = 0 THEN", *(f"    {line}" for line in begin), "END_IF;"]
    return blocks | {"sequential_test": _indented(test, 0), "begin_evaluation": _indented(begin, 0)}


def _indented(lines: Iterable[str], depth: int) -> str:
    return "\n".join("    " * depth + line for line in lines)


def _declarations(texts: StepTexts) -> str:
    lines = []
    for kind, names in temporaries(texts).items():
        for begin in range(0, len(names), 16):
            lines.append(f"    {', '.join(names[begin : begin + 16])} : {kind};")
    return "\n".join(lines)


def _list(numbers: Iterable[float] | FloatArray) -> str:
    return ", ".join(st_literal(float(number)) for number in numbers)
