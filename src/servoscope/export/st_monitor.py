"""The monitor of one baseline as a function block of Structured Text (IEC 61131-3)."""

from __future__ import annotations

from pathlib import Path

from servoscope.baseline.baseline import Baseline
from servoscope.core.files import atomic_write, make_folder
from servoscope.estimation.kernel.sample_steps import HEADER_SIZE
from servoscope.export.c_monitor import NAME
from servoscope.export.constants import ExportConstants, check_name, common_words, refuse_covariates
from servoscope.export.steps_st import step_texts, temporaries
from servoscope.export.texts import fill_template

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
