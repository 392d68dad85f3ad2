"""Every claim of the paper's text beside what was measured, with a verdict: holds, holds partly, does not hold."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from typing import Any, NamedTuple

from servoscope.report.plain_values import replace_nan
from servoscope.research.paper import tradeoff
from servoscope.research.paper.conditions import TABLE_2
from servoscope.research.paper.quartiles import MetricQuartiles, MetricSamples

FREQUENCIES = ("1", "10", "20")  # Hz, as they stand in the names of metrics
PAIR = ("akf", "dfrls")  # the estimators that the paper compares


@dataclass(frozen=True)
class Claim:
    """One claim."""

    name: str  # short and permanent
    place: str  # where it stands in the paper
    claim: str  # what the paper says
    measured: str  # the numbers, medians over the seeds with quartiles in brackets
    verdict: str  # holds, holds partly, does not hold: follows from the numbers by the rule in `RULES`
    why: str  # what is behind it
    numbers: dict[str, tuple[float, float, float]]  # name -> lower quartile, median, upper quartile

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON; a number that does not exist is None."""
        plain: dict[str, Any] = replace_nan(asdict(self))
        return plain


class Judgement(NamedTuple):
    """What follows from the numbers of a claim."""

    holds: bool
    partly: bool = False
    cause_confirmed: bool = True  # whether what is presumed to be behind it is
    counts: tuple[int, ...] = ()  # what its sentence names beside medians


def evaluate_claims(metrics: MetricSamples) -> list[Claim]:
    """Return all claims, in the order of the paper."""
    made = []
    texts = tomllib.loads(files(__package__).joinpath("claims.toml").read_text(encoding="utf-8"))
    for name, text in texts.items():
        numbers = MetricQuartiles(metrics)
        judgement = RULES[name](numbers)
        why = text["why"] if judgement.cause_confirmed else text["why_otherwise"]
        measured = numbers.fill(text["measured"], judgement.counts)
        verdict = "holds" if judgement.holds else "holds partly" if judgement.partly else "does not hold"
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


def _below(values: Sequence[float], holds: float, partly: float) -> Judgement:
    """Judge numbers all of which have to be small."""
    return Judgement(all(value < holds for value in values), any(value < partly for value in values))


def _graded(first: bool, *others: bool) -> Judgement:
    """Judge conditions of which the first one alone is a part."""
    return Judgement(first and all(others), first)


def _tracks(n: MetricQuartiles) -> Judgement:
    error = max(n(f"{name}.{when}") for name in PAIR for when in ("before", "after"))
    return Judgement(error < 0.02 and n("akf.rise.0.9") < 5.0, error < 0.1)


def _tells_pairs_at_1_hz(n: MetricQuartiles) -> Judgement:
    clear = n("apart.pump-leakage.1") > 3.0
    overlap = n("apart.friction-contamination.1") < 3.0 and n("angle.friction-contamination.1") < 15.0
    return Judgement(clear and overlap, clear or overlap)


def _wins_in_conditions(n: MetricQuartiles) -> Judgement:
    wins = [
        sum(n(f"equal_rise.{column}.dfrls|{conditions}") < 0.95 for conditions in tradeoff.CONDITIONS)
        for column in ("cv_theta", "cv_H")
    ]
    total = len(tradeoff.CONDITIONS)
    return Judgement(min(wins) >= total - 1, max(wins) > 0, counts=(*wins, total))


RULES: Mapping[str, Callable[[MetricQuartiles], Judgement]] = {
    "selective": lambda n: Judgement(False, n("sensitivity.angle_difference") < 1e-6),
    "selective-with-frequency": lambda n: _graded(
        n("sensitivity.b_p-beta.20") > 2.0 * n("sensitivity.b_p-beta.1"),
        not n("sensitivity.C_ie-b_p.20") < 0.5 * n("sensitivity.C_ie-b_p.1"),
    ),
    "stable": lambda n: Judgement(n("stability.largest") < 1.0),
    "no-windup": lambda n: _graded(
        n("windup.dark.akf") <= 1.0 and n("windup.rest.akf") < 1.05,
        n("windup.dark.dfrls") <= 1.0,
        n("windup.rest.kf") > 2.0,
    ),
    "eq-12": lambda n: _graded(n("eq12.motion.60.largest") < 0.01, n("eq12.dark.60.largest") < 0.01),
    "akf-quieter-parameters": lambda n: _below(
        (n("equal_rise.cv_theta.dfrls"), n("akf.cv_theta") / n("dfrls.cv_theta")), 0.7, 0.95
    ),
    "akf-quieter-ifrf": lambda n: _below((n("equal_rise.cv_H.dfrls"),), 0.7, 0.95),
    "ifrf-quieter": lambda n: Judgement(
        max(n(f"{name}.cv_H.{f}") / n(f"{name}.cv_theta") for name in PAIR for f in FREQUENCIES) < 0.6,
        max(n(f"{name}.cv_H.1") / n(f"{name}.cv_theta") for name in PAIR) < 1.0,
    ),
    "tracking": _tracks,
    "imaginary-bias": lambda n: _graded(
        abs(n("akf.own_bias_imag")) < 0.1, abs(n("akf.own_bias_real")) < abs(n("akf.own_bias_imag"))
    )._replace(cause_confirmed=abs(n("noise_free.tustin-straight.imag")) < 0.1 * abs(n("noise_free.tustin.imag"))),
    "origin": lambda n: Judgement(
        max(n(f"akf.bias.{f}") for f in FREQUENCIES) < 0.02, max(n(f"akf.bias.{f}") for f in FREQUENCIES) < 0.1
    ),
    "at-1-hz": _tells_pairs_at_1_hz,
    "at-10-hz": lambda n: _below((n("apart.friction-contamination.10"),), 3.0, 6.0),
    "at-20-hz": lambda n: _graded(
        n("angle.friction-contamination.20") - n("angle.friction-contamination.1") > 20.0,
        n("apart.friction-contamination.20") > 3.0,
        n("apart.friction-contamination.20") > 1.5 * n("apart.friction-contamination.1"),
    ),
    "isolation": lambda n: Judgement(n("paper.named") > 0.9 * len(TABLE_2), n("unbiased.named") > 0.9 * len(TABLE_2)),
    "experimental-data": lambda n: Judgement(
        n("labelled.named") >= 15.0 and n("labelled.unseen") >= 15.0, n("labelled.named") >= 12.0
    ),
    "immediate": lambda n: Judgement(n("paper.delay") < 2.0 and n("paper.detected") > 15.0, n("default.delay") < 2.0),
    "conditions": _wins_in_conditions,
    "fault-tolerance": lambda n: _below(
        [n(f"tolerance.{fault}.acted") / n(f"tolerance.{fault}.idle") for fault in ("pump", "contamination")], 0.9, 0.9
    ),
}
