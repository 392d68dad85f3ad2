"""Does the interval of the onset hold the truth? Steps and drifts, small and large, at any time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from accuracy.draws import KINDS, PARAMETERS, SECONDS, between, large, small, stable
from accuracy.rig import baseline, record
from accuracy.scenario import Numbers, Row, Scenario, Table
from accuracy.told import percent, told
from servoscope.simulation import FaultEvent

RUNS = 20  # per baseline
UNITS = 17
BEGIN = 20.0, 35.0  # s
DURATIONS = 1.0, 20.0  # s, of drifts
COVERED = 0.9, 0.99


def job(seed: int, kind: str, runs: int = RUNS) -> Numbers:
    """Diagnose steps and drifts in turns, small and large, after one baseline."""
    learned, rng = baseline(kind, SECONDS, seed), np.random.default_rng(seed)
    said = []
    for i in range(runs):
        fault = drawn(rng, kind, is_small=bool(i // 2 % 2), drifts=bool(i % 2))
        run = told(learned, record(kind, SECONDS, seed, 1 + i, (fault,)), [fault])
        said.append(run | {"begin": round(fault.at_s, 3), "over": round(fault.ramp_s, 3), "small": bool(i // 2 % 2)})
    return {"runs": said}


def drawn(rng: np.random.Generator, kind: str, is_small: bool, drifts: bool) -> FaultEvent:
    """Draw a fault under which the loop stays stable."""
    while True:
        parameter = PARAMETERS[int(rng.integers(len(PARAMETERS)))]
        ratio = small(rng, kind, parameter) if is_small else large(rng, parameter)[parameter]
        fault = FaultEvent(parameter, ratio, float(rng.uniform(*BEGIN)), between(rng, *DURATIONS) if drifts else 0.0)
        if stable([fault]):
            return fault


def covered(words: str, found: Sequence[Numbers]) -> list[Row]:
    """Show coverage and width of the intervals."""
    every = [run for unit in found for run in unit["runs"] if run.get("detected", 0.0) >= run["begin"]]
    rows = []
    for how in ("steps", "drifts"):
        for size in ("small", "large"):
            runs = [
                run for run in every if (run["over"] > 0.0) == (how == "drifts") and run["small"] == (size == "small")
            ]
            if runs:
                rows.append((words, f"{size} {how}", f"{len(runs)}", *_cells(runs)))
    return [*rows, (words, "all", f"{len(every)}", *_cells(every))]


def _cells(runs: Sequence[Numbers]) -> Row:
    low, likely, high, begin = np.array([[*run["onset"], run["begin"]] for run in runs]).T
    inside = (low <= begin) & (begin <= high)
    late = f"{100 * np.mean(begin < low):.1f}, {100 * np.mean(begin > high):.1f}"
    error = np.abs(likely - begin)
    return (
        percent(int(inside.sum()), len(runs), *COVERED),
        late,
        f"{np.median(high - low):.2f}",
        f"{np.median(error):.2f}, {np.quantile(error, 0.9):.2f}",
    )


TABLES = (
    Table(
        "onset",
        (
            "reference",
            "changes",
            "detected",
            "in the interval",
            "before, after [%]",
            "width [s]",
            "error: median, 90 % [s]",
        ),
        tuple(Scenario(f"onset/{kind}", kind, UNITS, job, (kind,), covered) for kind in KINDS),
    ),
)
