"""Cranfield ball screw with seeded faults: servoscope beside three simple detectors, in the same run.

    python benchmarks public/cranfield [--data DIR] [--load 40] [--draws 20] [--json]

Per load, each detector learns from healthy runs 1 to 5, or from the odd ones, and judges the other five healthy runs
and all runs of all faults. Its limit comes from the healthy runs that it learned from. False: healthy runs above the
limit. Found: faulty runs above it. Rank: faulty runs above the worst healthy one, whatever the limit is. With
`--draws`, false and found are counted for random draws of five runs too.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tables import Table, parse_with_data, parser, show

import servoscope as ss
from public.servoscope_detector import COMMON, OURS, ROOT, servoscope_scores
from public.simple_detectors import detectors, judge

LOADS = ("20", "40", "-40")
FAULTS = (
    "backlash1",
    "backlash2",
    "lackLubrication1",
    "lackLubrication2",
    "spalling1",
    "spalling3",
    "spalling5",
    "spalling7",
)
RIGHT = {fault: ("friction", "lubrication") for fault in FAULTS if fault.startswith("lack")}
FOLDS = {"runs 1 to 5": (1, 2, 3, 4, 5), "odd runs": (1, 3, 5, 7, 9)}
CYCLE_S, CUTOFF_HZ = 12.96, 1.0
RUNS, LEARNED = 10, 5  # healthy runs at a load, and those that a draw takes


def runs(data: Path, loop: ss.Loop, name: str, load: str) -> list[ss.Recording]:
    """Return the runs of a file at a load."""
    folder = data / "real" / "cranfield"
    path = next(path for path in (folder / f"{name}.csv", folder / f"{name}.parquet") if path.is_file())
    return ss.read_parts(path, loop, where={"load": load}, by="run")


def draws_table(data: Path, loop: ss.Loop, loads: Sequence[str], draws: int) -> tuple[Table, dict[str, str]]:
    """Return what each detector finds where five healthy runs are drawn at random, the same at each load."""
    rng, found, false, held = np.random.default_rng(0), dict[str, list[int]](), dict[str, int](), 0
    recorded = [
        (runs(data, loop, "normal", load), [run for name in FAULTS for run in runs(data, loop, name, load)])
        for load in loads
    ]
    for draw in range(draws):
        chosen = sorted(rng.choice(RUNS, LEARNED, replace=False).tolist())
        for normal, faulty in recorded:
            healthy = [normal[k] for k in chosen]
            held_out = [run for k, run in enumerate(normal) if k not in chosen]
            held += len(held_out)
            scores = {OURS: servoscope_scores(loop, healthy, [*held_out, *faulty])}
            scores |= {d.name: judge(d, healthy, [*held_out, *faulty]) for d in detectors(CYCLE_S, CUTOFF_HZ)}
            for name, score in scores.items():
                above = [one > score.limit for one in score.largest]
                false[name] = false.get(name, 0) + sum(above[: len(held_out)])
                counts = found.setdefault(name, [0] * draws)
                counts[draw] += sum(above[len(held_out) :])
    total = sum(len(faulty) for _, faulty in recorded)
    rows = tuple(
        (name, f"{false[name]} of {held}", f"{np.median(counts):g} of {total}", f"{min(counts)} to {max(counts)}")
        for name, counts in found.items()
    )
    values = {"draws.false": rows[0][1], "draws.found": rows[0][2]}
    note = f"{draws} draws of {LEARNED} of the {RUNS} healthy runs."
    heads = ("detector", "false", "found, median", "found, range")
    return Table("Cranfield: drawn baselines", note, heads, rows), values


def main() -> None:
    """Run the command line of this process."""
    command = parser(__doc__)
    command.add_argument("--load", choices=LOADS, action="append", help="only this load [kgf]")
    command.add_argument("--draws", type=int, default=0, help="random draws of five learned runs")
    given = parse_with_data(command, "real/cranfield")
    loop, loads = ss.Loop.load(ROOT / "examples" / "cranfield.toml"), given.load or LOADS
    values: dict[str, str] = {}
    rows, faults = [], []
    told: list[tuple[str, ...]] = []
    for fold, chosen in FOLDS.items():
        counts: dict[str, list[int]] = {}
        of_fault: dict[tuple[str, str], list[int]] = {}
        named: dict[str, list[str]] = {fault: [] for fault in FAULTS}  # of the runs that were found
        for load in loads:
            normal = runs(given.data, loop, "normal", load)
            healthy = [normal[k - 1] for k in chosen]
            held_out = [run for k, run in enumerate(normal, start=1) if k not in chosen]
            faulty = [(name, run) for name in FAULTS for run in runs(given.data, loop, name, load)]
            judged = [*held_out, *(run for _, run in faulty)]
            scores = {OURS: servoscope_scores(loop, healthy, judged)}
            scores |= {one.name: judge(one, healthy, judged) for one in detectors(CYCLE_S, CUTOFF_HZ)}
            ours = scores[OURS]
            found_runs = zip(faulty, ours.largest[len(held_out) :], ours.names[len(held_out) :], strict=True)
            for (fault, _), score, cause in found_runs:
                named[fault] += [cause] if score > ours.limit else []
            for name, (limit, largest, order, common, _) in scores.items():
                normal_scores, fault_scores = largest[: len(held_out)], largest[len(held_out) :]
                false = sum(score > limit for score in normal_scores)
                found = sum(score > limit for score in fault_scores)
                places = order or largest
                ranked = sum(place > max(places[: len(held_out)]) for place in places[len(held_out) :])
                shared = limit if common is None else common
                by_common = (sum(score > shared for score in some) for some in (normal_scores, fault_scores))
                new = (false, len(held_out), found, ranked, len(faulty), *by_common)
                counts[name] = [a + b for a, b in zip(counts.get(name, [0] * len(new)), new, strict=True)]
                for (fault, _), score in zip(faulty, fault_scores, strict=True):
                    both = of_fault.setdefault((fault, name), [0, 0])
                    both[0], both[1] = both[0] + (score > limit), both[1] + 1
                if name == OURS and fold == "runs 1 to 5":
                    values[f"{load}.false"] = f"{false} of {len(held_out)}"
                    values[f"{load}.worst"] = f"{max(normal_scores) / limit:.2f}"
                    for fault in FAULTS:
                        at = [
                            score > limit for (one, _), score in zip(faulty, fault_scores, strict=True) if one == fault
                        ]
                        values[f"{load}.{fault}"] = f"{sum(at)} of {len(at)}"
        for name, (false, normal_count, found, ranked, faulty_count, *by_common) in counts.items():
            of_normal, of_faulty = f"of {normal_count}", f"of {faulty_count}"
            common = f"{by_common[0]} {of_normal}", f"{by_common[1]} {of_faulty}"
            rows.append((fold, name, f"{false} {of_normal}", f"{found} {of_faulty}", *common, f"{ranked} {of_faulty}"))
        names = list(counts)
        for fault in FAULTS:
            causes = [cause for cause in named[fault] if cause]
            wrong = [cause for cause in causes if not any(one in cause for one in RIGHT.get(fault, ()))]
            counts_of = (len(named[fault]), len(causes) - len(wrong), len(wrong), len(named[fault]) - len(causes))
            told.append((fold, fault, *map(str, counts_of)))
            faults.append((fold, fault, *("{} of {}".format(*of_fault[fault, name]) for name in names)))
    heads = ("learned from", "detector", "false", "found", *COMMON, "above the worst healthy run")
    note = (
        "Loads of 20, 40 and -40 kgf together, five healthy runs held out at each."
        if not given.load
        else (f"At {' and '.join(given.load)} kgf, five healthy runs held out.")
    )
    tables = [
        Table("Cranfield: detectors", note, heads, tuple(rows)),
        Table("Cranfield: faults", "Faulty runs above the limit.", ("learned from", "fault", *names), tuple(faults)),
        Table(
            "Cranfield: names",
            "What servoscope said of the runs that it found. Right: a friction, where lubricant lacks; no coefficient "
            "is that of a loose or a damaged screw. u is a stepper's current, which is no force: its inertia is "
            "negative.",
            ("learned from", "fault", "found", "named right", "named wrong", "unknown"),
            tuple(told),
        ),
    ]
    if given.draws:
        table, drawn = draws_table(given.data, loop, loads, given.draws)
        tables, values = [*tables, table], values | drawn
    show(tables, given.json, values)
