"""The structure of the source in figures, of 1.0.0 and now; prints a Markdown table.

python benchmarks studies/structure [--json]
"""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

from tables import Table, parser, show

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = ROOT / "scripts"


def main() -> None:
    """Run the command line of this process."""
    given = parser(__doc__).parse_args()
    spec = importlib.util.spec_from_file_location("house", SCRIPTS / "house.py")
    if spec is None or spec.loader is None:
        raise SystemExit("scripts/house.py is missing")
    house = importlib.util.module_from_spec(spec)
    sys.modules["house"] = house
    spec.loader.exec_module(house)
    before = json.loads((SCRIPTS / "house-1.0.json").read_text(encoding="utf-8"))
    lines = [
        line
        for line in house.table(house.measure(house.read(ROOT / "src" / "servoscope")), before).splitlines()
        if line.startswith("|")
    ]
    rows = [tuple(cell.strip() for cell in line.strip("|").split("|")) for line in lines]
    show([Table("Structure", "`src/servoscope`, Python only.", ("", *rows[0][1:]), tuple(rows[2:]))], given.json)
