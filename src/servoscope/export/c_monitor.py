"""The monitor of one baseline as C99: source, header, self-test with golden samples, Makefile."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from servoscope.baseline.baseline import Baseline
from servoscope.core.arrays import FloatArray
from servoscope.core.files import atomic_write, exclusive_folder
from servoscope.estimation.kernel.sample_steps import HEADER_SIZE
from servoscope.export.constants import ExportConstants, check_name, common_words
from servoscope.export.covariates import covariate_tables
from servoscope.export.golden import GoldenRun, golden_words
from servoscope.export.image import pack_image
from servoscope.export.precision import describe_rounding
from servoscope.export.steps_c import state_places, step_functions
from servoscope.export.texts import fill_template
from servoscope.signals.quality import QualitySettings
from servoscope.signals.quality import kernel as quality

__all__ = ["UNSEEN_MOTION", "CMonitor", "export_c"]

NAME = "servo_monitor"
SIGNAL_BYTES = 2 * 4 + 4 * 4 + 3 * 8 + 8 * (3 + 3 + 1 + 16 + 4 * 2)  # of the struct `signals` in monitor.h
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
