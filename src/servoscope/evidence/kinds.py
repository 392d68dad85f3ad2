"""All kinds of evidence: the one place that `learn`, `diagnose`, service, fleet and lake go through."""

from __future__ import annotations

from collections.abc import Iterator

from servoscope.baseline.baseline import Baseline
from servoscope.core.messages import Message
from servoscope.evidence.covariates import COVARIATES
from servoscope.evidence.examination import Examination
from servoscope.evidence.features import FEATURES
from servoscope.evidence.kind import Finding, HealthyRecordings
from servoscope.evidence.motion import MOTION
from servoscope.evidence.residual import RESIDUAL
from servoscope.evidence.sensors import SENSORS
from servoscope.evidence.signals import DEFECTS
from servoscope.evidence.warm_up import WARM_UP

EVIDENCE = COVARIATES, DEFECTS, SENSORS, MOTION, FEATURES, RESIDUAL, WARM_UP


def learn_evidence(healthy: HealthyRecordings, draft: Baseline) -> Baseline:
    """Return a baseline with all evidence that healthy recordings show."""
    notes: list[Message] = []
    for kind in EVIDENCE:
        if kind.learn is not None:
            model, said = kind.learn(healthy, draft)
            draft = draft.model_copy(update={kind.name: model})
            notes += said
    return draft.model_copy(update={"notes": (*draft.notes, *notes)})


def findings(exam: Examination, effect: str) -> Iterator[Finding]:
    """Yield what all evidence says of an examination that has one effect."""
    for kind in EVIDENCE:
        yield from (finding for finding in kind.judge(exam) if finding.effect == effect)
