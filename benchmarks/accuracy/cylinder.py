"""Faults of a hydraulic cylinder, found and named, beside simple detectors.

    python benchmarks accuracy/cylinder [--mixed] [--first SEED] [--json]

Seven healthy production days are learned, or ten of mixed motions; 32 further healthy days, sixty faults and six
changes of the process force are judged. Days, faults and sizes: `cylinder_days.py`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from public.simple_detectors import detectors, judge
from tables import Table, parser, show

import servoscope as ss
from accuracy.cylinder_days import (
    FAULTS,
    HEALTHY,
    LEARNED,
    MIXED,
    MIXED_HEALTHY,
    RATE,
    Day,
    faulty_days,
    healthy_days,
    learned_days,
    process_days,
)

WINDOW_S, CUTOFF_HZ = 10.0, 10.0
MEMORY_S = 15.0  # two cycles of production
CYLINDER = {"kind": "cylinder", "terms": ["spring", "process", "overlap", "offset"], "contact": 0.06}
PLANTS: dict[str, dict[str, object]] = {
    "cylinder": CYLINDER,
    "cylinder, oil temperature logged": CYLINDER,
    "cylinder, pressures logged": {**CYLINDER, "pressures": {"A": "p_A", "B": "p_B", "supply": "p_S"}},
}
# by fault of the rig: what a diagnosis may call it
NAMES: dict[str, set[str]] = {
    "supply": {"supply"},
    "valve, extending": {"valve_forward"},
    "valve, retracting": {"valve_backward"},
    "leakage": {"leakage"},
    "friction": {"friction"},
    "air": {"air"},
    "overlap": {"overlap"},
    "zero": {"zero"},
    "spool lag": {"lag"},
    "mass": {"lag"},
    "process": {"process_force"},
}


def loop(words: str) -> ss.Loop:
    """Return the loop file of one of `PLANTS`."""
    columns = {"covariates": {"T_oil": "T_oil"}} if "temperature" in words else {}
    return loop_with(PLANTS[words], columns)


def loop_with(plant: dict[str, object], columns: dict[str, object] | None = None) -> ss.Loop:
    """Return the loop file with a table ``[plant]`` of its own."""
    monitor = {"cutoff": CUTOFF_HZ, "memory": MEMORY_S, "frequencies": [0.5, 2.0]}
    loop = {"name": "cylinder", "sample_rate": RATE, "plant": plant, "monitor": monitor}
    return ss.Loop.from_dict({**loop, "columns": columns or {}})


def rows(
    days: Sequence[Day], found: Sequence[bool], named: Sequence[set[str]], simple: Sequence[Sequence[bool]]
) -> list[tuple[str, ...]]:
    """Return what was found and named of each kind of days."""
    kinds, made = dict.fromkeys(day.fault for day in days), []
    for kind in kinds:
        of = [k for k, day in enumerate(days) if day.fault == kind]
        right = sum(bool(named[k]) and named[k] <= NAMES.get(kind, set()) for k in of)
        wrong = sum(bool(named[k]) for k in of) - right
        told = ("", "") if not kind else (f"{right}", f"{wrong}")
        counts = [f"{sum(one[k] for k in of)}" for one in simple]
        made.append((kind or "healthy", f"{len(of)}", f"{sum(found[k] for k in of)}", *told, *counts))
    return made


def main() -> None:
    """Print the tables."""
    command = parser(__doc__)
    command.add_argument("--mixed", action="store_true", help="learn from ten days of mixed motions")
    command.add_argument("--plant", choices=PLANTS, help="judge with this plant alone")
    command.add_argument("--first", type=int, default=0, help="added to all seeds")
    given = command.parse_args()
    first = given.first
    kinds = (MIXED, MIXED_HEALTHY) if given.mixed else (("production",) * LEARNED, ("production",) * HEALTHY)
    healthy = learned_days(kinds[0], first)
    days = [*healthy_days(kinds[1], first), *faulty_days(first), *process_days(first)]
    judged = [day.recording for day in days]
    scores = [judge(one, healthy, judged) for one in detectors(WINDOW_S, CUTOFF_HZ)]
    simple = [[x > one.limit for x in one.largest] for one in scores]
    tables, values = [], {}
    for words in PLANTS:
        if given.plant not in (None, words):
            continue
        baseline = ss.learn(loop(words), healthy)
        told = [ss.diagnose(baseline, recording) for recording in judged]
        found = [one.verdict in ("suspect", "fault") for one in told]
        named = [{fault.name for fault in one.faults} for one in told]
        heads = (
            "days",
            "recordings",
            "found",
            "named right",
            "named wrong",
            *(one.name for one in detectors(1.0, 1.0)),
        )
        note = f"Learned: {len(healthy)} {'mixed' if given.mixed else 'production'} days of a minute at {RATE:g} Hz."
        tables.append(Table(f"Cylinder, plant {words}", note, heads, tuple(rows(days, found, named, simple))))
        faults = [k for k, day in enumerate(days) if day.fault in FAULTS]
        supplies = [
            (fault, days[k].size)
            for k in faults
            if days[k].fault == "supply"
            for candidate in told[k].candidates[:1]
            for fault in candidate.faults
        ]
        holds = [f.name == "supply" and f.interval[0] <= size <= f.interval[1] for f, size in supplies]
        process = [names for names, day in zip(named, days, strict=True) if day.fault == "process"]
        values |= {
            f"{words}.process": f"{sum(names == {'process_force'} for names in process)}",
            f"{words}.supply": f"{sum(holds)}",
            f"{words}.leakage": f"{sum(named[k] == {'leakage'} for k in faults if days[k].fault == 'leakage')}",
            f"{words}.false": f"{sum(x for x, day in zip(found, days, strict=True) if not day.fault)}",
            f"{words}.found": f"{sum(found[k] for k in faults)}",
            f"{words}.right": f"{sum(bool(named[k]) and named[k] <= NAMES.get(days[k].fault, set()) for k in faults)}",
        }
        print(words, values, file=sys.stderr, flush=True)
    faults = [k for k, day in enumerate(days) if day.fault in FAULTS]
    for one, hit in zip(detectors(1.0, 1.0), simple, strict=True):
        values[f"{one.name}.found"] = f"{sum(hit[k] for k in faults)}"
        values[f"{one.name}.false"] = f"{sum(x for x, day in zip(hit, days, strict=True) if not day.fault)}"
    show(tables, given.json, values)
