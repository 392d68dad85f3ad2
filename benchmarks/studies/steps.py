"""Draw the figures of docs/explanation/how-it-works.md from the files of the demonstration.

    servoscope demo -o demo-output
    python benchmarks studies/steps demo-output [-o docs/images/steps]

The demonstration has fixed seeds, so that each run draws the same figures.
"""

from __future__ import annotations

import argparse
import csv
import json
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pyarrow.parquet as pq
from matplotlib.figure import Figure

from servoscope.report.plotting import COLOURS, STYLE

FAULT_S = 30.0  # of the demonstration
SIGNALS = (("r", "reference r [m]"), ("u", "control input u [A]"), ("y", "output y [m]"))


def read_log(path: Path) -> dict[str, np.ndarray[Any, np.dtype[np.float64]]]:
    """Return the numeric columns of a log by their headings."""
    with path.open(encoding="utf-8", newline="") as file:
        heading, *rows = csv.reader(line for line in file if not line.startswith("#"))
    return {name: np.array([float(row[i]) for row in rows]) for i, name in enumerate(heading)}


def draw_signals(log: dict[str, Any]) -> Figure:
    """Draw r, u and y around the fault: nothing can be seen."""
    figure, axes = plt.subplots(3, 1, figsize=(7, 3.6), sharex=True, layout="constrained")
    t = log["t"]
    shown = (t > FAULT_S - 5) & (t < FAULT_S + 5)
    for axis, (name, label) in zip(axes, SIGNALS, strict=True):
        axis.plot(t[shown], log[name][shown])
        axis.axvline(FAULT_S, color=COLOURS["muted"], linestyle=":")
        axis.set_ylabel(label)
    axes[-1].set_xlabel("time [s]")
    return figure


def draw_estimate(trace: dict[str, Any], healthy: float) -> Figure:
    """Draw theta_0 over time beside its healthy value, and beside it value by leakage."""
    figure, axis = plt.subplots(figsize=(7, 2.2), layout="constrained")
    axis.plot(trace["t"], trace["theta_0"], label="estimate")
    axis.axhline(healthy, color=COLOURS["muted"], linestyle="--", label="healthy")
    axis.axhline(1.2 * healthy, color=COLOURS["muted"], linestyle=":", label="1.2 times healthy")
    axis.set(xlabel="time [s]", ylabel="theta_0 [A/m]", ylim=(0.9 * healthy, 1.3 * healthy))
    axis.legend(loc="center left")
    return figure


def draw_statistic(trace: dict[str, Any]) -> Figure:
    """Draw T^2 and the sequential test, each in units of its limit."""
    figure, axis = plt.subplots(figsize=(7, 2.2), layout="constrained")
    axis.semilogy(trace["t"], trace["statistic"] / trace["threshold"], label="T^2")
    axis.semilogy(trace["t"], np.maximum(trace["level"], 1e-3), label="sequential test")
    axis.axhline(1.0, color=COLOURS["muted"], linestyle="--")
    axis.set(xlabel="time [s]", ylabel="share of the limit", ylim=(1e-3, 1e4))
    axis.legend(loc="upper left")
    return figure


def draw_response(trace: dict[str, Any]) -> Figure:
    """Draw the iFRF at 1 Hz in the complex plane, before and after the fault."""
    figure, axis = plt.subplots(figsize=(4.2, 3.2), layout="constrained")
    for label, begin, end in (("healthy", 15.0, FAULT_S), ("after the fault", 45.0, 60.0)):
        shown = (trace["t"] >= begin) & (trace["t"] < end)
        axis.plot(trace["ifrf_1Hz_real"][shown], trace["ifrf_1Hz_imag"][shown], ".", markersize=3, label=label)
    axis.set(xlabel="Re H(1 Hz) [A/m]", ylabel="Im H(1 Hz) [A/m]")
    axis.legend()
    return figure


def main() -> None:
    """Draw all figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="what `servoscope demo` wrote")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/images/steps"))
    given = parser.parse_args()
    table = pq.read_table(given.folder / "trace.parquet")
    trace = {name: table[name].to_numpy() for name in table.column_names}
    diagnosis = json.loads((given.folder / "diagnosis.json").read_text(encoding="utf-8"))
    changes = next(reason for reason in diagnosis["reasons"] if reason["key"] == "diagnosis.coefficients")
    expected = changes["values"]["changes"][0]["values"]["expected"]
    given.output.mkdir(parents=True, exist_ok=True)
    with plt.rc_context(STYLE):
        for name, figure in (
            ("signals", draw_signals(read_log(given.folder / "suspect.csv"))),
            ("estimate", draw_estimate(trace, expected)),
            ("statistic", draw_statistic(trace)),
            ("response", draw_response(trace)),
        ):
            figure.savefig(given.output / f"{name}.png", dpi=130, facecolor="white", metadata={"Software": None})
