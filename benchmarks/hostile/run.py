"""Feed every reader and decoder with broken input, and count what came of it.

    python benchmarks hostile/run [--inputs 900] [--only NAME] [--render]

--render writes the table into benchmarks/reliability/RESULTS.md from the results that are there.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
from pathlib import Path

BENCHMARKS = Path(__file__).resolve().parent.parent
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from tables import machine  # noqa: E402

from hostile.feeding import broken_bounds, feed_all, markdown  # noqa: E402
from servoscope.core.files import atomic_write  # noqa: E402

RESULTS = BENCHMARKS / "hostile" / "results.json"
PAGE = BENCHMARKS / "reliability" / "RESULTS.md"


def render() -> None:
    """Write the table between its markers on the page."""
    page = PAGE.read_text(encoding="utf-8")
    text = markdown(json.loads(RESULTS.read_text(encoding="utf-8")))
    marked = re.compile("<!-- hostile -->.*?<!-- end of hostile -->", re.DOTALL)
    if not marked.search(page):
        sys.exit(f"{PAGE}: markers <!-- hostile --> and <!-- end of hostile --> are missing")
    atomic_write(PAGE, marked.sub(lambda _: f"<!-- hostile -->\n\n{text}\n\n<!-- end of hostile -->", page).encode())


def main() -> None:
    """Run the command line of this process."""
    command = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    command.add_argument("--inputs", type=int, default=900, help="for each")
    command.add_argument("--only", default="", help="those whose names contain this; nothing is kept then")
    command.add_argument(
        "--render", action="store_true", help="write the table into benchmarks/reliability/RESULTS.md, and no more"
    )
    given = command.parse_args()
    if given.render:
        render()
        return
    found = {"machine": machine(), "targets": feed_all(given.inputs, given.only)}
    if not given.only:
        atomic_write(RESULTS, (json.dumps(found, indent=1) + "\n").encode())
    print(markdown(found))
    if broken := broken_bounds(found["targets"]):
        sys.exit(f"not read or refused in bounds: {', '.join(broken)}")
