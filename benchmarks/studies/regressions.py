"""How far off the iFRF is by the regression alone: least squares without noise; prints Markdown tables.

python benchmarks studies/regressions [--json]
"""

from __future__ import annotations

from dataclasses import replace

from tables import Table, parser, show

from servoscope.research.paper.conditions import FREQUENCIES, PAPER
from servoscope.research.paper.tracking import bias_metrics

REFERENCES = ("profile", "multisine")
WORDS = {
    "tustin": "bilinear, as published",
    "tustin-straight": "the same, where u runs in straight lines",
    "tustin-held": "bilinear, u averaged over two samples",
    "svf": "state-variable filter",
}


def main() -> None:
    """Run the command line of this process."""
    given = parser(__doc__).parse_args()
    errors = [bias_metrics(replace(PAPER, reference=name)) for name in REFERENCES]
    rows = tuple(
        (words, *(", ".join(percent(each[f"noise_free.{name}.{f:g}"]) for f in FREQUENCIES) for each in errors))
        for name, words in WORDS.items()
    )
    note = "Error of the iFRF at 1, 10 and 20 Hz by least squares, without noise:"
    show([Table("Regressions", note, ("regression", *REFERENCES), rows)], given.json)


def percent(share: float) -> str:
    """Return a share in per cent, with two digits or two decimals."""
    return f"{100.0 * share:#.2g}".rstrip(".") + " %" if share > 0.001 else f"{100.0 * share:.2f} %"
