"""Prints figures of docs/accuracy.md that stand alone in sentences of other documents; measures nothing.

python benchmarks/accuracy/values.py [--json]
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parent.parent)  # where `accuracy` is a package, and `tables` lies

from tables import parser, show  # noqa: E402

from accuracy import run  # noqa: E402


def rows_of(key: str) -> Iterator[tuple[str, ...]]:
    """Yield the rows of a table of the page, from the results that are stored."""
    table = next(table for table in run.TABLES if table.key == key)
    results = run.stored_results()
    for scenario in table.scenarios:
        if scenario.id in results:
            yield from scenario.rows(scenario.words, results[scenario.id]["numbers"])


def leading(cell: str) -> float:
    """Return the number that a cell begins with."""
    return float(cell.replace("**", "").split("%")[0].split()[0])


def values() -> dict[str, str]:
    """Return the figures by name."""
    bias = [tuple(map(leading, row[1:])) for row in rows_of("bias")]
    healthy = [row for row in rows_of("coverage") if row[1] == "2000"]
    covered = [leading(cell) for row in healthy for cell in row[2:9]]
    alarms: dict[str, list[tuple[float, str]]] = {}
    for _, budget, hours, counted, *_ in rows_of("alarms"):
        alarms.setdefault(budget, []).append((leading(counted) / float(budget), hours))
    leak = next(row for row in rows_of("delay") if row[0] == "C_ie x1.2")
    found = {
        f"bias.{hz}": f"{max(column):.2f}" for hz, column in zip((1, 10, 20), zip(*bias, strict=True), strict=True)
    }
    found |= {"coverage": f"{min(covered):.1f} to {max(covered):.1f} %", "coverage.runs": healthy[0][1]}
    for budget, counts in alarms.items():
        ratios = [ratio for ratio, _ in counts]
        found[f"alarms.{budget}"] = f"{min(ratios):.2f} to {max(ratios):.2f}"
    found["alarms.hours"] = f"{sum(float(hours) for _, hours in alarms['1']):g}"
    return found | {"delay.leakage": leak[4], "delay.leakage-best": leak[6]}


if __name__ == "__main__":
    show([], parser(__doc__).parse_args().json, values())
