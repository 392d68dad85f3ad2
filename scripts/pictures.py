#!/usr/bin/env python3
"""Keeps the pictures of the documents true: each is stored with a hash of its file and of what it shows.

    scripts/pictures.py                    print the pictures that are stale or not recorded; 1 if there are some
    scripts/pictures.py --record [NAME...] record pictures (all, or these) as they are, after drawing them

What a picture shows is what it was drawn from: stored results, the beginning of the demonstration's report, or the
navigation and title of a page. Tests compare the first with this record, and the others where they make them.
`make pictures` draws them; of growth.png, which shows times of a quiet machine, only the file is recorded.
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
IMAGES, RECORD = Path("docs/images"), Path("docs/images/pictures.json")
REPORT_WORDS = 150  # of the report, which its picture shows
# what is drawn from stored results: the beginning of its name, and files, of JSON the keys that count
RESULTS = {
    "accuracy/delay": ("benchmarks/accuracy/results/delay/*.json", "numbers"),
    "accuracy/reliability": ("benchmarks/accuracy/results/isolation/**/*.json", "numbers"),
    "benchmarks": ("benchmarks/figures/overview.json", "tables"),
    "cylinder": ("benchmarks/figures/cylinder-plants.json", "tables"),
    "nonlinear-rig": ("benchmarks/figures/nonlinear.json", "tables"),
    "paper/": ("benchmarks/PAPER.md", ""),
}
DEMONSTRATION = ("report", "steps/")
PAGES = "pages/"


def digest(content: bytes) -> str:
    """Return the hash of a content, short enough to be compared by eye."""
    return hashlib.sha256(content).hexdigest()[:16]


def shown_by_report(html: str) -> str:
    """Return the hash of what the beginning of a report says, without its drawings."""
    text = re.sub(r"<(script|style|svg|head)\b.*?</\1>|<[^>]+>", " ", html, flags=re.DOTALL)
    return digest(" ".join(text.split()[:REPORT_WORDS]).encode())


def shown_by_page(words: Sequence[str]) -> str:
    """Return the hash of a page's navigation and titles; what is below changes with time."""
    return digest("\n".join(re.sub(r"\d+", "", word).strip() for word in words).encode())


def shown_by_results(name: str, root: Path = ROOT) -> str | None:
    """Return the hash of the results that a picture is drawn from; None if it is drawn from something else."""
    for beginning, (pattern, key) in RESULTS.items():
        if name.startswith(beginning):
            files = [path.read_text(encoding="utf-8") for path in sorted(root.glob(pattern))]
            parts = [json.dumps(json.loads(text)[key]) if key else text for text in files]
            return digest("\n".join(parts).encode())
    return None


def pictures(root: Path = ROOT) -> list[str]:
    """Return the names of all pictures, relative to their folder."""
    folder = root / IMAGES
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.*") if path.suffix != ".json")


def load(root: Path = ROOT) -> dict[str, dict[str, str]]:
    """Return the record: of each picture the hash of its file, and of what it shows."""
    path = root / RECORD
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def stale(name: str, shows: str, root: Path = ROOT) -> str:
    """Return why a picture is not one of what it is meant to show, or an empty text."""
    recorded = load(root).get(name, {})
    if recorded.get("file") != digest((root / IMAGES / name).read_bytes()):
        return f"docs/images/{name} is not the recorded one: draw it by make pictures"
    return "" if recorded.get("shows") == shows else f"docs/images/{name} shows something older: make pictures"


def record(name: str, shows: str, root: Path = ROOT) -> None:
    """Record a picture and what it shows."""
    known = load(root) | {name: {"file": digest((root / IMAGES / name).read_bytes()), "shows": shows}}
    content = {each: known[each] for each in pictures(root) if each in known}
    (root / RECORD).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def main(arguments: Sequence[str]) -> int:
    """Run the command line; 1 if a picture is stale."""
    demonstration = ROOT / "demo-output" / "report.html"
    recording, names = arguments[:1] == ["--record"], arguments[1:]
    trouble = []
    for name in names or pictures():
        shows = shown_by_results(name) or load().get(name, {}).get("shows", "")
        if name.startswith(DEMONSTRATION) and demonstration.is_file():
            shows = shown_by_report(demonstration.read_text(encoding="utf-8"))
        if recording and not name.startswith(PAGES):  # tests in the browser record those that they draw
            record(name, shows)
        trouble += [why] if (why := stale(name, shows)) else []
    print("\n".join(trouble) or f"{len(pictures())} pictures show what they are meant to")
    return 1 if trouble else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
