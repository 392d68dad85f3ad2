"""The monitor by the conventions of scikit-learn, so that its pipelines, metrics and cross-validation take it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import FloatArray
from servoscope.core.blas import with_one_blas_thread
from servoscope.diagnosis.diagnose import largest_statistic_ratio
from servoscope.diagnosis.operating_points import learn
from servoscope.evidence.examination import Examination
from servoscope.models.loop import Loop
from servoscope.signals import Recording
from servoscope.signals.readers import as_recording
from servoscope.signals.readers.frames import Source

try:
    from sklearn.base import BaseEstimator, OutlierMixin
except ImportError as error:
    raise ImportError("scikit-learn is missing, pip install 'servoscope[notebook]'") from error

Recordings = Sequence[Recording | Source]
INLIER = 1  # what scikit-learn calls an inlier; -1 is an outlier


class NoveltyDetector(OutlierMixin, BaseEstimator):  # type: ignore[misc]
    """Tells recordings that are unlike the healthy ones; its samples are whole recordings, not rows.

    A recording of a machine that hardly moves is like the healthy ones, as nothing speaks against it: `diagnose` calls
    it undetermined.

    Parameters
    ----------
    loop
        The loop, or its path.

    Attributes
    ----------
    baseline_ : Baseline
        What `fit` has learned.
    offset_ : float
        The score at the limit of the baseline, which comes from the loop's budget of false alarms.

    Examples
    --------
    >>> detector = NoveltyDetector("loop.toml").fit(["monday.csv", "tuesday.csv"])
    >>> detector.predict(["wednesday.csv", "friday.csv"]).tolist()
    [1, -1]
    """

    def __init__(self, loop: Loop | str | Path) -> None:
        self.loop = loop

    def fit(self, X: Recordings, y: npt.ArrayLike | None = None) -> Self:
        """Learn a baseline from recordings, or what `read` reads; with labels `y` only from those that are 1."""
        healthy = np.ones(len(X), bool) if y is None else np.asarray(y) == INLIER
        self.baseline_ = learn(self.loop, [recording for recording, chosen in zip(X, healthy, strict=True) if chosen])
        self.offset_ = -1.0
        return self

    @with_one_blas_thread
    def score_samples(self, X: Recordings) -> FloatArray:
        """Return minus the largest statistic of each recording over its limit, shape (len(X),)."""
        return np.array([-self._excess(as_recording(recording, self.baseline_.loop)) for recording in X])

    def decision_function(self, X: Recordings) -> FloatArray:
        """Return the scores over `offset_`, shape (len(X),): negative where a recording is unlike the healthy ones."""
        return self.score_samples(X) - self.offset_

    def predict(self, X: Recordings) -> npt.NDArray[np.int64]:
        """Return 1 for recordings that are like the healthy ones and -1 for others, shape (len(X),)."""
        return np.where(self.decision_function(X) < 0.0, -INLIER, INLIER)

    def _excess(self, recording: Recording) -> float:
        exams = (Examination.from_recording(baseline, recording) for baseline in self.baseline_.per_point)
        return min(map(largest_statistic_ratio, exams))

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, "baseline_")

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.two_d_array = False
        return tags
