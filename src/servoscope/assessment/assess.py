"""One log to facts, and to one sentence of judgement where a rule with a measured score supports it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Literal

from pydantic import BaseModel, ConfigDict, PrivateAttr

from servoscope.assessment import behaviour, facts
from servoscope.assessment.facts import LoopFact
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
# y rests over this much of the travel of u [%]; `benchmarks/assessment/score.py` counts what such a rule finds in
# process loops that it was not chosen for
MIN_RESTING = 22.0
MEASURED_LOOPS, RIGHT_LOOPS, WRONG_ALARMS = 34, 32, 1
# what a verdict follows from, the first that reaches its value [%]
RULES: tuple[tuple[str, float, Verdict], ...] = (
    ("y rests while u moves on", MIN_RESTING, "stiction"),
    ("frozen y", 10.0, "frozen sensor"),
    ("u does not react", 10.0, "manual"),
    ("u at its upper limit", 20.0, "saturation"),
    ("u at its lower limit", 20.0, "saturation"),
)
DECIDING = (facts.frozen, facts.saturated, facts.manual, behaviour.sticking)
DESCRIBING = (
    facts.rest,
    facts.quantum,
    facts.straight,
    behaviour.oscillation,
    behaviour.tracking,
    behaviour.gain_margin,
    behaviour.valve_signs,
)


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
    from_s, to_s
        Time of the first and the last row [s], on the log's clock.
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
    from_s: float
    to_s: float
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
    of_axes = () if kind == "valve" else (behaviour.friction, behaviour.dead_band)
    verdict, reason, measured = measure(forms, (*DESCRIBING, *DECIDING, *of_axes))
    key = verdict.replace(" ", "_") + (f"_{kind}" if verdict == "stiction" else "")
    assessment = Assessment(
        recording=name,
        verdict=verdict,
        kind=kind,
        reason=reason,
        advice=message(f"assess.advice_{key}"),
        from_s=float(forms.recorded.t[0]),
        to_s=float(forms.recorded.t[-1]),
        samples=len(log),
        sample_rate_hz=rate,
        facts=measured,
    )
    assessment._signals = forms.recorded
    return assessment


def judge(log: Samples, name: str = "log") -> tuple[Verdict, Message]:
    """Return the verdict of `assess` and its reason, from the facts alone that decide it.

    Raises RecordingError if the samples hold no values, or no time.
    """
    return measure(LogForms.from_samples(log, name), DECIDING)[:2]


def measure(
    log: LogForms, measures: Sequence[Callable[[LogForms], Iterable[LoopFact]]]
) -> tuple[Verdict, Message, tuple[LoopFact, ...]]:
    """Return what some facts of a log decide, the reason, and the facts."""
    if log.missing > MAX_MISSING_SHARE:
        return "cannot tell", message("assess.missing", share=log.missing), ()
    if (rows := log.even.t.size) < MIN_ROWS:
        return (
            "cannot tell",
            message("assess.rest" if log.rest.any() else "assess.short", samples=rows, least=MIN_ROWS),
            (),
        )
    measured = tuple(fact for measure_one in measures for fact in measure_one(log))
    values = {fact.name: fact.value for fact in measured}
    for name, least, verdict in RULES:
        if (value := values.get(name, 0.0)) >= least:
            score = {"loops": MEASURED_LOOPS, "right": RIGHT_LOOPS, "wrong": WRONG_ALARMS}
            return (
                verdict,
                message(f"assess.reason_{verdict.replace(' ', '_')}", share=value / 100.0, **score),
                measured,
            )
    return "nothing conspicuous", message("assess.reason_nothing_conspicuous"), measured
