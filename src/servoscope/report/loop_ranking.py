"""The assessed loops of a plant: the worst first, and those that oscillate together."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from servoscope.assessment.assess import DOUBTS, Assessment

PERIOD_TOLERANCE = 0.05  # relative difference of periods within a group


def rank(assessments: Iterable[Assessment]) -> list[Assessment]:
    """Return the worst loops first: what has a verdict, what oscillates, what tracks worst; the undecided come last."""

    def badness(a: Assessment) -> tuple[float, ...]:
        limits = max(a.value("u at its upper limit"), a.value("u at its lower limit"))
        place = (*DOUBTS, "nothing conspicuous", "cannot tell").index(a.verdict)
        return place, a.value("oscillation") == 0.0, -max(a.value("tracking error"), limits, a.value("frozen y"))

    return sorted(assessments, key=badness)


def group_by_period(assessments: Sequence[Assessment]) -> list[tuple[Assessment, ...]]:
    """Return the loops that share a period at one time, the likeliest source first; the largest group first.

    The source is the loop that sticks or is at a limit, and of equals the one that oscillates most regularly: what the
    loops on the way hand on is blurred (Thornhill and Horch, Control Eng. Practice 15, 2007, 1306-1319).
    """
    groups: list[list[Assessment]] = []
    for a in sorted((a for a in assessments if a.value("oscillation")), key=lambda a: a.value("oscillation")):
        shared = [group for group in groups if _oscillate_together(group[0], a)]
        if shared:
            shared[0].append(a)
        else:
            groups.append([a])
    ranked = [tuple(sorted(group, key=_source_rank, reverse=True)) for group in groups if len(group) > 1]
    return sorted(ranked, key=len, reverse=True)


def _oscillate_together(a: Assessment, later: Assessment) -> bool:
    is_one_period = later.value("oscillation") <= a.value("oscillation") * (1.0 + 2.0 * PERIOD_TOLERANCE)
    return is_one_period and a.from_s < later.to_s and later.from_s < a.to_s


def _source_rank(a: Assessment) -> tuple[bool, float]:
    regularity = next(fact.evidence.get("regularity", 0.0) for fact in a.facts if fact.name == "oscillation")
    return a.verdict in ("stiction", "saturation"), regularity
