"""After an alarm: the refit of the seconds around the onset by maximum likelihood on the exact sampled plant."""

from servoscope.isolation.ml.other_causes import OtherCause, find_other_causes
from servoscope.isolation.ml.search import MAX_WINDOW_SAMPLES, Hypothesis, RefitResult, fit_hypotheses

__all__ = ["MAX_WINDOW_SAMPLES", "Hypothesis", "OtherCause", "RefitResult", "find_other_causes", "fit_hypotheses"]
