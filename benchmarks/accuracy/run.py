"""Run scenarios of accuracy in parallel, keep their results as JSON, and render them into RESULTS.md beside it.

    python benchmarks accuracy/run [ID ...] [--list] [--workers N] [--share 0.1] [--render]

Without an ID all of them run; an ID may be the beginning of several, as "bias/" or "coverage". --render writes the
tables and figures from the results that are there; together with IDs or --share, after running them.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import re
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

BENCHMARKS = Path(__file__).resolve().parent.parent
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # one thread per worker

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn  # noqa: E402
from tables import machine  # noqa: E402

from accuracy import (  # noqa: E402
    alarms,
    bias,
    confidence,
    delay,
    isolation,
    mixed,
    motion,
    noisy_output,
    onset,
    own_past,
    pairs,
    second_rig,
    signal_defects,
    sizes,
    smooth,
    timelines,
    unknown,
    wrong_file,
)
from accuracy.scenario import Numbers, Scenario, Table  # noqa: E402
from servoscope.core.files import atomic_write  # noqa: E402

RESULTS = BENCHMARKS / "accuracy" / "results"
DOCS = BENCHMARKS.parent / "docs"
PAGE, IMAGES = BENCHMARKS / "accuracy" / "RESULTS.md", DOCS / "images" / "accuracy"
TABLES: tuple[Table, ...] = (
    *(*bias.TABLES, *confidence.TABLES, *alarms.TABLES, *delay.TABLES),
    *(*isolation.TABLES, *unknown.TABLES, *pairs.TABLES, *sizes.TABLES, *onset.TABLES, *timelines.TABLES),
    *(*own_past.TABLES, *smooth.TABLES, *second_rig.TABLES, *wrong_file.TABLES, *noisy_output.TABLES),
    *(*signal_defects.TABLES, *motion.TABLES, *mixed.TABLES),
)
SCENARIOS = {scenario.id: scenario for table in TABLES for scenario in table.scenarios}


def run(chosen: Sequence[Scenario], share: float, workers: int) -> None:
    """Run scenarios one after the other, each in units of work spread over processes, and keep their results."""
    units = {scenario.id: max(1, math.ceil(share * scenario.units)) for scenario in chosen}
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    context = multiprocessing.get_context("spawn")  # numba and its threads do not survive a fork
    with Progress(*columns) as progress, ProcessPoolExecutor(workers, context) as pool:
        everything = progress.add_task("all", total=sum(units.values()))
        for scenario in chosen:
            start = time.perf_counter()
            progress.update(everything, description=scenario.id)
            waiting = {pool.submit(scenario.run, seed): seed for seed in range(units[scenario.id])}
            found: dict[int, Numbers] = {}
            for future in as_completed(waiting):
                found[waiting[future]] = future.result()
                progress.advance(everything)
                # after each unit: what was measured until a run is stopped counts
                keep(scenario, share, workers, time.perf_counter() - start, [found[seed] for seed in sorted(found)])


def keep(scenario: Scenario, share: float, workers: int, seconds: float, found: Sequence[Numbers]) -> None:
    """Write the results of a scenario."""
    said = {
        "id": scenario.id,
        "machine": machine(),
        "settings": {
            "arguments": [repr(argument) for argument in scenario.arguments],
            "share": share,
            "units": len(found),
            "of": scenario.units,
            "workers": workers,
        },
        "seconds": round(seconds, 1),
        "numbers": found,
    }
    path = path_of(scenario)
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, (json.dumps(said) + "\n").encode())


def path_of(scenario: Scenario) -> Path:
    """Return the file of a scenario's results."""
    return RESULTS / f"{scenario.id}.json"


def stored_results() -> dict[str, Any]:
    """Return the results that are there, by scenario."""
    return {
        id_: json.loads(path_of(scenario).read_text(encoding="utf-8"))
        for id_, scenario in SCENARIOS.items()
        if path_of(scenario).is_file()
    }


def render() -> None:
    """Write the tables of all results between their markers on the page, and the figures."""
    results = stored_results()
    page = PAGE.read_text(encoding="utf-8")
    for table in TABLES:
        begin, end = f"<!-- {table.key} -->", f"<!-- end of {table.key} -->"
        marked = re.compile(f"{re.escape(begin)}.*?{re.escape(end)}", re.DOTALL)
        if not marked.search(page):
            sys.exit(f"{PAGE}: markers {begin} and {end} are missing")
        made = f"{begin}\n\n{markdown(table, results)}\n\n{end}"
        page = marked.sub(lambda _, made=made: made, page)
    atomic_write(PAGE, page.encode())
    numbers = {id_: result["numbers"] for id_, result in results.items()}
    delay.figure(numbers, IMAGES / "delay.png")
    isolation.figure(numbers, IMAGES / "reliability.png")


def markdown(table: Table, results: dict[str, Any]) -> str:
    """Return a table of those scenarios that have results, and on what they were measured."""
    there = [scenario for scenario in table.scenarios if scenario.id in results]
    if not there:
        return "Not measured yet."
    lines = [table.columns, ("---",) * len(table.columns)]
    lines += [row for each in there for row in each.rows(each.words, results[each.id]["numbers"])]
    body = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    done = [results[each.id]["settings"] for each in there]
    reduced = [one for one in done if one["units"] < one["of"]]
    fewest, most = (f(one["units"] / one["of"] for one in reduced or [{"units": 1, "of": 1}]) for f in (min, max))
    share = f"{100 * fewest:.0f}" if fewest == most else f"{100 * fewest:.0f} to {100 * most:.0f}"
    words = f" **Reduced: {share} % of the runs, in {len(reduced)} of {len(done)} rows.**" if reduced else ""
    machines = sorted({results[each.id]["machine"] for each in there})
    minutes = sum(results[each.id]["seconds"] * results[each.id]["settings"]["workers"] for each in there) / 60.0
    return f"{body}\n\n{'; '.join(machines)}; {minutes:.2g} core minutes.{words}"


def main() -> None:
    """Run the command line of this process."""
    command = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    command.add_argument("ids", nargs="*", metavar="ID", help="scenario, or the beginning of several; default: all")
    command.add_argument("--list", action="store_true", help="list the scenarios and stop")
    command.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")
    command.add_argument("--share", type=float, help="run this share of the units of each, 0 to 1")
    command.add_argument("--render", action="store_true", help="write RESULTS.md from the results")
    given = command.parse_args()
    chosen = [scenario for id_, scenario in SCENARIOS.items() if not given.ids or id_.startswith(tuple(given.ids))]
    if not chosen:
        command.error(f"{' '.join(given.ids)}: no such scenario, see --list")
    if given.share is not None and not 0.0 < given.share <= 1.0:
        command.error(f"--share {given.share:g}: must be above 0 and at most 1")
    if given.list:
        print("\n".join(f"{each.id}  {each.words}, {each.units} units" for each in chosen))
        return
    if given.ids or given.share is not None or not given.render:
        run(chosen, given.share or 1.0, given.workers)
    if given.render:
        render()
