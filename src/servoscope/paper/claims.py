"""Every claim of the paper's text beside what was measured, with a verdict: holds, holds partly, does not hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from servoscope.paper import diagnosis_claims, estimation_claims
from servoscope.paper.numbers import Metrics, Numbers, Verdict


@dataclass(frozen=True)
class Claim:
    """One claim.

    Parameters
    ----------
    name
        Short and permanent.
    place
        Where it stands in the paper.
    claim
        What the paper says.
    measured
        The numbers, medians over the seeds with quartiles in brackets.
    verdict
        Follows from the numbers by the rule beside the claim.
    why
        What is behind it.
    numbers
        Name -> lower quartile, median, upper quartile.
    """

    name: str
    place: str
    claim: str
    measured: str
    verdict: Verdict
    why: str
    numbers: dict[str, tuple[float, float, float]]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON; a number that does not exist is None."""
        plain = asdict(self)
        plain["numbers"] = {
            key: [value if np.isfinite(value) else None for value in values] for key, values in self.numbers.items()
        }
        return plain


def claims(metrics: Metrics) -> list[Claim]:
    """Return all claims, in the order of the paper.

    Parameters
    ----------
    metrics
        What the seeds measured: name -> one value per seed.
    """
    made = []
    for build in (*estimation_claims.ROWS, *diagnosis_claims.ROWS):
        numbers = Numbers(metrics)
        name, place, claim, measured, verdict, why = build(numbers)
        made.append(Claim(name, place, claim, measured, verdict, why, dict(numbers.used)))
    return made


def markdown(made: Sequence[Claim], seeds: int) -> str:
    """Return the table as Markdown."""
    lines = [
        f"# Claims of the paper, measured over {seeds} seed{'s' if seeds > 1 else ''}",
        "",
        "Medians, quartiles in brackets where they differ.",
        "",
        "| claim | where | measured | verdict | why |",
        "|---|---|---|---|---|",
    ]
    for c in made:
        cells = (c.claim, c.place, c.measured, f"**{c.verdict}**", c.why)
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"
