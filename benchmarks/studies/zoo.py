"""Logs as plants make them, each after the documents of the tool that writes it: what becomes of them.

    python benchmarks studies/zoo [--json]

The logs are those of the tests, `tests/support/zoo.py`. Each is read as `servoscope init` proposes; where that is
refused or in doubt, with the option that the message names.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
import warnings
from collections import Counter
from pathlib import Path

from tables import Table, parser, show
from zoo_outcomes import Outcome, find_outcome
from zoo_tables import ZOO


def main() -> None:
    """Write and read all logs, print what became of them."""
    given = parser(__doc__).parse_args()
    warnings.simplefilter("ignore")  # of libraries that write
    with tempfile.TemporaryDirectory(prefix="zoo-") as folder, contextlib.redirect_stdout(sys.stderr):
        outcomes = {one.file: find_outcome(one, Path(folder) / one.file) for one in ZOO}
    counts = Counter(outcomes.values())
    rows = [(outcome.value, str(counts[outcome])) for outcome in Outcome]
    details = [(one.file, one.source.replace("|", "\\|"), outcomes[one.file].value) for one in ZOO]
    others = sum("written by" in one.source for one in ZOO)
    note = f"{len(ZOO)} forms of logs; {others} of them are written by libraries that reading does not use."
    tables = [
        Table("Forms of logs", note, ("outcome", "logs"), tuple(rows)),
        Table("Each form", "Source of the form, and what becomes of it.", ("log", "source", "outcome"), tuple(details)),
    ]
    right = counts[Outcome.AT_ONCE] + counts[Outcome.ONE_LINE]
    show(tables, given.json, {"forms": str(len(ZOO)), "right": str(right), "others": str(others)})
