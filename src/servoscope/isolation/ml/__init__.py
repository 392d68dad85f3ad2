"""After an alarm: the refit of the seconds around the onset by maximum likelihood on the exact sampled plant."""

from servoscope.isolation.ml.onset import OnsetEstimate
from servoscope.isolation.ml.other_causes import OtherCause
from servoscope.isolation.ml.outside_cause import find_other_causes, find_outside_onset
from servoscope.isolation.ml.result import Hypothesis, RefitResult
from servoscope.isolation.ml.search import MAX_WINDOW_SAMPLES, fit_hypotheses
from servoscope.isolation.ml.timeline import TimelineStretch, find_timeline, is_constant

__all__ = [
    "MAX_WINDOW_SAMPLES",
    "Hypothesis",
    "OnsetEstimate",
    "OtherCause",
    "RefitResult",
    "TimelineStretch",
    "find_other_causes",
    "find_outside_onset",
    "find_timeline",
    "fit_hypotheses",
    "is_constant",
]
