"""The report on what a verdict rests on: why, refit beside recursion, pairs, what else it could be."""

from __future__ import annotations

from typing import Any

import pytest
from pages import make_diagnosis, read

from servoscope.diagnosis.result import Diagnosis, Mimic, RefitSummary
from servoscope.isolation.candidate import Candidate, FaultEstimate
from servoscope.models.loop import Loop


@pytest.fixture
def loop(rig: dict[str, Any]) -> Loop:
    return Loop.from_dict(rig)


LEAK = FaultEstimate(name="leakage", parameter="C_ie", ratio=1.2, interval=(1.198, 1.202))
WEAK = FaultEstimate(name="pump", parameter="p_s", ratio=0.9, interval=(0.898, 0.902))
PAIR = Candidate(
    name="pump + leakage",
    probability=0.96,
    faults=(WEAK, LEAK),
    misfit=0.0,
    covariance=((1.0e-6, 0.6e-6), (0.6e-6, 1.0e-6)),
)
NONE = Candidate(name="unknown", probability=0.99)


def make_refit(*recursive: Candidate, mimics: tuple[Mimic, ...] = (), misfit: float = 12.5) -> RefitSummary:
    return RefitSummary(
        from_s=0.0, to_s=60.0, over_s=0.0, noise=1.02, misfit=misfit, limit=40.4, recursive=recursive, mimics=mimics
    )


def test_why_and_the_refit_beside_the_recursion(loop: Loop) -> None:
    alone = Candidate(name="leakage", probability=0.98, faults=(LEAK,), misfit=0.0)
    spring = Mimic(name="k_p", words="another stiffness of the load", value=1.19, unit="ratio")
    late = Mimic(name="delay", words="an input that acts later", value=0.004, unit="s")
    for ratio, verdict, difference in ((1.203, "agree", "2.1 σ"), (1.25, "do not agree", "35 σ")):
        other = LEAK.model_copy(update={"ratio": ratio, "interval": (ratio - 0.002, ratio + 0.002)})
        recursive = alone.model_copy(update={"faults": (other,)})
        diagnosis = make_diagnosis(
            explanation=("By 60.0 s theta_0 has risen from 0.26 to 0.31 A/m.", "Rejected: pump (p_s x 0.87 at best)."),
            candidates=(alone,),
            faults=(LEAK,),
            refit=make_refit(recursive, mimics=(spring, late)),
        )
        page = read(diagnosis, loop)
        for words in (
            "Why By 60.0 s θ0 has risen from 0.26 to 0.31 A/m. Rejected: pump (ps × 0.87 at best).",
            f"Both say leakage, and their sizes {verdict}.",
            difference,
            "12.5, 40.4",
            "Another stiffness of the load × 1.190",
            "An input that acts later 0.00400 s",
            "r, u and y cannot distinguish leakage from these causes",
        ):
            assert words in page.text, words
        assert not page.wrong
        assert len([attrs for tag, attrs in page.tags if tag == "svg" and attrs.get("role") == "img"]) == 7
    assert Diagnosis.model_validate_json(diagnosis.model_dump_json()) == diagnosis


def test_a_pair_has_both_sizes_and_how_they_hang_together(loop: Loop) -> None:
    diagnosis = make_diagnosis(candidates=(PAIR, NONE), faults=PAIR.faults, probability=0.96, refit=make_refit(NONE))
    page = read(diagnosis, loop)
    for words in (
        "pump or valve gain and internal leakage",
        "ps × 0.9000",
        "Cie × 1.2000",
        "sizes correlated by 0.60",
        "The recursion compares single faults only, and finds none that explains the change.",
        "Of the causes outside the list of faults none explains the recording as well.",
        "both at once, 95 %",
    ):
        assert words in page.text, words
    assert Diagnosis.model_validate_json(diagnosis.model_dump_json()) == diagnosis


def test_pairs_that_are_not_resolved_and_what_would_explain_the_unknown(loop: Loop) -> None:
    sticky = FaultEstimate(name="friction", parameter="b_p", ratio=2.0, interval=(1.9, 2.1))
    other = PAIR.model_copy(update={"name": "leakage + friction", "probability": 0.4, "faults": (LEAK, sticky)})
    both = (PAIR.model_copy(update={"probability": 0.6}), other)
    assert "changed in two ways at once" in read(make_diagnosis(candidates=both, faults=()), loop).text
    piston = Mimic(name="A_p", words="another piston area", value=1.1, unit="ratio")
    refit = make_refit(NONE, mimics=(piston,), misfit=132.0)
    page = read(make_diagnosis(candidates=(NONE, PAIR), faults=(), refit=refit), loop)
    assert "Both find no fault that explains the change." in page.text
    assert "this would explain what no fault does" in page.text and "Another piston area × 1.100" in page.text
