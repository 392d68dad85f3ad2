"""Prints the figures of docs/accuracy.md and of sentences in other documents from stored results; measures nothing.

python benchmarks accuracy/values [--json]
"""

from __future__ import annotations

from collections.abc import Iterator

from tables import parser, show

from accuracy import run


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


def span(key: str, column: int, digits: int = 1) -> str:
    """Return the least and the largest number of a column of a table."""
    numbers = [leading(row[column]) for row in rows_of(key) if row[column].strip("* ")]
    least, most = f"{min(numbers):.{digits}f}", f"{max(numbers):.{digits}f}"
    return least if least == most else f"{least} to {most}"


def total(key: str, column: int) -> str:
    """Return the sum of the counts of a column."""
    return f"{sum(leading(row[column]) for row in rows_of(key) if row[column].strip('* ')):.0f}"


# of each figure: the table, the column, and the decimals that are shown
SPANS = {
    "isolation.right": ("isolation", 3, 1),
    "isolation.named": ("isolation", 5, 1),
    "isolation.unknown": ("isolation", 7, 1),
    "isolation.onset": ("isolation-by-size", 6, 0),
    "isolation.size": ("isolation-by-size", 7, 0),
    "sizes": ("sizes", 3, 2),
    "onset": ("onset", 3, 1),
    "onset.axes": ("onset-axes", 3, 0),
    "timelines": ("timelines", 2, 0),
    "second-rig.named": ("second-rig", 5, 1),
    "second-rig.size": ("second-rig", 7, 1),
    "wrong-file.named": ("wrong-file", 5, 1),
    "wrong-file.size": ("wrong-file", 7, 1),
}
TOTALS = {
    "isolation.runs": ("isolation", 1),
    "timelines.runs": ("timelines", 1),
    "timelines.wrong": ("timelines", 3),
    "motion.runs": ("motion", 2),
    "motion.wrong": ("motion", 8),
    "motion.unchecked": ("motion", 9),
    "smooth.healthy-refused": ("smooth", 1),
    "own-past.wrong": ("own-past", 5),
}


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
    found |= {name: span(*place) for name, place in SPANS.items()}
    found |= {name: total(*place) for name, place in TOTALS.items()}
    mixed = next(row for row in rows_of("mixed") if row[0] == "all")
    found |= {"mixed.faults": mixed[1], "mixed.named": mixed[6], "mixed.error": mixed[9]}
    return found | {"delay.leakage": leak[4], "delay.leakage-best": leak[6]}


def main() -> None:
    """Print the values."""
    show([], parser(__doc__).parse_args().json, values())
