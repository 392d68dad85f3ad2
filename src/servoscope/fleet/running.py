"""A fleet from a lake to its report: learn, examine, know, write; whatever the engine, and after any kill."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from servoscope.errors import BaselineError
from servoscope.fleet.baselines import baseline_file
from servoscope.fleet.common import PRIOR, Prior
from servoscope.fleet.following import WINDOW
from servoscope.fleet.journal import journal
from servoscope.fleet.knowledge import Fleet, known
from servoscope.fleet.lake import Item, Lake
from servoscope.fleet.local import Engine
from servoscope.fleet.tables import KINDS, row
from servoscope.fleet.tasks import Examine, Learn
from servoscope.loop import Columns, Loop
from servoscope.output import make_folder
from servoscope.writers import write_table

__all__ = ["Plan", "Progress", "run"]

Progress = Callable[[str, int, int], None]  # what is being done, how many are, of how many


@dataclass(frozen=True)
class Plan:
    """What is to be done.

    Parameters
    ----------
    lake
        The items.
    output
        Folder for all results.
    loop
        Settings to learn with; None: `baselines` are there.
    baselines
        A baseline for all assets, or a folder with one per asset or group; None: they are learned.
    by
        ``asset``: a baseline for each; or the key of a group, whose members share one.
    healthy
        How many days of each asset are learned from, the first ones.
    columns
        Where the signals stand; None: where the loop says.
    window_s
        Seconds of raw rows that a diagnosis sees.
    learn_s
        Seconds of each healthy day that are learned from, at most.
    prior
        What is assumed of faults and common causes before looking.
    """

    lake: Lake
    output: Path
    loop: Loop | None = None
    baselines: Path | None = None
    by: str = "asset"
    healthy: int = 1
    columns: Columns | None = None
    window_s: float = WINDOW
    learn_s: float = 600.0
    prior: Prior = PRIOR

    def name_of(self, item: Item) -> str:
        """Return the asset or group whose baseline an item is compared with.

        Raises
        ------
        BaselineError
            If the item's asset is in no such group.
        """
        if self.by == "asset":
            return item.asset
        found = dict(item.groups).get(self.by)
        if found is None:
            raise BaselineError(f"asset {item.asset} has no {self.by}: name it in the folders or the table of groups")
        return found

    def made_with(self) -> dict[str, Any]:
        """Return what all results depend on."""
        return {
            "loop": self.loop.hash() if self.loop is not None else None,
            "baselines": str(self.baselines) if self.baselines is not None else None,
            "by": self.by,
            "healthy": self.healthy if self.baselines is None else None,
            "columns": self.columns.model_dump() if self.columns is not None else None,
            "window_s": self.window_s,
            "learn_s": self.learn_s if self.baselines is None else None,
        }


def run(plan: Plan, engine: Engine, progress: Progress = lambda *_: None) -> Fleet:
    """Do what is left to do and write what is known: baselines, traces, journal, diagnoses, fleet.json, report.html.

    Raises
    ------
    OutputError
        If the folder holds results of other settings, is in use, or cannot be written.
    BaselineError
        If there is neither a loop nor a baseline.
    """
    make_folder(plan.output)
    with journal(plan.output / "journal.jsonl", plan.made_with()) as finished:
        names = {item.key: plan.name_of(item) for item in plan.lake.items}
        baselines, unlearned = _learned(plan, names, engine, progress)
        assets, left = len(plan.lake.assets), []
        for item in plan.lake.items:
            if not finished.has(item):
                file = baselines[names[item.key]]
                why = unlearned.get(names[item.key], "") if file is None else ""
                trace = (
                    plan.output / "traces" / f"asset={quote(item.asset)}" / f"day={quote(item.day)}" / "trace.parquet"
                )
                left.append(Examine(item, file, why, assets, plan.columns, plan.window_s, str(trace)))
        total = len(plan.lake.items)
        progress("examining", total - len(left), total)
        for done, (task, entry) in enumerate(engine(left), start=total - len(left) + 1):
            finished.add(entry)
            progress(f"{task.key[0]} {task.key[1]}", done, total)
        entries = finished.entries()
    here = {item.key for item in plan.lake.items}
    entries = [entry for entry in entries if (entry["asset"], entry["day"]) in here]
    groups = {item.asset: dict(item.groups) for item in plan.lake.items}
    fleet = known(entries, groups, unlearned, plan.prior)
    _write(plan, fleet, entries)
    return fleet


def _learned(
    plan: Plan, names: Mapping[tuple[str, str], str], engine: Engine, progress: Progress
) -> tuple[dict[str, str | None], dict[str, str]]:
    """Return the file of each baseline, None where there is none, and what could not be learned."""
    wanted = list(dict.fromkeys(names.values()))
    if plan.baselines is not None:
        if plan.baselines.is_file():
            return dict.fromkeys(wanted, str(plan.baselines)), {}
        files = {name: baseline_file(plan.baselines, name) for name in wanted}
        return {name: file if Path(file).is_file() else None for name, file in files.items()}, {
            name: f"there is no file {file}" for name, file in files.items() if not Path(file).is_file()
        }
    if plan.loop is None:
        raise BaselineError("a fleet needs a loop to learn with, or baselines")
    folder = plan.output / "baselines"
    make_folder(folder)
    loop = plan.loop if plan.columns is None else plan.loop.model_copy(update={"columns": plan.columns})
    files = {name: baseline_file(folder, name) for name in wanted}
    days: dict[str, list[Item]] = {}
    for item in plan.lake.items:
        days.setdefault(item.asset, []).append(item)
    healthy: dict[str, list[Item]] = {}
    for some in days.values():
        healthy.setdefault(names[some[0].key], []).extend(some[: plan.healthy])
    tasks = [
        Learn(name, tuple(healthy[name]), loop, file, plan.learn_s)
        for name, file in files.items()
        if not Path(file).is_file()
    ]
    unlearned: dict[str, str] = {}
    progress("learning", len(files) - len(tasks), len(files))
    for done, (_, result) in enumerate(engine(tasks), start=len(files) - len(tasks) + 1):
        if result["error"] is not None:
            unlearned[result["name"]] = result["error"]
        elif result["unused"]:
            unlearned[result["name"]] = "; ".join(f"{name}: {why}" for name, why in result["unused"].items())
        progress(f"learned {result['name']}", done, len(files))
    return {name: file if Path(file).is_file() else None for name, file in files.items()}, unlearned


def _write(plan: Plan, fleet: Fleet, entries: Sequence[Mapping[str, Any]]) -> None:
    from servoscope.fleet import pages

    write_table(plan.output / "diagnoses.parquet", _table(entries, fleet))
    pages.write_knowledge(plan.output, fleet, plan.lake.where)


def _table(entries: Sequence[Mapping[str, Any]], fleet: Fleet) -> dict[str, Any]:
    """Return the results as columns, one row per item; `state` is the fleet's word on each."""
    import pyarrow as pa

    kinds = {"string": pa.string(), "double": pa.float64(), "long": pa.int64()}
    rows = [row(entry) for entry in entries]
    states = pa.array([fleet.states[entry["asset"]][entry["day"]] for entry in entries], pa.string())
    return {"state": states} | {name: pa.array([one[name] for one in rows], kinds[k]) for name, k in KINDS.items()}
