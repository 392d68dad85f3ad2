"""Covariates in a running monitor: their averages block by block, and what is healthy at them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import BaselineError, RecordingError
from servoscope.core.messages import message
from servoscope.detection.baseline import Baseline
from servoscope.detection.chi2_test import t2_statistic
from servoscope.detection.covariates import CovariateAverage, CovariateModel
from servoscope.detection.trace import Trace
from servoscope.estimation.frequency_response import frequency_response


class CovariateMonitor:
    """Follows covariates block by block beside a recursion that starts at the coefficients of their first values."""

    def __init__(self, baseline: Baseline, model: CovariateModel) -> None:
        if model.warm_up is not None:
            raise BaselineError(
                "a warm-up without a thermometer is known at the end of a recording only: diagnose recordings, or "
                "log the temperature and name its column under [columns.covariates]"
            )
        pipeline = baseline.pipeline()
        self.model, self._theta, self._bank = model, np.array(baseline.theta), pipeline.bank
        self._covariance = baseline.covariance_array()
        self.average = CovariateAverage(len(model.names), pipeline.memory_samples)
        self.size, self.start = self.average.size, self.average.start

    def run(
        self, state: FloatArray, channels: Mapping[str, npt.ArrayLike], samples: int
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return the averages (N, k), and once, as soon as all are known, the coefficients (n,) to start from."""
        found = {name: np.asarray(channel, dtype=np.float64) for name, channel in channels.items()}
        if (missing := next((name for name in self.model.names if name not in found), None)) is not None:
            raise RecordingError(str(message("covariate.missing", covariate=missing)))
        if any(found[name].shape != (samples,) for name in self.model.names):
            raise RecordingError("covariates must have the shape of r")
        began = not np.isnan(state).any()
        averages = self.average.run(state, self.model.values(found))
        known = np.flatnonzero(~np.isnan(averages).any(axis=1))
        if began or not known.size:
            return averages, None
        return averages, self.model.theta(self._theta, self.model.clip(averages[known[0]]))

    def compare(self, trace: Trace, averages: FloatArray) -> Trace:
        """Return evaluations compared with what is healthy at averages of the covariates (K, k).

        Where these are not known, or outside of what was learned, none is ready.
        """
        known = np.isfinite(averages).all(axis=1) & self.model.is_inside(averages)
        c = np.where(known[:, None], self.model.clip(averages), self.model.origin)
        more = self.model.theta_covariance(self._theta, c)
        expected = trace.expected + self.model.theta(self._theta, c) - self._theta
        C, healthy, ready = trace.covariance + more, trace.ifrf_expected, trace.ready & known
        return replace(
            trace,
            expected=expected,
            covariance=C,
            ifrf_expected=frequency_response(self._bank, healthy.frequencies, expected, self._covariance + more),
            statistic=np.where(ready, t2_statistic(trace.theta, expected, C), 0.0),
            ready=ready,
        )
