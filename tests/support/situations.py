"""Situations of assets as a store knows them, and what the first screen has to say of each."""

from __future__ import annotations

from typing import Any, NamedTuple

from servoscope.core.messages import message
from servoscope.diagnosis.explanation import build_headline
from servoscope.diagnosis.result import Diagnosis, FaultInterval, RefitSummary
from servoscope.isolation.candidate import Candidate, FaultEstimate
from servoscope.service.assets.examination import StoredDiagnosis

NOW = 1798000000.0  # 2026-12-23T04:26:40Z
BEGAN = NOW - 600.0
ONSET = BEGAN + 120.0
AT = "2026-12-23 04:18"  # the onset on the reader's clock, which is UTC
LEAK = FaultEstimate(name="leakage", parameter="C_ie", ratio=1.2, interval=(1.19, 1.21))
WEAK = FaultEstimate(name="pump", parameter="p_s", ratio=0.9, interval=(0.898, 0.902))
STICKY = FaultEstimate(name="friction", parameter="b_p", ratio=4.04, interval=(3.9, 4.2))
UNSURE = FaultEstimate(name="leakage", parameter="C_ie", ratio=0.99, interval=(0.9, 1.08))
SEAL, FILTER, BEARING = "piston seal and valve edges", "supply pressure and filter", "rod seal, guide and bearing"


def candidate(probability: float, *faults: FaultEstimate) -> Candidate:
    return Candidate(name=" + ".join(f.name for f in faults) or "unknown", probability=probability, faults=faults)


def refit(over_s: float = 0.0) -> RefitSummary:
    recursive = (candidate(1.0, LEAK),)
    return RefitSummary(
        from_s=0.0, to_s=600.0, over_s=over_s, noise=1.0, misfit=9.0, limit=40.0, recursive=recursive, mimics=()
    )


def diagnosis(*candidates: Candidate, checks: tuple[str, ...], end_s: float | None = None, over_s: float = 0.0) -> Any:
    """A full diagnosis of a window that began at `BEGAN`, as the service stores it."""
    faults = candidates[0].faults if candidates[0].probability >= 0.95 else ()
    end = (end_s - 1.0, end_s, end_s + 1.0) if end_s is not None else None
    interval = FaultInterval(
        detected_at_s=121.0,
        onset_s=(119.0, 120.0, 121.0),
        end_s=end_s,
        end_interval_s=end,
        probability=candidates[0].probability,
        faults=faults,
        candidates=candidates,
        refit=refit(over_s) if faults else None,
    )
    headline = build_headline("fault", (interval,), {}, ())
    said = Diagnosis(
        recording="x", samples=60000, duration_s=600.0, verdict="fault", headline=headline,
        checks=checks, intervals=(interval,), parameters={}, ifrf=(),
    )  # fmt: skip
    document = {"began": BEGAN, "signature": [], **said.model_dump(mode="json")}
    dated = said.dated_headline(BEGAN)
    return StoredDiagnosis(verdict="fault", headline=dated, onset=ONSET, document=document), faults


class Situation(NamedTuple):
    """What the store knows, and what the first screen has to say: what it is, since when, what to do."""

    status: dict[str, Any]
    full: Any
    expected: tuple[str, str, str]


def fault(*candidates: Candidate, what: str, do: str, checks: tuple[str, ...], over_s: float = 0.0) -> Situation:
    full, faults = diagnosis(*candidates, checks=checks, over_s=over_s)
    status = {"verdict": "fault", "summary": full.summary, "onset": ONSET, "diagnosed": NOW, "fault_at": NOW}
    status |= {"faults": [one.model_dump(mode="json") for one in faults], "statistic": 2.0, "level": 0.5}
    return Situation(status, full, (what, AT, do))


GONE, _ = diagnosis(candidate(0.99, LEAK), checks=(SEAL,), end_s=300.0)
SITUATIONS = {
    "step": fault(candidate(0.99, LEAK), what="leakage has risen by a fifth", do=SEAL, checks=(SEAL,)),
    "drift": fault(
        candidate(0.98, STICKY), what="friction has risen to 4", do=BEARING, checks=(BEARING,), over_s=100.0
    ),
    "pair": fault(
        candidate(0.97, WEAK, LEAK),
        what="gain has fallen by a tenth and leakage has risen by a fifth",
        do=FILTER,
        checks=(FILTER, SEAL),
    ),
    "open": fault(
        candidate(0.6, LEAK), candidate(0.4, WEAK), what="leakage (60 %) or pump (40 %)", do=SEAL, checks=(SEAL, FILTER)
    ),
    "unsure": fault(
        candidate(0.97, UNSURE), what="leakage has changed by an amount that is not certain", do=SEAL, checks=(SEAL,)
    ),
    "unknown": fault(
        candidate(0.99), what="no single known fault explains", do="changed last", checks=("what was changed last",)
    ),
    "gone": Situation(
        {
            "verdict": "healthy",
            "summary": "Healthy.",
            "alarms": {
                "fault": {"state": "returned_unacknowledged", "since": NOW, "priority": "high", "cause": GONE.summary}
            },
        },
        GONE,
        ("not answered yet: Fault: leakage from", AT, SEAL),
    ),
    "fresh": Situation(
        {
            "verdict": "fault",
            "summary": str(message("service.examination.fault")),
            "onset": ONSET,
            "statistic": 2.0,
            "awaited": [3],
        },
        None,
        ("the loop deviates from its healthy behaviour", AT, "full diagnosis is under way"),
    ),
    "healthy": Situation(
        {"verdict": "healthy", "summary": "Healthy: no change found. ..."}, None, ("no change found", AT, "Nothing: ")
    ),
    "stuck": Situation(
        {"verdict": "undetermined", "summary": "Undetermined.", "quality": {"frozen_y": ONSET}},
        None,
        ("Undetermined: y stays the same, sensor or axis is stuck", AT, "check sensor, cable"),
    ),
    "silent": Situation(
        {
            "verdict": "undetermined",
            "summary": "Undetermined: no data come.",
            "reception": "silent",
            "alarms": {"reception": {"state": "unacknowledged", "since": NOW, "priority": "medium", "cause": ""}},
        },
        None,
        ("Undetermined: no data come", AT, "check topic or nodes"),
    ),
}


# after a fault: at `NOTED` somebody has noted a repair, or a later diagnosis has found nothing
NOTED = NOW - 200.0
LEFT = FaultEstimate(name="friction", parameter="b_p", ratio=1.12, interval=(1.06, 1.18))
BEFORE = FaultEstimate(name="friction", parameter="b_p", ratio=1.37, interval=(1.3, 1.44))
NOISE = FaultEstimate(name="friction", parameter="b_p", ratio=1.05, interval=(0.97, 1.13))
WAS, _ = diagnosis(candidate(0.99, BEFORE), checks=(BEARING,))
RETURNED = {"state": "returned_unacknowledged", "since": NOW, "priority": "high", "cause": WAS.summary, "active": False}
ACTIVE = RETURNED | {"state": "unacknowledged", "active": True}
REPAIRED = {
    "repaired": NOTED,
    "before": [BEFORE.model_dump(mode="json")],
    "learning": {"after": "repair", "since": NOTED, "learned_s": 200.0, "needed_s": 600.0},
}
LATER = {
    "repaired": Situation(
        REPAIRED
        | {
            "verdict": "healthy",
            "summary": "",
            "since": NOW - 80.0,
            "sized": NOW,
            "size": NOISE.model_dump(mode="json"),
        }
        | {"alarms": {"fault": RETURNED}},
        WAS,
        ("as before the fault (friction +5 %, within its scatter)", "2026-12-23 04:25", "Acknowledge the alarm"),
    ),
    "not-quite": Situation(
        REPAIRED
        | {"verdict": "fault", "summary": "", "since": NOW - 80.0, "onset": NOTED, "diagnosed": NOW}
        | {"faults": [LEFT.model_dump(mode="json")], "alarms": {"fault": ACTIVE}},
        diagnosis(candidate(0.99, LEFT), checks=(BEARING,))[0],
        ("friction has risen by 12 % since 2026-12-23 04:23:20. Before the repair: friction +37 %", "04:23", BEARING),
    ),
    "withdrawn": Situation(
        {"verdict": "healthy", "summary": "Healthy.", "since": NOW - 80.0, "alarms": {"fault": RETURNED}},
        WAS,
        ("No change now; not answered yet: Fault: friction has risen by 37 %", "2026-12-23 04:25", BEARING),
    ),
    "learning": Situation(
        REPAIRED | {"verdict": "undetermined", "summary": "Undetermined.", "since": NOTED, "alarms": {"fault": ACTIVE}},
        WAS,
        ("the samples since 2026-12-23 04:23:20 decide whether the fault has gone", "04:23", "move as usual"),
    ),
}
SITUATIONS |= LATER | {
    "coarse": Situation(
        {"verdict": "healthy", "summary": "Healthy.", "about": {"coarse": ("payload", 0.477, 0.046, 5)}},
        None,
        (
            "the smallest detectable change of the moved mass is 48 %, then 4.6 %",
            "Monitoring is coarse until 5 more recordings are learned",
            "Learn 5 more recordings of healthy days",
        ),
    ),
}


def stored(name: str, situation: Situation) -> dict[str, Any]:
    status = {
        "since": ONSET,
        "onset": None,
        "examined": NOW,
        "ne107": "good",
        "reasons": [],
        "quality": {},
        "alarms": {},
    }
    status |= {"t": NOW, "counted": {"began": BEGAN, "t": NOW, "rows": 1}, **situation.status}
    words = {"leakage": "internal leakage", "pump": "pump or valve gain"}
    status["about"] = {"faults": words, "source": "line", **status.get("about", {})}
    return {"asset": name, "sequence": 1, "state": b"", "status": status, "at": NOW}
