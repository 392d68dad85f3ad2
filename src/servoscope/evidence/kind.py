"""What all kinds of evidence have in common: how one is learned, and what it finds in a recording."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, Self

from pydantic import BaseModel

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.covariates import CovariateModel
from servoscope.core.messages import Message
from servoscope.estimation.pipeline import Pipeline, Regression
from servoscope.evidence.examination import Examination
from servoscope.evidence.population import Population
from servoscope.fit.tuning import TuningFit
from servoscope.models.loop import Loop
from servoscope.signals import Recording


@dataclass(frozen=True, eq=False)
class HealthyRecordings:
    """What all is learned from: m recordings, their regressors, and least squares over them."""

    loop: Loop
    recordings: Sequence[Recording]
    pipeline: Pipeline
    regressions: Sequence[Regression]
    fit: TuningFit
    covariates: CovariateModel | None = None
    population: Population | None = None  # like machines, of which this is one
    notes: list[Message] = field(default_factory=list)


class Finding(NamedTuple):
    """What a kind of evidence says of a recording between two times.

    "undetermined" leaves the recording without a verdict, "change" is a fault without a name, "doubt" is a warning.
    """

    effect: Literal["undetermined", "change", "doubt"]
    kind: str  # of the warning, as in a diagnosis
    text: Message
    from_s: float
    to_s: float
    rows: int = 1  # of the recording that it is about

    @classmethod
    def throughout(
        cls, exam: Examination, effect: Literal["undetermined", "change", "doubt"], kind: str, text: Message
    ) -> Self:
        """Return a finding about a whole recording."""
        return cls(effect, kind, text, float(exam.recording.t[0]), float(exam.recording.t[-1]))


# a model of a kind of evidence, None where the recordings show none, and what `learn` has to say about it
Learned = tuple[BaseModel | None, Sequence[Message]]


@dataclass(frozen=True)
class EvidenceKind:
    """One kind of evidence.

    Parameters
    ----------
    name
        The field of the baseline that holds its model.
    learn
        Returns the model of healthy recordings, from these and a baseline without evidence of this kind; None where
        an earlier step of learning makes the model, or there is none.
    judge
        Returns what the model says of an examination.
    """

    name: str
    learn: Callable[[HealthyRecordings, Baseline], Learned] | None = None
    judge: Callable[[Examination], Iterable[Finding]] = lambda exam: ()
