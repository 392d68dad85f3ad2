"""The loops of a plant: the worst first, and those that oscillate together."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from servoscope.assessment.assess import Assessment

PERIOD_TOLERANCE = 0.05  # relative difference of periods within a group
SOURCE_CAUSES = ("stiction", "backlash", "too tight", "saturation")


def group_by_period(assessments: Sequence[Assessment]) -> list[tuple[Assessment, ...]]:
    """Return the loops that share a period, the likeliest source first; groups of two and more, the largest first.

    The source is the loop that is likeliest to oscillate by itself, and of equals the one whose oscillation has the
    largest share of its error.
    """
    ordered = sorted((a for a in assessments if a.oscillates and a.period_s), key=lambda a: a.period_s or 0.0)
    groups: list[list[Assessment]] = []
    for a in ordered:
        if groups and (a.period_s or 0.0) <= (groups[-1][0].period_s or 0.0) * (1.0 + 2.0 * PERIOD_TOLERANCE):
            groups[-1].append(a)
        else:
            groups.append([a])
    ranked = [tuple(sorted(group, key=_source_rank, reverse=True)) for group in groups if len(group) > 1]
    return sorted(ranked, key=len, reverse=True)


def _source_rank(a: Assessment) -> tuple[float, float]:
    return sum(a.probabilities.get(cause, 0.0) for cause in SOURCE_CAUSES), a.oscillation_share or 0.0


def rank(assessments: Iterable[Assessment]) -> list[Assessment]:
    """Return the worst loops first: by the probability that the loop is not good; what cannot be judged comes last."""
    return sorted(assessments, key=lambda a: (a.verdict == "cannot tell", a.probabilities.get("good", 1.0)))
