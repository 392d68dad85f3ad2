"""The steps of one sample and of an evaluation as functions of C, traced from the text that the monitor itself runs."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping
from typing import Any

from servoscope.core.jit.c_source import CPrinter, CRows, c_literal
from servoscope.estimation import estimators
from servoscope.estimation.kernel.cusum import update_cusum, update_cusum_by_sums
from servoscope.estimation.kernel.evaluation_steps import EvaluationSteps
from servoscope.estimation.kernel.sample_steps import TILE, SampleSteps
from servoscope.estimation.kernel.spec import KernelSpec

__all__ = ["step_functions"]

SAMPLE = {0: "r", TILE: "u", 2 * TILE: "y", 3 * TILE: "restart"}
SAMPLE_PARAMETERS = ("number r", "number u", "number y", "double restart")
STATE = ("number *s", "double *h")
REGRESSORS = ("number *v", "number *shadow")


def step_functions(spec: KernelSpec, members: int, single: bool = False) -> list[str]:
    """Return the functions that a sample goes through; `members` is the number of CUSUMs."""
    with_kind = functools.partial(re.sub, r"\bnumber\b", "float" if single else "double")
    return [with_kind(text) for text in _functions(spec, members, single)]


def _functions(spec: KernelSpec, members: int, single: bool) -> list[str]:
    """Return the functions; the type of most numbers is called `number` there, counters are doubles always."""
    size = spec.sizes
    estimator = estimators.load_estimator(spec.estimator)
    steps = SampleSteps(spec, estimator, single_lane=True)

    def update(s: CRows, h: CRows, v: CRows, shadow: CRows, e: CRows, extra: Any = None) -> None:
        steps.update_estimate(CRows(s.printer, "c"), s, h, v, shadow, e, extra)

    made = [_begin_filters(steps, single), _advance_filters(steps, single)]
    made.append(_function("reset_noise", STATE, steps.reset_noise, single))
    private = () if size.steady else ("double *extra",)
    made.append(_function("update_estimate", (*STATE, *REGRESSORS, "number *e", *private), update, single))
    if size.shadow:
        made.append(_function("begin_evaluation", STATE, steps.begin_evaluation, single))
    if size.watched:
        made += [] if spec.sums else [_store_residual(steps, single)]
        made.append(_update_cusums(spec, members, single))
        made.append(_end_evaluation(steps, single) if spec.sums else _update_alarm(steps, single))
    return [*made, _evaluate(spec, single)]


def _function(
    name: str,
    parameters: tuple[str, ...],
    body: Callable[..., Any],
    single: bool,
    places: Mapping[str, dict[int, str]] | None = None,
    extra: Callable[[CPrinter], tuple[Any, ...]] = lambda printer: (),
) -> str:
    """Return a function of C: `body` is called with one array per parameter that is a pointer, and with `extra`."""
    printer = CPrinter(single)
    rows = [
        CRows(printer, name, wide="double" in kind)
        for kind, star, name in (parameter.partition("*") for parameter in parameters)
        if star
    ]
    rows += [CRows(printer, "", place) for place in (places or {}).values()]
    body(*rows, *extra(printer))
    for row in rows:
        row.flush()
    return format_function(f"static void {name}", parameters, [*printer.declarations(), *printer.lines()])


def format_function(head: str, parameters: tuple[str, ...], lines: list[str]) -> str:
    """Return the text of a function; parameters that it does not use are said to be unused."""
    text = "\n".join(f"    {line}" for line in lines)
    names = [parameter.replace("*", " ").split()[-1] for parameter in parameters]
    words = set(text.replace("[", " ").replace(";", " ").replace("(", " ").replace(")", " ").split())
    unused = "".join(f"    (void){name};\n" for name in names if name not in words)
    return f"{head}({', '.join(parameters)})\n{{\n{unused}{text}\n}}"


def _begin_filters(steps: SampleSteps, single: bool) -> str:
    def body(s: CRows, h: CRows, tile: CRows) -> None:
        steps.begin_filters(CRows(s.printer, "c"), s, h, tile, 0)

    return _function("begin_filters", (*STATE, *SAMPLE_PARAMETERS), body, single, {"tile": SAMPLE})


def _advance_filters(steps: SampleSteps, single: bool) -> str:
    def body(s: CRows, h: CRows, v: CRows, shadow: CRows, status: CRows, tile: CRows, due: Any) -> None:
        steps.advance_filters(CRows(s.printer, "c"), s, h, status, v, shadow, tile, 0, due)

    parameters = (*STATE, *REGRESSORS, "double *status", *SAMPLE_PARAMETERS, "int due")
    return _function(
        "advance_filters", parameters, body, single, {"tile": SAMPLE}, lambda printer: (printer.condition("due"),)
    )


def _store_residual(steps: SampleSteps, single: bool) -> str:
    def body(s: CRows, h: CRows, status: CRows, e: CRows, w: CRows, when: CRows) -> None:
        steps.store_residual(CRows(s.printer, "c"), s, h, status, e, w, when, 0)

    return _function(
        "store_residual", (*STATE, "double *status", "number *e", "number *w", "double *when"), body, single
    )


def _update_cusums(spec: KernelSpec, members: int, single: bool) -> str:
    """Return the loop over the CUSUMs; those that only fill up a vector stay at zero and are left out."""
    printer, columns, watched, tail = CPrinter(single), spec.columns, spec.sizes.watched, dict(spec.at)["tail"]
    table = [printer.read(f"c[{tail + watched * k} + j]") for k in range(spec.sums or columns + 1)]
    observed = [printer.read(f"w[{k}]") for k in range(spec.sums or columns + 1)]
    if spec.sums:
        new = update_cusum_by_sums(table, observed, printer.read("g[j]"))
    else:
        new = update_cusum(table[:-1], observed[:-1], observed[-1], printer.read("g[j]"), table[-1])
    printer.store(new.kind, new.text, "g[j]")
    printer.store(new.kind, new.text, "level")
    inside = printer.lines()
    lines = [
        f"number top = {c_literal(0.0, single)};",
        "number level;",
        "int j;",
        f"for (j = 0; j < {members}; j++) {{",
        *(f"    {line}" for line in inside),
        "    top = (top > level) ? top : level;",
        "}",
        "return top;",
    ]
    return format_function("static number update_cusums", ("number *g", "const number *w"), lines)


def _update_alarm(steps: SampleSteps, single: bool) -> str:
    def body(s: CRows, h: CRows, top: CRows, when: CRows) -> None:
        steps.update_alarm(s, h, top, when, 0)

    return _function("update_alarm", (*STATE, "number *top", "double *when"), body, single)


def _end_evaluation(steps: SampleSteps, single: bool) -> str:
    return _function("end_evaluation", (*STATE, "number *top"), steps.end_evaluation, single)


def evaluation_places(n: int, frequencies: int) -> dict[int, str]:
    """Return the member of the evaluation's struct at which each number of a row stands."""
    names = ["updates", "statistic", "level", "crossed_s", *(f"theta[{i}]" for i in range(n))]
    names += [f"covariance[{i}]" for i in range(n * n)]
    parts = ("real", "imag", "variance_real", "covariance", "covariance_again", "variance_imag")
    names += [f"response[{f}].{part}" for f in range(frequencies) for part in parts]
    return {i: f"q->{name}" for i, name in enumerate(names)}


def _evaluate(spec: KernelSpec, single: bool) -> str:
    steps, size = EvaluationSteps(spec), spec.sizes

    def body(s: CRows, h: CRows, q: CRows) -> None:
        c = CRows(s.printer, "c")
        steps.write_evaluation(c, s, h, q)
        for f in range(size.frequencies):
            steps.write_response(c, s, f, q)

    text = _function(
        "evaluate",
        ("const number *s", "const double *h"),
        body,
        single,
        {"q": evaluation_places(size.n, size.frequencies)},
    )
    return text.replace("const double *h)", "const double *h, @evaluation@ *q)", 1)
