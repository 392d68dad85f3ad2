"""Faults learned from labelled runs of a ball screw: named, left open, unknown, missed; prints Markdown tables.

    python benchmarks studies/labelled [--data DIR] [--json]

Healthy runs 1 to 5 of each load make the baseline; no labelled run is judged with a baseline that has learned it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from tables import Table, parse_with_data, parser, show

import servoscope as ss
from servoscope.core.errors import NotEnoughError
from servoscope.scoring import accuracy, confusion

ROOT = Path(__file__).resolve().parents[2]
LOADS = ("20", "40", "-40")
FILES = {"backlash": "backlash2", "dry": "lackLubrication1"}
FIRST, LAST = tuple(range(1, 6)), tuple(range(6, 11))
HALVES = ((FIRST, LAST), (LAST, FIRST))
EACH = tuple((tuple(k for k in range(1, 11) if k != run), (run,)) for run in range(1, 11))
SAID = ("backlash", "dry", "a coefficient", "open, right one first", "open, wrong one first", "unknown", "not detected")

Runs = Mapping[str, Mapping[int, ss.Recording]]


def runs_of(data: Path, loop: ss.Loop, load: str) -> Runs:
    """Return all runs at a load: kind -> number -> recording."""
    folder, files = data / "real" / "cranfield", {"healthy": "normal", **FILES}
    found = {}
    for kind, file in files.items():
        parts = ss.read_parts(folder / f"{file}.csv", loop, where={"load": load}, by="run")
        found[kind] = dict(enumerate(parts, start=1))
    return found


def labelled(loop: ss.Loop, runs: Runs, chosen: Sequence[int], kinds: Sequence[str]) -> ss.Baseline:
    """Learn from healthy runs 1 to 5, and those faults that show in the chosen runs."""
    healthy = [runs["healthy"][k] for k in FIRST]
    faults = {kind: [runs[kind][k] for k in chosen] for kind in kinds}
    shown = {}
    for kind, recordings in faults.items():
        try:
            ss.learn(loop, healthy, faults={kind: recordings})
        except NotEnoughError:
            continue
        shown[kind] = recordings
    return ss.learn(loop, healthy, faults=shown)


def said_of(baseline: ss.Baseline, recording: ss.Recording, truth: str) -> str:
    """Return what a diagnosis says, as one of `SAID`."""
    diagnosis = ss.diagnose(baseline, recording)
    if diagnosis.verdict != "fault":
        return "not detected"
    if diagnosis.faults:
        return diagnosis.faults[0].name if diagnosis.faults[0].learned else "a coefficient"
    first = diagnosis.candidates[0].name
    if first == "unknown":
        return first
    return f"open, {'right' if first == truth else 'wrong'} one first"


def confused(title: str, note: str, counts: Mapping[tuple[str, str], Counter[str]], rows: str = "load") -> Table:
    """Return a table of what was said, a row for each load and truth."""
    cells = [(*key, *(str(count[what] or "") for what in SAID)) for key, count in counts.items()]
    return Table(title, note, (rows, "truth", *SAID), tuple(cells))


def judged(
    loop: ss.Loop, runs: Mapping[str, Runs], splits: Sequence[tuple[Sequence[int], Sequence[int]]]
) -> dict[tuple[str, str], Counter[str]]:
    """Learn both faults from some runs and judge the others, load by load."""
    counts: dict[tuple[str, str], Counter[str]] = {(load, kind): Counter() for load in LOADS for kind in runs[load]}
    for load in LOADS:
        for chosen, others in splits:
            baseline = labelled(loop, runs[load], chosen, tuple(FILES))
            for kind, some in runs[load].items():
                for k in others if kind != "healthy" else set(others) & set(LAST):
                    counts[load, kind][said_of(baseline, some[k], kind)] += 1
    return counts


def scores(counts: Mapping[tuple[str, str], Counter[str]]) -> str:
    """Say how many of the faulty runs that were detected were named, and how many of those rightly."""
    named = [(kind, what) for (_, kind), c in counts.items() if kind in FILES for what in c.elements()]
    detected = [(kind, what) for kind, what in named if what != "not detected"]
    names = [(kind, what) for kind, what in detected if what in SAID[:3]]
    right = accuracy(confusion([kind for kind, _ in names], [what for _, what in names], SAID))
    first = sum(what == kind or what == "open, right one first" for kind, what in detected)
    unknown = sum(what == "unknown" for _, what in detected)
    return (
        f"Detected: {len(detected)} of {len(named)} faulty runs; of these {len(names)} named, {unknown} unknown, the "
        f"right fault first in {first}. Of those named, right: {right.value:.0%} (95 %: {right.low:.0%} to "
        f"{right.high:.0%})."
    )


def tables(data: Path) -> Iterator[Table]:
    """Yield all tables."""
    loop = ss.Loop.load(ROOT / "examples" / "cranfield.toml")
    runs = {load: runs_of(data, loop, load) for load in LOADS}
    halves, each = judged(loop, runs, HALVES), judged(loop, runs, EACH)
    told = (
        "Load in kgf; dry is lack of lubrication. A name is given from a probability of 95 % on; below, it stays open. "
    )
    yield confused(
        "Labelled faults: half of the runs",
        f"{told}Learned from labelled runs 1 to 5, runs 6 to 10 judged, and the other way round. {scores(halves)}",
        halves,
    )
    yield confused(
        "Labelled faults: all runs but one",
        f"{told}Learned from nine labelled runs, the tenth judged, each in turn. {scores(each)}",
        each,
    )
    counts: dict[tuple[str, str], Counter[str]] = {}
    for load in LOADS:
        for known, stranger in (("backlash", "dry"), ("dry", "backlash")):
            baseline = labelled(loop, runs[load], FIRST, (known,))
            if baseline.learned:
                counts[load, stranger] = Counter(said_of(baseline, runs[load][stranger][k], stranger) for k in LAST)
    yield confused(
        "Labelled faults: the other fault never seen",
        f"{told}Learned from runs 1 to 5 of one fault; runs 6 to 10 of the other judged, which should be unknown.",
        counts,
    )
    counts = {}
    for source in LOADS:
        faults = labelled(loop, runs[source], FIRST, tuple(FILES)).learned
        for load in LOADS:
            if load == source:
                continue
            bare = ss.learn(loop, [runs[load]["healthy"][k] for k in FIRST])
            baseline = bare.model_copy(update={"learned": faults})
            for kind in FILES:
                counts[f"{source}, {load}", kind] = Counter(said_of(baseline, runs[load][kind][k], kind) for k in LAST)
    yield confused(
        "Labelled faults: from another load",
        f"{told}Deviations learned at the first load (runs 1 to 5) put beside the healthy baseline of the second (runs "
        f"6 to 10 judged), which `learn` does not do. {scores(counts)}",
        counts,
        "loads",
    )


def values(found: Mapping[str, Table]) -> dict[str, str]:
    """Return the figures that stand alone in sentences of documents."""

    def total(rows: Iterable[Sequence[str]], *heads: str) -> int:
        return sum(int(row[2 + SAID.index(head)] or 0) for row in rows for head in heads)

    halves = [row for row in found["half of the runs"].rows if row[1] in FILES]
    dry_20 = [row for row in halves if row[:2] == ("20", "dry")]
    strangers = found["the other fault never seen"].rows
    seen = sum(total([row], *SAID[:-1]) for row in strangers)
    other = sum(total([row], next(kind for kind in FILES if kind != row[1])) for row in strangers)
    return {
        "detected": str(total(halves, *SAID[:-1])),
        "named": str(total(halves, *SAID[:3])),
        "dry-20.wrong-first": f"{total(dry_20, 'open, wrong one first')} of {total(dry_20, *SAID)}",
        "stranger.named": f"{other} of {seen}",
    }


def main() -> None:
    """Run the command line of this process."""
    given = parse_with_data(parser(__doc__), "real/cranfield")
    found = list(tables(given.data))
    show(found, given.json, values({table.title.partition(": ")[2]: table for table in found}))
