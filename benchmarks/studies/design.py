"""From which size on the faults of the reference rig are detected and named, by reference; prints a Markdown table.

python benchmarks studies/design [--json]
"""

from __future__ import annotations

from studies.mimics import REFERENCES
from studies.recordings import RIG
from tables import Table, parser, show

import servoscope as ss
from servoscope.design.result import DirectionStudy
from servoscope.design.study import design_study

MAX_PERCENT = 60.0  # larger changes are printed as a ratio


def size(ratio: float | None) -> str:
    """Return a change, as per cent or as a ratio."""
    if ratio is None:
        return "never"
    percent = 100.0 * (ratio - 1.0)
    if abs(percent) <= MAX_PERCENT:
        return f"{percent:+.2g} %"
    return f"x {ratio:.2g}"


def cells(study: DirectionStudy) -> tuple[str, str]:
    """Return from where on a change is detected, and from where on it is named."""
    first, *others = study.unclear or ((1.0, 1.0),)
    again = "".join(f", but not x {low:.2g}{f' to {high:.2g}' if high else ' on'}" for low, high in others)
    return size(study.detectable), size(first[1]) + again


def main() -> None:
    """Run the command line of this process."""
    given = parser(__doc__).parse_args()
    loop = ss.Loop.load(RIG)
    studies = [design_study(loop, reference=reference).faults for reference in REFERENCES]
    rows = tuple(
        (f"{name} {way}", *(cell for study in studies for cell in cells(getattr(study[name], way))))
        for name in studies[0]
        for way in ("up", "down")
    )
    note = (
        "30 s after the onset, a minute learned under the same reference, the noise of `simulate`, one false alarm a "
        "year."
    )
    columns = ("change", *(head for name in REFERENCES for head in (f"{name}: detected from", "named from")))
    show([Table("Detectable sizes", note, columns, rows)], given.json)
