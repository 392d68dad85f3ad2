"""The headline of a diagnosis: every case as a reader meets it."""

from __future__ import annotations

from typing import Any

import pytest

from servoscope.core.messages import message, text_message
from servoscope.diagnosis.explanation import build_headline
from servoscope.diagnosis.result import DiagnosisWarning, FaultInterval, Mimic, RefitSummary
from servoscope.isolation.candidate import Candidate, FaultEstimate

LEAK = FaultEstimate(name="leakage", parameter="C_ie", ratio=1.2, interval=(1.19, 1.21))
WEAK = FaultEstimate(name="pump", parameter="p_s", ratio=0.9, interval=(0.898, 0.902))
STICKY = FaultEstimate(name="friction", parameter="b_p", ratio=2.04, interval=(1.91, 2.18))
INERTIA = FaultEstimate(name="inertia", parameter="inertia", ratio=1.0502, interval=(1.0487, 1.0517))
GAIN = FaultEstimate(name="input_gain", parameter="input_gain", ratio=1.1, interval=(1.0, 1.2))
BACKLASH = FaultEstimate(name="backlash", parameter="severity", ratio=0.979, interval=(0.668, 1.24))


def candidate(probability: float, *faults: FaultEstimate) -> Candidate:
    return Candidate(
        name=" + ".join(f.name for f in faults) or "unknown", probability=probability, faults=faults, misfit=0.0
    )


def refit(*words: str) -> RefitSummary:
    mimics = tuple(Mimic(name="x", description=text_message(each), value=1.1, unit="ratio") for each in words)
    return RefitSummary(
        from_s=0.0, to_s=60.0, over_s=0.0, noise=1.0, misfit=9.0, limit=40.0, recursive=(), mimics=mimics
    )


@pytest.mark.parametrize(
    ("candidates", "refit_", "expected"),
    [
        (
            [candidate(0.99, LEAK)],
            refit("another stiffness of the load"),
            "Fault: leakage has risen by a fifth since 30.0 s. Another stiffness of the load would look the same.",
        ),
        (
            [candidate(0.99, INERTIA)],
            refit(),
            "Fault: inertia has risen by 5 % since 30.0 s.",
        ),
        (
            [candidate(0.99, WEAK, LEAK)],
            refit(),
            "Fault: pump or valve gain has fallen by a tenth and leakage has risen by a fifth since 30.0 s.",
        ),
        (
            [candidate(0.99, STICKY.model_copy(update={"ratio": 4.04, "interval": (3.9, 4.2)}))],
            refit(),
            "Fault: friction has risen to 4 times its healthy value since 30.0 s.",
        ),
        (  # a size that may be none has no direction
            [candidate(0.99, LEAK.model_copy(update={"ratio": 0.99, "interval": (0.9, 1.08)}))],
            refit(),
            "Fault: leakage has changed by an amount that is not certain since 30.0 s.",
        ),
        (
            [candidate(0.99, GAIN.model_copy(update={"name": "dead zone", "interval": (1.05, 1.15)}))],
            refit(),
            "Fault: input_gain (dead zone) has risen by a tenth since 30.0 s.",
        ),
        (
            [candidate(0.99, BACKLASH)],
            None,
            "Fault: backlash, as labelled recordings show it, at 0.98 times the labelled severity (0.67 to 1.24) "
            "since 30.0 s.",
        ),
        (
            [candidate(0.86, LEAK, STICKY), candidate(0.14, WEAK, LEAK)],
            refit(),
            "Fault since 30.0 s: two faults at once, leakage + friction (86 %) or pump + leakage (14 %). "
            "This recording cannot distinguish changes of b_p and p_s.",
        ),
        (
            [candidate(0.73, GAIN), candidate(0.27, INERTIA)],
            None,
            "Fault since 30.0 s: input gain (73 %) or inertia (27 %). This recording cannot distinguish them.",
        ),
        (
            [candidate(0.9, LEAK), candidate(0.1)],
            refit(),
            "Fault since 30.0 s: leakage (90 %), or no known fault (10 %).",
        ),
        (
            [candidate(0.94, LEAK), candidate(0.04, WEAK)],
            None,
            "Fault since 30.0 s: probably leakage (94 %), but not certain enough to name it.",
        ),
        ([candidate(0.99)], None, "Fault, unknown: a change since 30.0 s that no single known fault explains."),
        (
            [candidate(0.99)],
            refit("another piston area"),
            "Fault, unknown: a change since 30.0 s that no known fault and no pair of them explains. "
            "Another piston area would explain it.",
        ),
    ],
)
def test_every_case_of_a_fault(candidates: list[Candidate], refit_: RefitSummary | None, expected: str) -> None:
    faults = candidates[0].faults if candidates[0].probability >= 0.95 else ()
    interval = FaultInterval(onset_s=(29.0, 30.0, 31.0), faults=faults, candidates=tuple(candidates), refit=refit_)
    assert str(build_headline("fault", (interval,), {}, ())) == expected


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "since 30.0 s."),
        ({"from_start": True}, "since the start of the recording or before."),
        ({"refit": refit().model_copy(update={"over_s": 12.34})}, "since 30.0 s, growing over 12.3 s."),
        ({"refit": refit().model_copy(update={"over_s": 12.34, "misfit": 50.0})}, "since 30.0 s."),
    ],
)
def test_the_onset_as_it_is_known(changes: dict[str, Any], expected: str) -> None:
    sure = candidate(0.99, LEAK)
    interval = FaultInterval(onset_s=(29.0, 30.0, 31.0), faults=sure.faults, candidates=(sure,), **changes)
    headline = str(build_headline("fault", (interval,), {}, (), "warm"))
    assert headline.startswith("Fault at warm: leakage has risen by a fifth ") and headline.endswith(expected)


def test_healthy_and_undetermined() -> None:
    sizes = {"C_ie": (0.036, 0.05), "p_s": (0.0169, 0.02)}
    assert str(build_headline("healthy", (), sizes, ())) == (
        "Healthy: no change found. This recording would have shown changes of p_s by 1.69 %, C_ie by 3.6 % or more."
    )
    short = DiagnosisWarning(kind="power", from_s=0.0, to_s=1.0, count=1, description=message("warning.no_motion"))
    assert str(build_headline("undetermined", (), {}, (short,), "cold")) == (
        "Undetermined at cold: too short or too little motion: no change of any size could have been detected."
    )
