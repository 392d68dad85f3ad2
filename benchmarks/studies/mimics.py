"""Changes that imitate faults of the reference rig, by reference; prints a Markdown table.

python benchmarks studies/mimics [--json]
"""

from __future__ import annotations

from studies.recordings import RIG
from tables import Table, parser, show

import servoscope as ss
from servoscope.design.result import MimicStudy
from servoscope.design.study import design_study

REFERENCES = ("profile", "multisine", "trapezoid")


def cell(one: MimicStudy) -> str:
    """Return fault, cosine, what the amount looks like, and from where on it is told apart."""
    if one.told_apart is None:
        apart = "never"
    else:
        size = 100.0 * one.told_apart if one.unit == "relative" else one.told_apart
        apart = f"{float(f'{size:.2g}'):g} {'%' if one.unit == 'relative' else 'samples'}"
    return f"{one.imitates}, {one.cosines[one.imitates]:.3f}, x {one.looks_like:.3f}, {apart}"


def main() -> None:
    """Run the command line of this process."""
    given = parser(__doc__).parse_args()
    loop = ss.Loop.load(RIG)
    studies = [design_study(loop, reference=reference).mimics for reference in REFERENCES]
    rows = tuple((str(each[0].words), *map(cell, each)) for each in zip(*studies, strict=True))
    note = (
        "Reference rig, 30 s after the onset. The fault that a change imitates most; cosine between the innovations of "
        "both; what 1 % of the change, or a tenth of a sample, looks like; from where on it is told apart, which makes "
        "it `unknown`."
    )
    show([Table("Mimics", note, ("change", *REFERENCES), rows)], given.json)
