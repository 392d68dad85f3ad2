"""All benchmarks beside each other, from the stored results: a table and a picture; measures nothing.

    python benchmarks public/overview [--json] [--picture FILE]

Run after the benchmarks: it reads `benchmarks/figures/`. The picture is docs/images/benchmarks.svg.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import NamedTuple

from scipy.stats import binomtest
from tables import Table, parser, show

from public.cranfield import CYCLE_S

BENCHMARKS = Path(__file__).resolve().parent.parent
DETECTORS = ("servoscope", "rms of u", "T^2 of features", "inverse + CUSUM")
COLOURS = ("#0b5fa5", "#9aa5b1", "#c58b2a", "#6b8e5a")
PICTURE = BENCHMARKS.parent / "docs" / "images" / "benchmarks.svg"
WIDTH, LEFT, BAR, GAP = 760, 250, 11, 14  # pixels


class Comparison(NamedTuple):
    """What each detector found on one benchmark, and its false alarms: numbers and out of how many."""

    name: str
    found: tuple[tuple[int, int], ...]
    false: tuple[tuple[int, int], ...]


def table_of(program: str, title: str) -> Iterator[dict[str, str]]:
    """Yield the rows of a stored table."""
    stored = json.loads((BENCHMARKS / "figures" / f"{program}.json").read_text(encoding="utf-8"))
    table = next(one for one in stored["tables"] if one["title"] == title)
    for row in table["rows"]:
        yield dict(zip(table["columns"], row, strict=True))


def numbers(text: str) -> tuple[int, int]:
    """Return both numbers of `3 of 5`."""
    some, all_of = map(int, re.findall(r"\d+", text)[:2])
    return some, all_of


def comparison(name: str, rows: Iterator[dict[str, str]]) -> Comparison:
    """Return the four detectors of a table; of servoscope the settings of the first row, which has no model error."""
    first: dict[str, dict[str, str]] = {}
    for row in rows:
        first.setdefault(row["detector"].split(",")[0], row)
    chosen = [first[detector] for detector in DETECTORS]
    return Comparison(
        name, tuple(numbers(row["found"]) for row in chosen), tuple(numbers(row["false"]) for row in chosen)
    )


def comparisons() -> list[Comparison]:
    """Return all benchmarks that have simple detectors beside them."""
    found = []
    for fold in ("runs 1 to 5", "odd runs"):
        rows = (row for row in table_of("cranfield", "Cranfield: detectors") if row["learned from"] == fold)
        found.append(comparison(f"Cranfield, {fold}", rows))
    for name, program, title in (
        ("QUBE, gain x 1.1", "qube", "QUBE: detectors"),
        ("EMPS, changes put in", "emps", "EMPS: detectors"),
        ("Pump-controlled EHA, loads", "eha-pump", "Pump-controlled EHA: loads"),
        ("Pump-controlled EHA, gain x 1.1", "eha-pump", "Pump-controlled EHA: gain"),
    ):
        found.append(comparison(name, table_of(program, title)))
    return found


def false_alarms_per_hour() -> str:
    """Return the false alarms of drawn baselines of the ball screw per hour of motion, with their 95 % interval."""
    stored = json.loads((BENCHMARKS / "figures" / "cranfield.json").read_text(encoding="utf-8"))
    false, runs = numbers(stored["values"]["draws.false"])
    ends = binomtest(false, runs).proportion_ci(method="exact")
    rate, low, high = (share * 3600.0 / CYCLE_S for share in (false / runs, *ends))
    return f"{rate:.2g} ({low:.2g} to {high:.2g})"


def picture(found: list[Comparison]) -> str:
    """Return bars of the share found, with false alarms in words, as SVG."""
    parts, y, scale = [], 34, (WIDTH - LEFT - 190) / 100.0
    for i, (detector, colour) in enumerate(zip(DETECTORS, COLOURS, strict=True)):
        x = LEFT + 118 * i
        parts.append(f'<rect x="{x}" y="8" width="10" height="10" fill="{colour}"/>')
        parts.append(f'<text x="{x + 14}" y="17">{escape(detector)}</text>')
    for one in found:
        parts.append(f'<text x="{LEFT - 8}" y="{y + 2 * BAR + 4}" text-anchor="end">{escape(one.name)}</text>')
        for (some, all_of), (false, healthy), colour in zip(one.found, one.false, COLOURS, strict=True):
            length = 100.0 * some / all_of * scale
            words = f"{some} of {all_of}" + (f", {false} of {healthy} false" if false else "")
            fill = ' fill="#b00020"' if false else ""
            parts.append(
                f'<rect x="{LEFT}" y="{y}" width="{max(length, 1.0):.1f}" height="{BAR - 2}" fill="{colour}"/>'
            )
            parts.append(f'<text x="{LEFT + length + 5:.1f}" y="{y + BAR - 3}" font-size="10"{fill}>{words}</text>')
            y += BAR
        y += GAP
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {y}" font-family="sans-serif" font-size="12">'
        f'<title>Changes found and false alarms</title><rect width="{WIDTH}" height="{y}" fill="#ffffff"/>'
    )
    return "\n".join([head, *parts, "</svg>"]) + "\n"


def main() -> None:
    """Run the command line of this process."""
    command = parser(__doc__)
    command.add_argument("--picture", type=Path, help="write the picture there")
    given = command.parse_args()
    found = comparisons()
    if given.picture:
        given.picture.write_text(picture(found), encoding="utf-8")
    rows = []
    for one in found:
        both = zip(one.found, one.false, strict=True)
        rows.append((one.name, *(f"{a} of {b}; {c} of {d}" for (a, b), (c, d) in both)))
    note = "Changes or faults found; false alarms on healthy recordings that were held out."
    values = {"false-per-hour": false_alarms_per_hour()}
    show([Table("Overview", note, ("benchmark", *DETECTORS), tuple(rows))], given.json, values)
