"""A fleet from its lake to its report: learn, examine, summarise, write; by any engine, resumed after any crash."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, islice
from pathlib import Path
from typing import Any
from urllib.parse import quote

from servoscope.core.errors import BaselineError
from servoscope.core.files import make_folder
from servoscope.fleet.baselines import baseline_path
from servoscope.fleet.common_cause import PRIOR, Prior
from servoscope.fleet.day_monitor import WINDOW
from servoscope.fleet.journal import open_journal
from servoscope.fleet.lake import AssetDay, Lake
from servoscope.fleet.summary import Fleet, summarise_fleet
from servoscope.fleet.tasks import Engine, ExamineTask, LearnTask, result_table
from servoscope.models.loop import Columns, Loop
from servoscope.signals.writers import write_table

FleetProgress = Callable[[str, int, int], None]  # the current step, and how many items are done, of how many


@dataclass(frozen=True)
class Plan:
    """What a run does.

    Parameters
    ----------
    lake
        The items.
    output
        Folder for all results.
    loop
        Settings to learn with; not needed where there are `baselines`.
    baselines
        A baseline for all assets, or a folder with one per asset or group; None: they are learned.
    by
        ``asset``: a baseline for each; or the key of a group, whose members share one.
    healthy
        How many days of each asset are learned from, the first ones.
    columns
        Where the signals are; None: where the loop says.
    window_s
        Seconds of raw rows that a diagnosis covers.
    learn_s
        Seconds of each healthy day that are learned from, at most.
    prior
        What is assumed of faults and common causes in advance.
    population
        Baselines of like machines: a prior for those that are learned. A machine's own, by its name, is left out.
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
    population: tuple[Path, ...] = ()

    def baseline_name(self, item: AssetDay) -> str:
        """Return the asset or group whose baseline an item is compared with.

        Raises BaselineError if the item's asset is in no such group.
        """
        if self.by == "asset":
            return item.asset
        group = dict(item.groups).get(self.by)
        if group is None:
            raise BaselineError(f"asset {item.asset} has no {self.by}: name it in the folders or the table of groups")
        return group

    def provenance(self) -> dict[str, Any]:
        """Return what all results depend on."""
        like = {"population": [str(file) for file in self.population]} if self.population else {}
        return {
            "loop": self.loop.hash() if self.loop is not None else None,
            "baselines": str(self.baselines) if self.baselines is not None else None,
            "by": self.by,
            "healthy": self.healthy if self.baselines is None else None,
            "columns": self.columns.model_dump() if self.columns is not None else None,
            "window_s": self.window_s,
            "learn_s": self.learn_s if self.baselines is None else None,
            **like,
        }


def run(plan: Plan, engine: Engine, progress: FleetProgress = lambda *_: None) -> Fleet:
    """Do what is left to do, and write baselines, traces, journal, diagnoses, fleet.json and report.html.

    Raises
    ------
    OutputError
        If the folder holds results of other settings, is in use, or cannot be written.
    BaselineError
        If there is neither a loop nor a baseline.
    """
    make_folder(plan.output)
    items, tasks = plan.lake.items, []
    with open_journal(plan.output / "journal.jsonl", plan.provenance()) as journal:
        names = {item.key: plan.baseline_name(item) for item in items}
        baselines, errors = _learn_baselines(plan, names, engine, progress)
        for item in items:
            if not journal.is_examined(item):
                name = names[item.key]
                folder = plan.output / "traces" / f"asset={quote(item.asset)}" / f"day={quote(item.day)}"
                shared = len(plan.lake.assets), plan.columns, plan.window_s
                tasks.append(
                    ExamineTask(item, baselines[name], errors.get(name, ""), *shared, str(folder / "trace.parquet"))
                )
        finished = len(items) - len(tasks)
        progress("examining", finished, len(items))
        for done, (task, entry) in enumerate(engine(tasks), start=finished + 1):
            journal.add(entry)
            progress(" ".join(task.key), done, len(items))
        entries = journal.entries()
    entries = [entry for entry in entries if (entry["asset"], entry["day"]) in names]
    groups = {item.asset: dict(item.groups) for item in items}
    fleet = summarise_fleet(entries, groups, errors, plan.prior)
    _write(plan, fleet, entries)
    return fleet


def _learn_baselines(
    plan: Plan, names: Mapping[tuple[str, str], str], engine: Engine, progress: FleetProgress
) -> tuple[dict[str, str | None], dict[str, str]]:
    """Return the file of each baseline, None where there is none, and why by name."""
    wanted = dict.fromkeys(names.values())
    if plan.baselines is not None and plan.baselines.is_file():
        return dict.fromkeys(wanted, str(plan.baselines)), {}
    if plan.baselines is not None:
        files = {name: baseline_path(plan.baselines, name) for name in wanted}
        baselines = _existing(files)
        return baselines, {name: f"there is no file {file}" for name, file in files.items() if baselines[name] is None}
    if plan.loop is None:
        raise BaselineError("a fleet needs a loop to learn with, or baselines")
    folder = plan.output / "baselines"
    make_folder(folder)
    loop = plan.loop if plan.columns is None else plan.loop.model_copy(update={"columns": plan.columns})
    files = {name: baseline_path(folder, name) for name in wanted}
    healthy: dict[str, list[AssetDay]] = {}
    for _, days in groupby(plan.lake.items, key=lambda item: item.asset):
        some = list(islice(days, plan.healthy))
        healthy.setdefault(names[some[0].key], []).extend(some)
    missing = [name for name, file in _existing(files).items() if file is None]
    alike = tuple(str(file) for file in plan.population)
    tasks = [LearnTask(name, tuple(healthy[name]), loop, files[name], plan.learn_s, alike) for name in missing]
    errors: dict[str, str] = {}
    progress("learning", len(files) - len(tasks), len(files))
    for done, (_, result) in enumerate(engine(tasks), start=len(files) - len(tasks) + 1):
        if result["error"] is not None:
            errors[result["name"]] = result["error"]
        elif result["unused"]:
            errors[result["name"]] = "; ".join(f"{name}: {reason}" for name, reason in result["unused"].items())
        progress(f"learned {result['name']}", done, len(files))
    return _existing(files), errors


def _existing(files: Mapping[str, str]) -> dict[str, str | None]:
    return {name: file if Path(file).is_file() else None for name, file in files.items()}


def _write(plan: Plan, fleet: Fleet, entries: Sequence[Mapping[str, Any]]) -> None:
    import pyarrow as pa

    from servoscope.fleet.report import write_fleet_report

    states = pa.array([fleet.states[entry["asset"]][entry["day"]] for entry in entries], pa.string())
    table = result_table(entries)
    columns = {"state": states} | dict(zip(table.schema.names, table.columns, strict=True))
    write_table(plan.output / "diagnoses.parquet", columns)
    write_fleet_report(plan.output, fleet, plan.lake.location)
