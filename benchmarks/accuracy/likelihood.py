"""Coefficients of polynomial plants under noise in y: the instrument against the likelihood; prints a Markdown table.

python benchmarks accuracy/likelihood [--json]
"""

from __future__ import annotations

import numpy as np
from tables import Table, parser, show

import servoscope as ss
from accuracy.noisy_output import RATE, TRUE, drive
from servoscope.core.arrays import FloatArray
from servoscope.fit.instrumental_fit import fit_with_instrument
from servoscope.learning.inspection.delay_fit import COEFFICIENT_LOG_STD, DelaySearch
from servoscope.learning.recursion import tune_pipeline

RUNS = 4  # recordings of three minutes per row
LEVELS_DB = (20.0, 10.0)  # rms of y over that of its noise
COLOUR_S = 0.1  # time constant of coloured noise
SOURCES = {"input": "u is the command", "reference": "closed loop"}
MOTIONS = {"random": "random motion", "moves": "moves of least jerk"}


def errors(recorded: ss.Recording, source: str) -> FloatArray:
    """Return the relative errors of least squares, the instrument and the likelihood, shape (3, n); NaN: refused."""
    plant = {"kind": "polynomial", "order": 2, "stiffness": source == "input"}
    monitor = {"cutoff": 3.0, "memory": 20.0, "estimator": "akf"}
    loop = ss.Loop.from_dict({"sample_rate": RATE, "plant": plant, "monitor": monitor})
    true, found = np.array(TRUE[source]), np.full((3, len(TRUE[source])), np.nan)
    pipeline, _, squares = tune_pipeline(loop, [recorded])
    found[0] = squares.tuning.theta[: len(true)]
    instrumental = fit_with_instrument(pipeline, [recorded], source, squares.tuning.theta)
    if instrumental is not None and instrumental.trusted:
        found[1] = instrumental.fit.tuning.theta[: len(true)]
    begin = np.maximum(found[0], 1e-3)
    coefficients = dict(zip(pipeline.bank.names, begin.tolist(), strict=True))
    start = loop.plant.model_copy(update={"coefficients": coefficients})
    search = DelaySearch.from_recording(loop, recorded, start, COEFFICIENT_LOG_STD)
    if search is not None:
        with np.errstate(all="ignore"):
            found[2] = begin * np.exp(search._fit(search.recorded.start(delay=0.0), held=True).x[: len(true)])
    return np.asarray(found / true - 1.0)


def main() -> None:
    """Run the command line of this process."""
    given, rows = parser(__doc__).parse_args(), []
    for source, loop_words in SOURCES.items():
        for kind, motion_words in MOTIONS.items():
            for level in LEVELS_DB:
                for coloured in (False, True):
                    runs = [
                        errors(drive(2_000_000 + i, source, level, kind, COLOUR_S * coloured), source)
                        for i in range(RUNS)
                    ]
                    rms = 100.0 * np.sqrt(np.mean(np.square(runs), axis=0))  # of all coefficients, the worst one
                    cells = ["refused" if np.isnan(each).any() else f"{each.max():.2g} %" for each in rms]
                    colour = "coloured" if coloured else "white"
                    rows.append((loop_words, motion_words, f"{level:g} dB, {colour}", *cells))
    note = (
        f"Root mean square error of the worst coefficient, {RUNS} recordings of three minutes; "
        f"coloured: a time constant of {COLOUR_S:g} s. Refused: for one recording at least."
    )
    columns = ("loop", "motion", "noise", "least squares", "instrument", "likelihood")
    show([Table("Instrument and likelihood", note, columns, tuple(rows))], given.json)
