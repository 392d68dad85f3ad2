"""Does the interval of the onset hold the truth? On the reference rig, and on axes that are not quite their model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

import servoscope as ss
from accuracy import motion
from accuracy.axis import AXES, moves
from accuracy.axis import record as record_axis
from accuracy.draws import KINDS, PARAMETERS, SECONDS, between, large, small, stable
from accuracy.rig import SEEDS_PER_UNIT, baseline, record
from accuracy.scenario import Numbers, Row, Scenario, Table
from accuracy.told import percent, told
from servoscope.simulation import FaultEvent

RUNS = 20  # per baseline
UNITS = 17
BEGIN = 20.0, 35.0  # s
DURATIONS = 1.0, 20.0  # s, of drifts
COVERED = 0.9, 0.99
AXIS_RUNS, AXIS_UNITS = 25, 5
AXIS_BEGIN = 10.0, 50.0  # s
AXIS_COVERED = 0.92, 0.98
OF_AXIS = ("viscous", "coulomb", "mass", "gain")
RATIO = 1.1, 2.0  # of a parameter, up or down
OUTSIDE = {"load": (5.0, 40.0), "shift": (2e-4, 2e-3)}  # N, m; sudden, of either sign


def job(seed: int, kind: str, runs: int = RUNS) -> Numbers:
    """Diagnose steps and drifts in turns, small and large, after one baseline."""
    learned, rng = baseline(kind, SECONDS, seed), np.random.default_rng(seed)
    said = []
    for i in range(runs):
        fault = drawn(rng, kind, is_small=bool(i // 2 % 2), drifts=bool(i % 2))
        run = told(learned, record(kind, SECONDS, seed, 1 + i, (fault,)), [fault])
        said.append(run | {"begin": round(fault.at_s, 3), "over": round(fault.ramp_s, 3), "small": bool(i // 2 % 2)})
    return {"runs": said}


def axis_job(unit: int, name: str, runs: int = AXIS_RUNS) -> Numbers:
    """Diagnose steps of a parameter, and in every fifth run of a load or of the sensor's zero, on an axis."""
    learned, rng = motion.baseline(name, unit), np.random.default_rng([unit, list(AXES).index(name)])
    said, axis = [], AXES[name]
    for i in range(runs):
        if i % 5 < 4:
            what, sign = str(rng.choice(OF_AXIS)), float(rng.choice([-1.0, 1.0]))
            value = getattr(axis, what) * between(rng, *RATIO) ** sign
        else:
            what = list(OUTSIDE)[i // 5 % 2]
            value = between(rng, *OUTSIDE[what]) * float(rng.choice([-1.0, 1.0]))
        begin, seed = float(rng.uniform(*AXIS_BEGIN)), SEEDS_PER_UNIT * unit + 100 + i
        recording = record_axis(axis, moves(seed), seed, replace(axis, **{what: value}), begin)
        found = ss.diagnose(learned, recording).intervals
        run = {"what": what, "value": round(value, 5), "begin": round(begin, 3)}
        if found and found[0].onset_s is not None:
            run |= {"onset": [round(t, 3) for t in found[0].onset_s], "detected": found[0].detected_at_s}
        said.append(run)
    return {"runs": said}


def covered_on_axis(words: str, found: Sequence[Numbers]) -> list[Row]:
    """Show coverage and width of the intervals, of parameters and of what is none."""
    every = [run for unit in found for run in unit["runs"]]
    rows = []
    for how, names in (("parameters", OF_AXIS), ("load", ("load",)), ("zero of the sensor", ("shift",))):
        runs = [run for run in every if run["what"] in names]
        seen = [run for run in runs if "onset" in run and (run["detected"] or 0.0) >= run["begin"]]
        cells = _cells(seen, AXIS_COVERED if how == "parameters" else (0.0, 1.0)) if seen else ("",) * 4
        rows.append((words, how, f"{len(seen)} of {len(runs)}", *cells))
    return rows


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


def _cells(runs: Sequence[Numbers], target: tuple[float, float] = COVERED) -> Row:
    low, likely, high, begin = np.array([[*run["onset"], run["begin"]] for run in runs]).T
    inside = (low <= begin) & (begin <= high)
    late = f"{100 * np.mean(begin < low):.1f}, {100 * np.mean(begin > high):.1f}"
    error = np.abs(likely - begin)
    return (
        percent(int(inside.sum()), len(runs), *target),
        late,
        f"{np.median(high - low):.2f}",
        f"{np.median(error):.2f}, {np.quantile(error, 0.9):.2f}",
    )


COLUMNS = ("detected", "in the interval", "before, after [%]", "width [s]", "error: median, 90 % [s]")
TABLES = (
    Table(
        "onset",
        ("reference", "changes", *COLUMNS),
        tuple(Scenario(f"onset/{kind}", kind, UNITS, job, (kind,), covered) for kind in KINDS),
    ),
    Table(
        "onset-axes",
        ("axis", "change", *COLUMNS),
        tuple(
            Scenario(f"onset-axes/{name}", motion.AXIS_WORDS[name], AXIS_UNITS, axis_job, (name,), covered_on_axis)
            for name in AXES
        ),
    ),
)
