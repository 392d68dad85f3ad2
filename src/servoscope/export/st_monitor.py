"""The monitor of one baseline as a function block of Structured Text (IEC 61131-3)."""

from __future__ import annotations

import re
from pathlib import Path

from servoscope.baseline.baseline import Baseline
from servoscope.core.files import atomic_write, make_folder
from servoscope.core.jit.st_source import STPrinter
from servoscope.estimation.kernel.sample_steps import HEADER_SIZE, TILE
from servoscope.estimation.kernel.spec import KernelSpec
from servoscope.export.c_monitor import NAME
from servoscope.export.constants import ExportConstants, check_name, common_words, refuse_covariates
from servoscope.export.steps import StepTexts, StepTracer, evaluation_names
from servoscope.export.texts import fill_template

SIGNALS = {0: "signal_r", TILE: "signal_u", 2 * TILE: "signal_y"}
# arrays of the steps -> variables of the function block
VARIABLES = {
    "c": "constants",
    "s": "numbers",
    "h": "counters",
    "v": "regressors",
    "e": "residual",
    "w": "whitened",
    "g": "cusums",
    "when": "moment",
    "extra": "private_state",
}
TEMPORARY = re.compile(r"\b[tbkx]\d+\b")
KINDS = {"t": "LREAL", "b": "BOOL", "k": "DINT", "x": "DINT"}  # of temporaries, by their first letter


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
    size, begin = made.spec.sizes, HEADER_SIZE + made.spec.sizes.floats
    texts = step_texts(made.spec, made.members)
    return fill_template(
        "monitor.st",
        **common_words(made, name),
        texts=texts,
        temporaries=temporaries(texts),
        counters=made.start[:HEADER_SIZE],
        numbers=made.start[HEADER_SIZE:begin],
        cusums=max(size.watched, 1),
        private=max(size.extra, 1),
        healthy=[part for H in made.healthy.H for part in (H.real, H.imag)],
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


def step_texts(spec: KernelSpec, members: int) -> StepTexts:
    """Return the statements of each step by its name; `members` is the number of CUSUMs."""
    responses = (f"response[{i}]" for i in range(6 * spec.sizes.frequencies))
    places = {"tile": SIGNALS, "q": evaluation_names(spec.sizes.n, responses)}
    tracer = StepTracer(spec, STPrinter, VARIABLES, places, "update_due")
    texts = tracer.write_steps()
    if spec.sizes.watched:  # those CUSUMs that only fill up a vector stay at zero and are left out
        texts["update_cusums"] = [
            "top[0] := 0.0;",
            f"FOR j := 0 TO {members - 1} DO",
            *(f"    {line}" for line in tracer.write_cusum(VARIABLES["s" if spec.sums else "w"])),
            "    top[0] := SEL(top[0] > cusums[j], cusums[j], top[0]);",
            "END_FOR;",
        ]
    return texts


def temporaries(texts: StepTexts) -> dict[str, list[str]]:
    """Return the names of the numbers, conditions and whole numbers that the statements need between them, by type."""
    names = {name for lines in texts.values() for line in lines for name in TEMPORARY.findall(line)}
    kinds: dict[str, list[str]] = {kind: [] for kind in KINDS.values()}
    for name in sorted(names, key=lambda name: (name[0], int(name[1:]))):
        kinds[KINDS[name[0]]].append(name)
    return kinds
