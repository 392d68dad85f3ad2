"""A step within one recording behind days that scatter: found as with a baseline of that day alone, or not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

import servoscope as ss
from accuracy.draws import SECONDS
from accuracy.rig import loop, record
from accuracy.scenario import Numbers, Row, Scenario, Table
from accuracy.told import percent
from servoscope.simulation import FaultEvent

KINDS = ("multisine", "profile", "trapezoid")
PARAMETER, NAME = "C_ie", "leakage"
DAYS, SCATTER = 4, 0.04  # recordings of the baseline; standard deviation of the logarithm of the parameter between them
STEPS = (1.0, 1.1, 1.2, 1.3)  # ratios within a recording; 1 is healthy
BEGIN = 25.0, 45.0  # s
UNITS = 40


def job(seed: int) -> Numbers:
    """Learn four days, and judge a recording of a further day for each step, beside a baseline of that day alone."""
    kind, rng = KINDS[seed % len(KINDS)], np.random.default_rng(seed)
    days = np.exp(SCATTER * rng.standard_normal(DAYS + 1)).tolist()
    *healthy, today = [record(kind, SECONDS, seed, i, of_day(day)) for i, day in enumerate(days)]
    several, alone = ss.learn(loop(), healthy), ss.learn(loop(), [today])
    runs = []
    for i, step in enumerate(STEPS):
        begin = float(rng.uniform(*BEGIN))
        more = of_day(days[-1] * step, begin) if step != 1.0 else ()
        recording = record(kind, SECONDS, seed, DAYS + 1 + i, (*of_day(days[-1]), *more))
        runs.append({"step": step, "begin": begin} | {
            key: judged(learned, recording, begin) for key, learned in (("several", several), ("alone", alone))
        })  # fmt: skip
    return {"runs": runs}


def of_day(ratio: float, at_s: float = 0.0) -> tuple[FaultEvent, ...]:
    """Return the change that makes the parameter what it is."""
    return (FaultEvent(PARAMETER, ratio, at_s),)


def judged(learned: ss.Baseline, recording: ss.Recording, begin: float) -> Numbers:
    """Return what is said: whether it was found and when, its name, its size and whether the onset is right."""
    told = ss.diagnose(learned, recording)
    first = told.intervals[0] if told.intervals else None
    return {
        "found": told.verdict in ("suspect", "fault"),
        "name": " + ".join(fault.name for fault in told.faults),
        "sizes": [[fault.ratio, *fault.interval] for fault in told.faults],
        "dated": first is not None and first.onset_s[0] <= begin <= first.onset_s[2],
    }


def rows(words: str, found: Sequence[Numbers]) -> list[Row]:
    """Show what was found and named by each baseline, step by step."""
    shown = []
    for step in STEPS:
        runs = [run for unit in found for run in unit["runs"] if run["step"] == step]
        for key, which in (("several", "four days"), ("alone", "that day alone")):
            said = [run[key] for run in runs]
            named = [one for one in said if one["name"] == NAME]
            held = sum(one["sizes"][0][1] <= step <= one["sizes"][0][2] for one in named)
            target = (0.0, 0.0) if step == 1.0 else (0.95, 1.0)
            cells = (percent(sum(one["found"] for one in said), len(said), *target),)
            if step != 1.0:
                wrong = sum(bool(one["name"]) and one["name"] != NAME for one in said)
                dated = sum(one["dated"] for one in said if one["found"])
                cells += (
                    percent(len(named), len(said)),
                    f"{wrong}",
                    percent(held, len(named)),
                    percent(dated, sum(one["found"] for one in said)),
                )
            else:
                cells += ("", f"{sum(bool(one['name']) for one in said)}", "", "")
            shown.append((f"x {step:g}" if step != 1.0 else "healthy", which, f"{len(runs)}", *cells))
    return shown


TABLES = (
    Table(
        "own-past",
        ("step", "baseline", "runs", "found", "named right", "named wrong", "size in its 95 %", "onset in its 95 %"),
        (Scenario("own-past", f"{DAYS} days", UNITS, job, (), rows),),
    ),
)
