"""The monitor of one baseline as C99: source, header, self-test with golden samples, Makefile."""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from typing import Any

from servoscope.baseline.baseline import Baseline
from servoscope.core.arrays import FloatArray
from servoscope.core.files import atomic_write, exclusive_folder
from servoscope.core.jit.c_source import CPrinter, c_literal
from servoscope.estimation.kernel.sample_steps import HEADER_SIZE, TILE
from servoscope.estimation.kernel.spec import KernelSpec
from servoscope.export.constants import ExportConstants, check_name, common_words, covariate_tables
from servoscope.export.golden import GoldenRun, describe_rounding, golden_words
from servoscope.export.image import pack_image
from servoscope.export.steps import StepTracer, evaluation_names
from servoscope.export.texts import fill_template
from servoscope.signals.quality import QualitySettings
from servoscope.signals.quality import kernel as quality

NAME = "servo_monitor"
SIGNAL_BYTES = 2 * 4 + 4 * 4 + 3 * 8 + 8 * (2 + 3 + 3 + 1 + 16 + 4 * 2)  # of the struct `signals` in monitor.h
UNSEEN_MOTION = (
    "Under motions that the healthy recordings do not hold an alarm may be no fault: the server looks at that."
)


NUMBERS = {  # how sources write most numbers, by whether they are of single precision
    False: {
        "number": "double",
        "bits": "uint64_t",
        "fabs": "fabs",
        "max_physical": "1e100",
        "zero": "0.0",
        "one": "1.0",
    },
    True: {
        "number": "float",
        "bits": "uint32_t",
        "fabs": "fabsf",
        "max_physical": "HUGE_VALF",
        "zero": "0.0f",
        "one": "1.0f",
    },
}
SIGNALS_OF_TILE = {0: "r", TILE: "u", 2 * TILE: "y", 3 * TILE: "restart"}
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


@dataclass(frozen=True)
class CMonitor:
    """The files of an exported monitor, by name, and how large its state and constants are [bytes]."""

    files: dict[str, str]
    mark: bytes  # of the baseline, in images
    state_bytes: int
    constant_bytes: int
    signal_bytes: int  # of what the check for frozen signals knows; not part of the state

    def save(self, folder: str | Path) -> tuple[Path, ...]:
        """Write the files into a folder, which is made if there is none; return their paths.

        Raises
        ------
        OutputError
            If they cannot be written.
        """
        with exclusive_folder(Path(folder)):
            for name, text in self.files.items():
                atomic_write(Path(folder) / name, text.encode())
        return tuple(Path(folder) / name for name in self.files)


def export_c(
    baseline: Baseline, name: str = NAME, *, only_coefficients: bool = False, single: bool = False
) -> CMonitor:
    """Return the monitor of a baseline as C99 that computes the same bits as `Monitor.run`.

    Parameters
    ----------
    baseline
        Of one operating point.
    name
        What the names in the source and the files begin with.
    only_coefficients
        Leave out the sequential test, and the stages that u goes through before the filters: the caller hands u over as
        it is behind them.
    single
        Compute in single precision, with the bits of ``Monitor(baseline, precision="single")``.

    Raises
    ------
    BaselineError
        If the baseline has something that cannot be exported; the message names it.
    """
    check_name(name)
    made = ExportConstants.from_baseline(baseline, only_coefficients, single)
    golden = GoldenRun.from_baseline(made)
    tables = covariate_tables(made)
    values: dict[str, Any] = common_words(made, name) | NUMBERS[single] | _byte_counts(made, tables, single)
    values |= {
        "single": single,
        "tables": tables,
        "start": made.start[HEADER_SIZE:],
        "header": HEADER_SIZE,
        "places": state_places(made.spec),
        "covariate_place": made.recursion.size - HEADER_SIZE,
        "sections": _table_sections(made),
        "functions": [
            text.replace("@evaluation@", f"{name}_evaluation")
            for text in step_functions(made.spec, made.members, single)
        ],
        "limits": QualitySettings().limits(baseline.loop.sample_rate),
        "quality": quality,
        "left_out": _left_out(baseline, only_coefficients),
        "rounding": describe_rounding(made, only_coefficients, golden) if single else "",
        "image": pack_image(made.mark, golden.state, *golden.alarm),
        **golden_words(golden),
    }
    named = {
        "monitor.c": f"{name}.c",
        "monitor.h": f"{name}.h",
        "check.c": "check.c",
        "Makefile": "Makefile",
        "golden.h": f"{name}_golden.h",
    }
    texts = {file: fill_template(template, **values) for template, file in named.items()}
    return CMonitor(texts, made.mark, values["state_bytes"], values["constant_bytes"], SIGNAL_BYTES)


def _left_out(baseline: Baseline, only_coefficients: bool) -> str:
    """Return what the header says of the monitor on the server that this one does not have."""
    sentences = []
    if only_coefficients:
        features = " and no features" * (baseline.features is not None)
        sentences.append(f"Only coefficients: there is no sequential test{features}.")
    if baseline.limited_motion is not None:
        sentences.append(UNSEEN_MOTION)
    return "".join(f"\n * {sentence}" for sentence in sentences)


def _byte_counts(made: ExportConstants, tables: dict[str, FloatArray], single: bool) -> dict[str, int]:
    number, F, n = 4 if single else 8, made.spec.sizes.frequencies, made.spec.sizes.n
    constants = number * (len(made.table) + 2 * F + 1) + 8 * F + len(made.mark)
    if made.covariates is not None:
        constants += 8 * sum(table.size for table in tables.values()) + 4 * (len(made.covariates.model.names) + n)
    return {
        "constant_bytes": constants,
        "state_bytes": 8 * (HEADER_SIZE + 2 + -(-(len(made.start) - HEADER_SIZE) * number // 8)),
        "image_bytes": len(pack_image(made.mark, made.start, 0.0, 0.0)),
    }


def _table_sections(made: ExportConstants) -> list[tuple[int, int, str]]:
    """Return begin, end and name of each part of the table of constants."""
    edges = sorted((place, name) for name, place in dict(made.spec.at).items() if name != "end")
    parts = pairwise([*edges, (len(made.table), "")])
    return [(begin, end, name) for (begin, name), (end, _) in parts if begin < end]


def step_functions(spec: KernelSpec, members: int, single: bool = False) -> list[str]:
    """Return the functions that a sample goes through; `members` is the number of CUSUMs."""
    responses = (f"response[{f}].{part}" for f, part in product(range(spec.sizes.frequencies), RESPONSE))
    evaluation = {i: f"q->{name}" for i, name in evaluation_names(spec.sizes.n, responses).items()}
    state = {i: f"s[{name}]" for i, name in state_places(spec).items()}
    places = {"tile": SIGNALS_OF_TILE, "s": state, "q": evaluation}
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
