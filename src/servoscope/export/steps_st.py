"""The steps of a sample and of an evaluation as Structured Text."""

from __future__ import annotations

import re

from servoscope.core.jit.st_source import STPrinter
from servoscope.estimation.kernel.sample_steps import TILE
from servoscope.estimation.kernel.spec import KernelSpec
from servoscope.export.steps import StepTexts, StepTracer, evaluation_names

__all__ = ["step_texts", "temporaries"]

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
