"""A change that the sequential test looks for, and the limit of its CUSUM."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

MAX_LIMIT_RATIO = 1.3  # a limit raised by more than this for the uncertainty of the baseline is not worth having


@dataclass(frozen=True)
class CusumHypothesis:
    """One expected change, and what its CUSUM would do to a healthy loop."""

    parameter: str  # parameter, ratio: what changes, and to how many times its healthy value
    ratio: float
    # weights of the shadow's columns (see `servoscope.estimation.kernel.cusum.columns`) that it looks like
    change: tuple[float, ...]
    rate: float  # false alarms per year at a limit of zero, to be divided by exp(limit)
    drift: float  # variance of the drift that an error of the baseline causes, in units of the drift under the change

    def limit(self, false_alarms_per_year: float) -> float:
        """Return where the CUSUM alarms; infinity where the baseline is too uncertain for so small a change.

        The limit solves rate exp(-h + 2 h^2 drift) = budget: averaged over the baseline's error, which is Gaussian,
        false alarms grow by the second term.
        """
        level = float(np.log(max(self.rate / false_alarms_per_year, np.e)))
        if 8.0 * self.drift * level >= 1.0:
            return np.inf
        h = 2.0 * level / (1.0 + float(np.sqrt(1.0 - 8.0 * self.drift * level)))
        return h if h <= MAX_LIMIT_RATIO * level else np.inf
