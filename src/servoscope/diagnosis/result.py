"""The result of a diagnosis as data: verdict, intervals with faults and candidates, warnings."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field, computed_field, model_validator

from servoscope.core.above import function_above
from servoscope.core.errors import OutputError
from servoscope.core.messages import (
    Message,
    MessageField,
    MessageText,
    clock_of,
    message,
    read_messages,
    render,
    text_message,
)
from servoscope.core.short_repr import ShortRepr
from servoscope.core.verdict import VerdictKind
from servoscope.diagnosis.dates import TIMELINES, date_timeline
from servoscope.isolation.candidate import Candidate, CoefficientChange, FaultEstimate, ResultModel
from servoscope.signals import Defect, Recording
from servoscope.signals.recording import frame_of

if TYPE_CHECKING:  # a result is read without the kernels of an examination
    from servoscope.evidence.kind import Finding

MAX_ALIKE = 3  # defects of one kind that are shown one by one
DEFECT_KINDS = ("gap", "nan", "repeat", "spike", "order", "text", "saturation")
VIBRATION = "vibration"  # a fault that moves no parameter: what is left of the motion is louder


class Mimic(ResultModel):
    """A cause outside the list of faults that explains the recording as well, or better where the answer is unknown."""

    name: str
    description: MessageField
    value: float  # a ratio to the healthy value, or a size in `unit`
    unit: str

    @model_validator(mode="before")
    @classmethod
    def _read(cls, written: Any) -> Any:
        return read_messages(written, description="words")

    @computed_field  # type: ignore[prop-decorator]
    @property
    def words(self) -> str:
        """The description as text."""
        return render(self.description)

    @property
    def size(self) -> Message:
        """Its value with its unit, a ratio as a factor."""
        if self.unit == "ratio":
            return message("diagnosis.mimic_ratio", value=self.value)
        unit = {"in units of y": message("diagnosis.units_of_y"), "in units of u": message("diagnosis.units_of_u")}
        return message("diagnosis.mimic_size", value=self.value, unit=unit.get(self.unit, self.unit))


class RefitSummary(ResultModel):
    """The refit of the seconds around the onset, from which onset and candidates of a diagnosis come."""

    from_s: float  # from_s, to_s: the seconds that were fitted
    to_s: float
    over_s: float  # how long the change grew; 0 where it may have been a step, growing for less than the onset interval
    noise: float  # standard deviation of the innovations, as a multiple of the baseline's
    misfit: float  # what the best candidate leaves unexplained
    limit: float  # of the misfit; a true candidate exceeds it in one of a thousand cases
    recursive: tuple[Candidate, ...]  # what the recursion alone, with its memory, finds at its last evaluation
    mimics: tuple[Mimic, ...]

    @property
    def drifting(self) -> bool:
        """Whether the change grew, by an explanation that fits."""
        return self.over_s > 0.0 and self.misfit <= self.limit


class FinalCoefficient(ResultModel):
    """A coefficient at the end of the recording: value, standard deviation, and what a healthy loop would show."""

    value: float
    std: float
    nominal: float


class ResponsePoint(ResultModel):
    """The iFRF at one monitored frequency at the end of the recording."""

    frequency_hz: float
    real: float
    imag: float
    real_std: float
    imag_std: float
    nominal_real: float
    nominal_imag: float


class DiagnosisWarning(ResultModel):
    """Something about the recording that the reader should know."""

    kind: str
    from_s: float
    to_s: float
    count: int
    description: MessageField

    @model_validator(mode="before")
    @classmethod
    def _read(cls, written: Any) -> Any:
        return read_messages(written, description="message")

    @computed_field  # type: ignore[prop-decorator]
    @property
    def message(self) -> str:
        """The description as text."""
        return render(self.description)

    @classmethod
    def of(cls, told: Defect | Finding) -> DiagnosisWarning:
        """Turn a recording's defect, or what evidence doubts, into a warning."""
        return cls(
            kind=told.kind,
            from_s=told.from_s,
            to_s=told.to_s,
            count=told.count if isinstance(told, Defect) else told.rows,
            description=text_message(told.message) if isinstance(told, Defect) else told.text,
        )


def sum_up(warnings: Sequence[DiagnosisWarning]) -> list[DiagnosisWarning]:
    """Return warnings, defects of a kind that came more than MAX_ALIKE times as one."""
    kinds = Counter(warning.kind for warning in warnings if warning.kind in DEFECT_KINDS)
    summed: dict[str, DiagnosisWarning] = {}
    for number, warning in enumerate(warnings):
        if kinds[warning.kind] <= MAX_ALIKE:
            summed[str(number)] = warning
        elif warning.kind not in summed:
            alike = [diagnosis_warning for diagnosis_warning in warnings if diagnosis_warning.kind == warning.kind]
            text = message("diagnosis.alike", first=warning.description, times=len(alike))
            count, to_s = sum(warning.count for warning in alike), max(warning.to_s for warning in alike)
            summed[warning.kind] = warning.model_copy(update={"description": text, "count": count, "to_s": to_s})
    return list(summed.values())


class FaultInterval(ResultModel):
    """A time during which the actuator differed from healthy, and what explains that."""

    detected_at_s: float | None = None  # first evaluation above a threshold
    onset_s: tuple[float, float, float] | None = None  # lower end, most likely, upper end of the 95 % interval
    end_s: float | None = None  # when it was over, or the alarm gone; None while it lasts
    end_interval_s: tuple[float, float, float] | None = None  # the same with its 95 % interval, where a refit dates it
    from_start: bool = False  # the change may be older than the recording
    probability: float | None = None  # of the first candidate
    faults: tuple[FaultEstimate, ...] = ()  # those that are named; none where no candidate reaches probability 0.95
    candidates: tuple[Candidate, ...] = ()  # most probable first
    refit: RefitSummary | None = None  # what the candidates rest on; None where the recursion or sums found them
    coefficients: tuple[CoefficientChange, ...] = Field(default=(), exclude_if=lambda moved: not moved)


class Provenance(ResultModel):
    """What a diagnosis was made with: versions, and hashes of the baseline and of the recording's samples."""

    servoscope: str
    python: str
    numpy: str
    baseline: str
    recording: str


WRITTEN_INTERVAL = frozenset(FaultInterval.model_fields) - {
    "end_s",
    "end_interval_s",
    "from_start",
    "coefficients",
}  # fields that a Diagnosis repeats


def recording_facts(recording: Recording) -> dict[str, Any]:
    """Return the fields of a diagnosis that say what was examined."""
    names = ("samples", "duration_s", "began", "zone")
    return {"recording": recording.name, **{name: getattr(recording, name) for name in names}}


class Diagnosis(ShortRepr, ResultModel):
    """The verdict on one recording.

    Parameters
    ----------
    recording, samples, duration_s
        What was examined.
    verdict
        ``suspect``: unlike healthy recordings, but not surely a fault; ``undetermined``: the recording excites too
        little or is too short to show a change of the size that the baseline promises.
    headline
        The verdict in one sentence; as text: `summary`.
    reasons
        Why, sentence by sentence: what moved, what was rejected; as text: `explanation`.
    checks
        What to check on the machine, by what the loop file says of the faults, or else by what is known of them.
    intervals
        When the actuator differed from healthy, in order; `onset_s`, `detected_at_s`, `probability`, `faults`,
        `candidates` and `refit` are those of the last one, None or empty where there is none.
    parameters, ifrf
        At the end of the recording.
    warnings
        Defects of the recording, and doubts about the result.
    point
        Operating point whose baseline was used; None where the baseline has none.
    provenance
        Versions and hashes by which `servoscope verify` repeats it; None where nobody asked for them.
    began, zone
        When the recording began [s since 1970], and UTC, or nothing where its dates are as they are written; None
        where it has no dates.

    Examples
    --------
    >>> diagnosis = ss.diagnose("baseline.json", "friday.csv")
    >>> [(fault.name, round(fault.ratio, 2), round(diagnosis.onset_s[1])) for fault in diagnosis.faults]
    [('lubrication', 1.25, 40)]
    """

    recording: str
    samples: int
    duration_s: float
    verdict: VerdictKind
    headline: MessageField
    reasons: tuple[MessageField, ...] = ()
    checks: tuple[MessageText, ...] = ()
    intervals: tuple[FaultInterval, ...] = ()
    parameters: dict[str, FinalCoefficient]
    ifrf: tuple[ResponsePoint, ...]
    warnings: tuple[DiagnosisWarning, ...] = ()
    point: str | None = None
    provenance: Provenance | None = None
    began: float | None = None
    zone: str = ""

    @model_validator(mode="before")
    @classmethod
    def _read(cls, written: Any) -> Any:
        """Read what was written, by version 0.1.0 too: it had text for messages, and no list of intervals."""
        if not isinstance(written, Mapping):
            return written
        fields = read_messages(written, headline="summary", reasons="explanation")
        last = {name: fields.pop(name) for name in WRITTEN_INTERVAL if name in fields}
        if "intervals" not in fields and any(value not in (None, (), []) for value in last.values()):
            fields["intervals"] = (last,)
        return fields

    @property
    def current(self) -> FaultInterval:
        """The last interval; an empty one where there is none."""
        return self.intervals[-1] if self.intervals else FaultInterval()

    def _shown_facts(self) -> dict[str, object]:
        return {"recording": self.recording, "verdict": self.verdict, "summary": self.summary}

    @computed_field  # type: ignore[prop-decorator]
    @property
    def summary(self) -> str:
        """The verdict in one sentence."""
        with clock_of(self.began):
            return render(self.headline)

    @computed_field  # type: ignore[prop-decorator]
    @property
    def explanation(self) -> tuple[str, ...]:
        """Why, sentence by sentence."""
        return tuple(render(reason) for reason in self.reasons)

    @computed_field  # type: ignore[prop-decorator]
    @property
    def detected_at_s(self) -> float | None:
        """First evaluation above a threshold."""
        return self.current.detected_at_s

    @computed_field  # type: ignore[prop-decorator]
    @property
    def onset_s(self) -> tuple[float, float, float] | None:
        """Lower end, most likely, upper end of the 95 % interval of the onset."""
        return self.current.onset_s

    @computed_field  # type: ignore[prop-decorator]
    @property
    def probability(self) -> float | None:
        """Of the first candidate; None when nothing was detected."""
        return self.current.probability

    @computed_field  # type: ignore[prop-decorator]
    @property
    def faults(self) -> tuple[FaultEstimate, ...]:
        """Named faults; empty when healthy and when no candidate reaches probability 0.95."""
        return self.current.faults

    @computed_field  # type: ignore[prop-decorator]
    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """Explanations, the most probable first."""
        return self.current.candidates

    @computed_field  # type: ignore[prop-decorator]
    @property
    def refit(self) -> RefitSummary | None:
        """What the candidates rest on; None where the recursion alone found them."""
        return self.current.refit

    def __str__(self) -> str:
        """Return what `diagnose` prints first: the verdict, what to check, since when, how large, how sure."""
        return str(function_above("cli.render.diagnosis", "diagnosis_text")(self))

    def _repr_html_(self) -> str:
        """Return the same as a table for notebooks, with a picture."""
        return str(function_above("report.diagnosis_page", "render_diagnosis_cell")(self))

    def plot(self) -> Any:
        """Draw the coefficients over their healthy values, as `servoscope.plot` does.

        Examples
        --------
        >>> (axes,) = ss.diagnose("baseline.json", "friday.csv").plot()
        >>> axes.get_title()
        'friday.csv: fault'
        """
        return function_above("report.plots", "plot")(self)

    def report(self, path: str | Path) -> None:
        """Write the report on it as one HTML page, as `servoscope.write_report` does.

        Raises OutputError if the page cannot be written, or the diagnosis does not come from `diagnose`.

        Examples
        --------
        >>> ss.diagnose("baseline.json", "friday.csv").report("friday.html")
        """
        made_of = vars(self).get("made_of")
        if made_of is None:
            raise OutputError(
                f"{path}: only what diagnose returned has a report, write_report(path, baseline, recording)"
            )
        function_above("report.diagnosis_page", "write_report")(path, *made_of)

    def to_dict(self) -> dict[str, Any]:
        """Return what `diagnose --json` prints, as a dictionary.

        Examples
        --------
        >>> ss.diagnose("baseline.json", "friday.csv").to_dict()["faults"][0]["name"]
        'lubrication'
        """
        return dict(json.loads(self.model_dump_json()))

    def to_frame(self) -> Any:
        """Return the faults as a frame of pandas, a row for each fault of an interval: size, onset, probability.

        Raises RecordingError if pandas is missing.

        Examples
        --------
        >>> ss.diagnose("baseline.json", "friday.csv").to_frame()["fault"].tolist()
        ['lubrication']
        """
        rows = []
        for interval in self.intervals:
            low, onset, high = interval.onset_s or (None, None, None)
            when = {"onset_s": onset, "onset_low_s": low, "onset_high_s": high, "end_s": interval.end_s}
            for fault in interval.faults:
                size = {"ratio": fault.ratio, "ratio_low": fault.interval[0], "ratio_high": fault.interval[1]}
                rows.append({"fault": fault.name, **size, **when, "probability": interval.probability})
        return frame_of(self.recording, [{"recording": self.recording, "verdict": self.verdict, **row} for row in rows])

    def dated_headline(self, began: float, onset: float | None = None) -> Message:
        """Return the headline with a date instead of seconds since the recording began, at `began` [UTC s].

        `onset`: of a change that is older than the recording, where it is known [UTC s].
        """
        if self.headline.key in TIMELINES:
            return date_timeline(self.headline, began)
        since = self.headline.values.get("since")
        if self.current.onset_s is None or not isinstance(since, Message):
            return self.headline
        if self.current.from_start and onset is None:
            since = message("diagnosis.since_start_date", t=began)
        else:
            at = began + self.current.onset_s[1] if onset is None else onset
            since = message("diagnosis.since_date", t=at, growth=since.values.get("growth"))
        return self.headline.model_copy(update={"values": {**self.headline.values, "since": since}})


def keep_inputs(diagnosis: Diagnosis, *inputs: object) -> Diagnosis:
    """Keep baseline and recording for the report on a diagnosis: no fields, so neither written nor compared."""
    vars(diagnosis)["made_of"] = inputs
    return diagnosis
