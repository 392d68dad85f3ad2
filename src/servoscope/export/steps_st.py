"""The steps of a sample and of an evaluation as Structured Text, traced from the text that the monitor itself runs."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any

from servoscope.core.jit.c_source import CRows
from servoscope.core.jit.st_source import STPrinter
from servoscope.estimation import estimators
from servoscope.estimation.kernel.cusum import update_cusum, update_cusum_by_sums
from servoscope.estimation.kernel.evaluation_steps import EvaluationSteps
from servoscope.estimation.kernel.sample_steps import TILE, SampleSteps
from servoscope.estimation.kernel.spec import KernelSpec

__all__ = ["StepTexts", "step_texts"]

SIGNALS = {0: "signal_r", TILE: "signal_u", 2 * TILE: "signal_y"}
# parameters of the steps -> variables of the function block
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

StepTexts = dict[str, list[str]]


def step_texts(spec: KernelSpec, members: int) -> StepTexts:
    """Return the statements of each step by its name; `members` is the number of CUSUMs."""
    size = spec.sizes
    steps = SampleSteps(spec, estimators.load_estimator(spec.estimator), single_lane=True)
    texts = {
        "begin_filters": _traced(
            lambda c, s, h, tile: steps.begin_filters(c, s, h, tile, 0), ("c", "s", "h"), tile=SIGNALS
        ),
        "advance_filters": _advance_filters(steps),
        "reset_noise": _traced(steps.reset_noise, ("s", "h")),
        "update_estimate": _traced(steps.update_estimate, ("c", "s", "h", "v", "shadow", "e", "extra")),
        "begin_evaluation": _traced(steps.begin_evaluation, ("s", "h")),
        "store_residual": [],
        "update_cusums": [],
        "update_alarm": [],
        "evaluate": _evaluate(spec),
    }
    if size.watched:
        texts["update_cusums"] = _update_cusums(spec, members)
        if spec.sums:
            texts["update_alarm"] = _traced(steps.end_evaluation, ("s", "h", "top"))
        else:
            texts["store_residual"] = _traced(
                lambda c, s, h, status, e, w, when: steps.store_residual(c, s, h, status, e, w, when, 0),
                ("c", "s", "h", "status", "e", "w", "when"),
            )
            texts["update_alarm"] = _traced(
                lambda s, h, top, when: steps.update_alarm(s, h, top, when, 0), ("s", "h", "top", "when")
            )
    return texts


def temporaries(texts: StepTexts) -> dict[str, list[str]]:
    """Return the names of the numbers, conditions and whole numbers that the statements need between them, by type."""
    found = {name for lines in texts.values() for line in lines for name in TEMPORARY.findall(line)}
    kinds: dict[str, list[str]] = {kind: [] for kind in KINDS.values()}
    for name in sorted(found, key=lambda name: (name[0], int(name[1:]))):
        kinds[KINDS[name[0]]].append(name)
    return kinds


def _traced(
    body: Callable[..., Any], parameters: Sequence[str], /, printer: STPrinter | None = None, **places: dict[int, str]
) -> list[str]:
    """Return the statements of a step, which is called with one array per parameter and per table of places."""
    printer = printer or STPrinter()
    rows = [CRows(printer, VARIABLES.get(name, name)) for name in parameters]
    rows += [CRows(printer, "", place) for place in places.values()]
    body(*rows)
    for row in rows:
        row.flush()
    return printer.lines()


def _advance_filters(steps: SampleSteps) -> list[str]:
    printer = STPrinter()
    due = printer.condition("update_due")

    def body(c: CRows, s: CRows, h: CRows, status: CRows, v: CRows, shadow: CRows, tile: CRows) -> None:
        steps.advance_filters(c, s, h, status, v, shadow, tile, 0, due)

    return _traced(body, ("c", "s", "h", "status", "v", "shadow"), printer, tile=SIGNALS)


def _update_cusums(spec: KernelSpec, members: int) -> list[str]:
    """Return the loop over the CUSUMs; those that only fill up a vector stay at zero and are left out."""
    printer, columns, watched, tail = STPrinter(), spec.columns, spec.sizes.watched, dict(spec.at)["tail"]
    table = [printer.read(f"constants[{tail + watched * k} + j]") for k in range(spec.sums or columns + 1)]
    if spec.sums:
        sums = [printer.read(f"numbers[{dict(spec.to)['sums'] + k}]") for k in range(spec.sums)]
        new = update_cusum_by_sums(table, sums, printer.read("cusums[j]"))
    else:
        *psi, e = [printer.read(f"whitened[{k}]") for k in range(columns + 1)]
        new = update_cusum(table[:-1], psi, e, printer.read("cusums[j]"), table[-1])
    printer.store(new.kind, new.text, "cusums[j]")
    inside = [*printer.lines(), "top[0] := SEL(top[0] > cusums[j], cusums[j], top[0]);"]
    return [
        "top[0] := 0.0;",
        f"FOR j := 0 TO {members - 1} DO",
        *(f"    {line}" for line in inside),
        "END_FOR;",
    ]


def evaluation_variables(n: int, frequencies: int) -> dict[int, str]:
    """Return the output in which each number of an evaluation stands."""
    names = ["updates", "statistic", "level", "crossed_s", *(f"theta[{i}]" for i in range(n))]
    names += [f"covariance[{i}]" for i in range(n * n)]
    return dict(enumerate([*names, *(f"response[{i}]" for i in range(6 * frequencies))]))


def _evaluate(spec: KernelSpec) -> list[str]:
    steps, size = EvaluationSteps(spec), spec.sizes

    def body(c: CRows, s: CRows, h: CRows, q: CRows) -> None:
        steps.write_evaluation(c, s, h, q)
        for f in range(size.frequencies):
            steps.write_response(c, s, f, q)

    return _traced(body, ("c", "s", "h"), q=evaluation_variables(size.n, size.frequencies))
