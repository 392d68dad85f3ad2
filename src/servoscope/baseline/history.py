"""The history of a baseline file: earlier baselines are kept in a folder beside it, so that one step leads back."""

from __future__ import annotations

import time
from pathlib import Path

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.records import Revision
from servoscope.core.errors import BaselineError
from servoscope.core.files import make_folder


def history_folder(path: Path) -> Path:
    """Return the folder of the earlier baselines and of the samples that were learned from a service."""
    return path.with_suffix(".history")


def read_history(path: Path) -> dict[int, Baseline]:
    """Return the baselines of a file by their numbers, the one in force last.

    Raises BaselineError if one of them cannot be read.
    """
    earlier = [Baseline.load(file) for file in sorted(history_folder(path).glob("*.json"))]
    return {baseline.revision.number: baseline for baseline in (*earlier, Baseline.load(path))}


def replace_baseline(path: Path, baseline: Baseline) -> None:
    """Put a baseline in force, and keep the one before; raises OutputError if a file cannot be written."""
    earlier, folder = Baseline.load(path), history_folder(path)
    make_folder(folder)
    earlier.save(folder / f"{earlier.revision.number:06d}.json")
    baseline.save(path)


def step_back(path: Path, who: str = "", why: str = "") -> Baseline:
    """Put the baseline in force that the present one was made from, and return it.

    Raises BaselineError if there is none.
    """
    restored = restore_parent(path, who, why)
    replace_baseline(path, restored)
    return restored


def restore_parent(path: Path, who: str = "", why: str = "") -> Baseline:
    """Return the baseline that the present one was made from, as the next of the history; it is not put in force.

    Raises BaselineError if there is none.
    """
    history = read_history(path)
    *_, present = history.values()
    restored = history.get(present.revision.parent)
    if restored is None:
        raise BaselineError(f"{path}: its history has no earlier baseline to go back to")
    known = restored.revision
    revision = Revision(
        number=max(history) + 1,
        kind="back",
        who=who,
        why=why,
        at=time.time(),
        parent=known.parent,
        reference=known.reference,
    )
    return restored.model_copy(update={"revision": revision})
