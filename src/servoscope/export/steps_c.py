"""The steps of one sample and of an evaluation as functions of C."""

from __future__ import annotations

import functools
import re
from itertools import pairwise, product

from servoscope.core.jit.c_source import CPrinter, c_literal
from servoscope.estimation.kernel.sample_steps import TILE
from servoscope.estimation.kernel.spec import KernelSpec
from servoscope.export.steps import StepTracer, evaluation_names

__all__ = ["state_places", "step_functions"]

SAMPLE = {0: "r", TILE: "u", 2 * TILE: "y", 3 * TILE: "restart"}
RESPONSE = ("real", "imag", "variance_real", "covariance", "covariance_again", "variance_imag")
STATE, SIGNALS = "number *s, double *h", "number r, number u, number y, double restart"
PARAMETERS = {  # of each function; most numbers are of the type `number`, counters are doubles always
    "begin_filters": f"{STATE}, {SIGNALS}",
    "advance_filters": f"{STATE}, number *v, number *shadow, double *status, {SIGNALS}, int due",
    "reset_noise": STATE,
    "update_estimate": f"{STATE}, number *v, number *shadow, number *e",
    "begin_evaluation": STATE,
    "store_residual": f"{STATE}, double *status, number *e, number *w, double *when",
    "update_alarm": f"{STATE}, number *top, double *when",
    "end_evaluation": f"{STATE}, number *top",
    "evaluate": "const number *s, const double *h, @evaluation@ *q",
}


def step_functions(spec: KernelSpec, members: int, single: bool = False) -> list[str]:
    """Return the functions that a sample goes through; `members` is the number of CUSUMs."""
    responses = (f"response[{f}].{part}" for f, part in product(range(spec.sizes.frequencies), RESPONSE))
    evaluation = {i: f"q->{name}" for i, name in evaluation_names(spec.sizes.n, responses).items()}
    state = {i: f"s[{name}]" for i, name in state_places(spec).items()}
    places = {"tile": SAMPLE, "s": state, "q": evaluation}
    tracer = StepTracer(spec, functools.partial(CPrinter, single), {}, places, "due")
    texts = tracer.write_steps()
    private = "" if spec.sizes.steady else ", double *extra"
    functions = [
        _format_function(f"static void {name}", parameters + private * (name == "update_estimate"), texts[name])
        for name, parameters in PARAMETERS.items()
        if name in texts
    ]
    if spec.sizes.watched:
        functions.append(_update_cusums(tracer, members, single))
    return [re.sub(r"\bnumber\b", "float" if single else "double", text) for text in functions]


def state_places(spec: KernelSpec) -> dict[int, str]:
    """Return what the places of the state are called, those of arrays as a name and a number behind it."""
    return {
        begin + k: f"AT_{name.upper()}" + f" + {k}" * (k > 0)
        for (name, begin), (_, end) in pairwise(spec.to)
        for k in range(end - begin)
    }


def _format_function(head: str, parameters: str, lines: list[str]) -> str:
    """Return the text of a function; parameters that it does not use are said to be unused."""
    text, names = "\n".join(f"    {line}" for line in lines), re.findall(r"(\w+)(?:,|$)", parameters)
    unused = "".join(f"    (void){name};\n" for name in names if not re.search(rf"\b{name}\b", text))
    return f"{head}({parameters})\n{{\n{unused}{text}\n}}"


def _update_cusums(tracer: StepTracer, members: int, single: bool) -> str:
    """Return the loop over the CUSUMs; those that only fill up a vector stay at zero and are left out."""
    lines = [
        f"number top = {c_literal(0.0, single)};",
        "number level;",
        "int j;",
        f"for (j = 0; j < {members}; j++) {{",
        *(f"    {line}" for line in tracer.write_cusum("w", "level")),
        "    top = (top > level) ? top : level;",
        "}",
        "return top;",
    ]
    return _format_function("static number update_cusums", "number *g, const number *w", lines)
