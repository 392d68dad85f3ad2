"""The monitor of one baseline as C99: source, header, self-test with golden samples, Makefile."""

from __future__ import annotations

import string
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from servoscope.baseline.baseline import Baseline
from servoscope.core.arrays import FloatArray
from servoscope.core.files import atomic_write, exclusive_folder
from servoscope.core.jit.c_source import c_literal
from servoscope.estimation.kernel.sample_steps import HEADER_SIZE
from servoscope.estimation.kernel.spec import KernelSpec
from servoscope.export.constants import ExportConstants, check_name, common_words, plain_text
from servoscope.export.covariates import covariate_words
from servoscope.export.golden import GoldenRun, golden_text
from servoscope.export.image import pack_image
from servoscope.export.precision import describe_rounding
from servoscope.export.steps_c import state_places, step_functions
from servoscope.signals.quality import QualitySettings
from servoscope.signals.quality import kernel as quality

__all__ = ["UNSEEN_MOTION", "CMonitor", "export_c"]

NAME = "servo_monitor"
MAX_LINE = 108
COVARIATE_TEMPLATES = "covariates", "covariates_interface"
SIGNAL_BYTES = 2 * 4 + 4 * 4 + 3 * 8 + 8 * (3 + 3 + 1 + 16 + 4 * 2)  # of the struct `signals` in monitor.h
UNSEEN_MOTION = (
    "Under motions that the healthy recordings do not hold an alarm may be no fault: the server looks at that."
)


class _Template(string.Template):
    delimiter = "@"
    braceidpattern = r"[a-z_]+"


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
    values = common_words(made, name) | _number_words(single) | _sizes(made, single) | _code(made, name, single)
    values |= _frozen_words(made) | covariate_words(made, name, values)
    values |= {text: fill_template(f"{text}.c", values) if made.covariates else "" for text in COVARIATE_TEMPLATES}
    values["frozen_functions"] = fill_template("frozen.c", values)
    values |= {
        "left_out": _left_out(baseline, only_coefficients),
        "rounding": describe_rounding(made, only_coefficients, golden) if single else "",
    }
    named = {"monitor.c": f"{name}.c", "monitor.h": f"{name}.h", "check.c": "check.c", "Makefile": "Makefile"}
    texts = {file: fill_template(template, values) for template, file in named.items()}
    image = pack_image(made.mark, golden.state, *golden.alarm)
    texts[f"{name}_golden.h"] = golden_text(golden, name, image)
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


def _sizes(made: ExportConstants, single: bool) -> dict[str, Any]:
    """Return the sizes and limits that the templates name."""
    size, (on, off), number = made.spec.sizes, made.delays, 4 if single else 8
    F = size.frequencies
    return {
        "rate": c_literal(made.baseline.loop.sample_rate),
        "n": size.n,
        "frequencies": F,
        "size": len(made.start),
        "row": size.row,
        "header": HEADER_SIZE,
        "constant_bytes": number * (len(made.table) + 2 * F + 1) + 8 * F + len(made.mark),
        "state_bytes": 8 * (HEADER_SIZE + 2 + -(-(len(made.start) - HEADER_SIZE) * number // 8)),
        "image_bytes": len(pack_image(made.mark, made.start, 0.0, off + 1.0)),
        "on_delay": on,
        "off_delay": off,
        "limit": c_literal(made.baseline.thresholds.statistic, single),
        "places": "".join(f"#define {name} {i}\n" for i, name in state_places(made.spec).items() if " " not in name)
        + f"#define CUSUMS {size.floats}\n" * bool(size.watched)
        + f"#define PRIVATE {size.floats + size.watched}\n" * (not size.steady),
    }


def _frozen_words(made: ExportConstants) -> dict[str, Any]:
    """Return the limits of the check for frozen signals, with the defaults of data quality."""
    limits = QualitySettings().limits(made.baseline.loop.sample_rate)
    shares = {"motion_share": quality.MOTION_SHARE, "motion_steps": quality.MOTION_STEPS}
    shares |= {"turn_share": quality.TURN_SHARE, "noise_levels": quality.NOISE_LEVELS}
    return {name: c_literal(share) for name, share in shares.items()} | {
        "frozen": limits.frozen,
        "window": limits.window,
        "epoch_windows": quality.EPOCH_WINDOWS,
    }


def _code(made: ExportConstants, name: str, single: bool) -> dict[str, str]:
    """Return constants and functions."""
    size, start, places = made.spec.sizes, made.start, state_places(made.spec)
    functions = "\n\n".join(step_functions(made.spec, made.members, single))
    healthy = [(c_literal(H.real, single), c_literal(H.imag, single)) for H in made.healthy.H]
    return {
        "guard": f"{name.upper()}_H",
        "units": plain_text("; ".join(f"{coefficient} [{unit}]" for coefficient, unit in made.coefficients)),
        "constants": _constant_table(made.table, dict(made.spec.at), single),
        "frequency_list": ", ".join(map(c_literal, made.baseline.loop.monitor.frequencies)),
        "healthy": ",\n".join(f"    {{{real}, {imag}}}" for real, imag in healthy),
        "fingerprint": ", ".join(f"0x{byte:02X}u" for byte in made.mark),
        "functions": functions.replace("@evaluation@", f"{name}_evaluation"),
        "locals": _locals(made.spec, single),
        "before": _before(made.recursion.constants[0].every, bool(size.shadow)),
        "update": f"update_estimate(s, h, v, shadow, e{'' if size.steady else ', &state->numbers[PRIVATE]'});",
        "after": _after(made) if size.watched else "",
        "initial": "\n".join(
            f"    state->numbers[{places.get(i, i)}] = {c_literal(number, single)};"
            for i, number in enumerate(start[HEADER_SIZE:])
            if number
        ),
    }


def fill_template(template: str, values: Mapping[str, Any]) -> str:
    """Return a template of this package with its names replaced."""
    text = files("servoscope.export").joinpath("templates", template).read_text(encoding="utf-8")
    return _Template(text).substitute(values)


def _number_words(single: bool) -> dict[str, str]:
    """Return what the templates say of the type of most numbers."""
    if single:
        number = {"number": "float", "bits": "uint32_t", "fabs": "fabsf", "max_physical": "HUGE_VALF", "zero": "0.0f"}
        return number | {"one": "1.0f"}
    number = {"number": "double", "bits": "uint64_t", "fabs": "fabs", "max_physical": "1e100", "zero": "0.0"}
    return number | {"one": "1.0"}


def _constant_table(table: FloatArray, at: dict[str, int], single: bool) -> str:
    """Return the table of constants, with the name of each group in front of it."""
    edges = sorted({(place, name) for name, place in at.items() if name != "end"})
    lines = [f"static const {'float' if single else 'double'} c[{len(table)}] = {{"]
    for k, (begin, name) in enumerate(edges):
        end = edges[k + 1][0] if k + 1 < len(edges) else len(table)
        if begin < end:
            lines += [f"    /* {begin}: {name} */", *wrapped(c_literal(number, single) for number in table[begin:end])]
    return "\n".join([*lines, "};"])


def wrapped(items: Iterable[str]) -> list[str]:
    lines, line = [], "   "
    for item in items:
        if len(line) + len(item) + 2 > MAX_LINE:
            lines.append(line)
            line = "   "
        line += f" {item},"
    return [*lines, line]


def _locals(spec: KernelSpec, single: bool) -> str:
    size, rows = spec.sizes, spec.shadow_rows
    number, zero = ("float", "0.0f") if single else ("double", "0.0")
    lines = [
        f"{number} v[{size.rows}] = {{{', '.join([zero] * size.rows)}}};",
        f"{number} shadow[{rows}] = {{{', '.join([zero] * rows)}}};",
        f"{number} e[2] = {{{zero}, {zero}}};",
    ]
    lines.append("double status[1] = {MISSING};")
    if size.watched:
        lines += [f"{number} *g = &s[CUSUMS];", f"{number} top[1];"]
        if not spec.sums:
            lines += [f"{number} w[{spec.columns + 1}];", "double when[1];"]
    return "\n".join(f"    {line}" for line in lines)


def _before(every: int, shadow: bool) -> str:
    return f"    if ((number % {every}u) == 0u) {{\n        begin_evaluation(s, h);\n    }}" if shadow else ""


def _after(made: ExportConstants) -> str:
    if made.spec.sums:
        every = made.recursion.constants[0].every
        lines = [f"if (((number + 1u) % {every}u) == 0u) {{", "    top[0] = update_cusums(g, &s[AT_SUMS]);"]
        lines += ["    end_evaluation(s, h, top);", "}"]
    else:
        lines = ["store_residual(s, h, status, e, w, when);"]
        lines += ["top[0] = update_cusums(g, w);", "update_alarm(s, h, top, when);"]
    return "\n".join(f"    {line}" for line in lines)
