"""Names of columns as makers' tools write them: how often r, u and y are proposed right, or wrong in silence."""

from __future__ import annotations

import argparse
import json
import tempfile
from collections import Counter
from pathlib import Path

from named_logs import FAMILIES, Outcome, find_outcome, named_logs


def main() -> int:
    """Count the outcomes, those of names on which nothing is tuned by themselves."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--each", type=int, default=10, help="logs per maker; a fifth of it of those unseen")
    parser.add_argument("--maker", action="append", default=[], help="only this one, repeatable")
    parser.add_argument("--family", choices=[*FAMILIES], help="only this one")
    parser.add_argument("--json", action="store_true", help="print the counts as JSON")
    given = parser.parse_args()
    counts: dict[str, Counter[str]] = {}
    makers: dict[str, Counter[str]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for family in [given.family] if given.family else FAMILIES:
            each = given.each if family == "seen" else max(1, given.each // 5)
            for log in named_logs(each, given.maker, family):
                outcome, said = find_outcome(log, Path(folder))
                counts.setdefault(family, Counter())[outcome] += 1
                makers.setdefault(log.maker, Counter())[outcome] += 1
                if outcome is not Outcome.RIGHT and not given.json and family == "seen":
                    print(f"{log.file}: {outcome}: {said} (right: {log.words})")
    if given.json:
        print(json.dumps(counts))
        return 0
    for name, found in [*makers.items(), *counts.items()]:
        print(f"{name:14} {sum(found.values()):4}  " + ", ".join(f"{found[o]} {o}" for o in Outcome if found[o]))
    return 0
