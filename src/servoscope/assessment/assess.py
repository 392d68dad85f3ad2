"""One log to facts, and to one sentence of judgement where a rule with a measured score supports it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, PrivateAttr

from servoscope.assessment.behaviour import AXIS_FACTS, LOOP_FACTS
from servoscope.assessment.facts import RECORDING_FACTS, LoopFact
from servoscope.assessment.log import LogForms, Signals
from servoscope.core.errors import RecordingError
from servoscope.core.messages import Message, MessageText, message
from servoscope.core.short_repr import ShortRepr
from servoscope.signals.readers.frames import Source, open_source
from servoscope.signals.readers.recording_file import read_rows
from servoscope.signals.readers.tags import find_loops
from servoscope.signals.samples import Samples

Kind = Literal["valve", "cylinder", "axis"]
Verdict = Literal["stiction", "frozen sensor", "manual", "saturation", "nothing conspicuous", "cannot tell"]
# what forbids learning, and what the service alarms
DOUBTS: tuple[Verdict, ...] = ("stiction", "frozen sensor", "manual", "saturation")
MIN_ROWS = 100
MAX_MISSING_SHARE = 0.3
MAX_PROCESS_RATE_HZ = 1.0  # up to which a log is taken for one of a valve
MIN_DOUBT = {"frozen y": 10.0, "u does not react": 10.0, "u at its upper limit": 20.0, "u at its lower limit": 20.0}
# y rests over this much of the travel of u [%]; `benchmarks/assessment/score.py` counts what such a rule finds in
# process loops that it was not chosen for: 5 of 7 that stick, and one of 27 others
MIN_RESTING = 22.0
MEASURED_LOOPS, RIGHT_LOOPS, WRONG_ALARMS = 34, 31, 1


class Assessment(ShortRepr, BaseModel):
    """What one log of a loop shows.

    Parameters
    ----------
    verdict
        "stiction" where the rule on it says so, or the fact that forbids learning; "nothing conspicuous"; or "cannot
        tell", where there was too little to measure.
    kind
        Of the machine, for the advice.
    reason, advice
        Why, and what to look at.
    facts
        All that was measured.

    Examples
    --------
    >>> ss.assess("friday.csv").verdict
    'nothing conspicuous'
    """

    model_config = ConfigDict(frozen=True)

    recording: str
    verdict: Verdict
    kind: Kind
    reason: MessageText
    advice: MessageText
    samples: int
    sample_rate_hz: float
    facts: tuple[LoopFact, ...] = ()
    _signals: Signals | None = PrivateAttr(default=None)

    def _shown_facts(self) -> Mapping[str, object]:
        return {"recording": self.recording, "verdict": self.verdict, "facts": len(self.facts)}

    @property
    def signals(self) -> Signals | None:
        """The rows that figures are drawn from; None when the assessment was read back from JSON."""
        return self._signals

    def value(self, name: str, otherwise: float = 0.0) -> float:
        """Return the value of a fact by its name."""
        return next((fact.value for fact in self.facts if fact.name == name), otherwise)


def assess(log: Samples | Source, *, name: str | None = None, kind: Kind | None = None) -> Assessment:
    """Measure what one log of a loop shows; no baseline and no plant model are needed.

    Parameters
    ----------
    log
        Samples, a recording, or what `read` reads: a path, a frame, arrays by name, with columns t, u, y and, if it is
        known, r.
    name
        What the log is called in results.
    kind
        Of the machine, for the advice: "valve", "cylinder" or "axis". None: a valve in logs of one row a second and
        fewer, or whose columns are called OP and PV; else an axis.

    Returns
    -------
    Assessment
        ``model_dump(mode="json")`` of it is one JSON object.

    Raises RecordingError if the log cannot be read.

    Examples
    --------
    >>> [fact.name for fact in ss.assess("monday.csv").facts][:2]
    ['oscillation', 'damping as seen']
    """
    if not isinstance(log, Samples):
        loops = find_loops(open_source(log).columns)
        if len(loops) > 1:
            raise RecordingError(f"{name or log}: holds {len(loops)} loops ({', '.join(loops)}), assess one by one")
        ((tag, columns),) = loops.items()
        ((label, log),) = read_rows(log, columns).items()
        name, kind = name or label, kind or ("valve" if tag else None)
    name = name or str(getattr(log, "name", "log"))
    forms = LogForms.from_samples(log, name)
    rate = 1.0 / max(forms.recorded.step, 1e-300)
    kind = kind or ("valve" if rate <= MAX_PROCESS_RATE_HZ else "axis")
    facts: tuple[LoopFact, ...] = ()
    verdict: Verdict = "cannot tell"
    if forms.missing > MAX_MISSING_SHARE:
        reason = message("assess.missing", share=forms.missing)
    elif forms.even.t.size < MIN_ROWS:
        key = "assess.rest" if forms.rest.any() else "assess.short"
        reason = message(key, samples=forms.even.t.size, least=MIN_ROWS)
    else:
        measures = RECORDING_FACTS + LOOP_FACTS + (AXIS_FACTS if kind != "valve" else ())
        facts = tuple(fact for measure in measures for fact in measure(forms))
        verdict, reason = judge(facts)
    key = verdict.replace(" ", "_") + (f"_{kind}" if verdict == "stiction" else "")
    assessment = Assessment(
        recording=name,
        verdict=verdict,
        kind=kind,
        reason=reason,
        advice=message(f"assess.advice_{key}"),
        samples=len(log),
        sample_rate_hz=rate,
        facts=facts,
    )
    assessment._signals = forms.recorded
    return assessment


def judge(facts: tuple[LoopFact, ...]) -> tuple[Verdict, Message]:
    """Return the verdict of some facts and its reason."""
    share = next((fact.value for fact in facts if fact.name == "y rests while u moves on"), 0.0)
    if share > MIN_RESTING:
        score = {"loops": MEASURED_LOOPS, "right": RIGHT_LOOPS, "wrong": WRONG_ALARMS}
        return "stiction", message("assess.reason_stiction", share=share / 100.0, **score)
    high = [fact for fact in facts if fact.value >= MIN_DOUBT.get(fact.name, np.inf)]
    if not high:
        return "nothing conspicuous", message("assess.reason_nothing_conspicuous")
    first = high[0]
    verdicts: dict[str, Verdict] = {"frozen y": "frozen sensor", "u does not react": "manual"}
    verdict = verdicts.get(first.name, "saturation")
    return verdict, message(f"assess.reason_{verdict.replace(' ', '_')}", share=first.value / 100.0)
