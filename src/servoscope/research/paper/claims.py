"""Every claim of the paper's text beside what was measured, with a verdict: holds, holds partly, does not hold."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from typing import Any

import numpy as np

from servoscope.research.paper import diagnosis_claims, estimation_claims
from servoscope.research.paper.quartiles import ClaimVerdict, MetricQuartiles, MetricSamples


@dataclass(frozen=True)
class Claim:
    """One claim."""

    name: str  # short and permanent
    place: str  # where it stands in the paper
    claim: str  # what the paper says
    measured: str  # the numbers, medians over the seeds with quartiles in brackets
    verdict: ClaimVerdict  # follows from the numbers by the rule beside the claim
    why: str  # what is behind it
    numbers: dict[str, tuple[float, float, float]]  # name -> lower quartile, median, upper quartile

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON; a number that does not exist is None."""
        plain = asdict(self)
        plain["numbers"] = {
            key: [value if np.isfinite(value) else None for value in values] for key, values in self.numbers.items()
        }
        return plain


def evaluate_claims(metrics: MetricSamples) -> list[Claim]:
    """Return all claims, in the order of the paper."""
    made = []
    texts = tomllib.loads(files(__package__).joinpath("claims.toml").read_text(encoding="utf-8"))
    for name, evaluate in (estimation_claims.CLAIMS | diagnosis_claims.CLAIMS).items():
        numbers, text = MetricQuartiles(metrics), texts[name]
        measured, verdict, confirmed = evaluate(numbers)
        why = text["why"] if confirmed else text["why_otherwise"]
        made.append(Claim(name, text["place"], text["claim"], measured, verdict, why, dict(numbers.used)))
    return made


def format_markdown(made: Sequence[Claim], seeds: int) -> str:
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
