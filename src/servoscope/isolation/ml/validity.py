"""Whether the exact predictor explains the healthy recordings, and with which noise: only then is a refit worth it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.records import ExactPredictorFit
from servoscope.core.arrays import FloatArray
from servoscope.fit.plant_experiment import MAX_SAMPLES, PlantExperiment, initial_noise
from servoscope.fit.search import fit, raise_unknown
from servoscope.isolation.ml.goodness_of_fit import misspecification_columns, score_test
from servoscope.isolation.ml.window import ChangeProfile, RefitWindow
from servoscope.signals import Recording

MAX_LOUDER = 3.0  # logarithm of how much louder n_u may be, relative to n_y, than the recursion's residual shows
BISECTIONS = 6


def fit_exact_predictor(baseline: Baseline, recordings: Sequence[Recording]) -> ExactPredictorFit | None:
    """Return the noise that makes the innovations of healthy recordings likeliest, and what they leave unexplained.

    None where the predictor cannot be written down. n_u is the loudest that the innovations allow: their likelihood has
    fallen by exp(-`LIKELIHOOD_DROP`) there.
    """
    loop = baseline.loop
    begin = initial_noise(loop, recordings, baseline.healthy.noise)
    if begin is None or loop.monitor.model_error:
        return None
    recorded = PlantExperiment.from_recordings(loop, recordings, baseline.plant, (), np.zeros(0), begin)
    likely = fit(recorded.search, recorded.start(), recorded.all_but_delay)

    def cost(x: FloatArray) -> float:
        return 0.5 * recorded.search.at(x.copy(), likely.free).cost

    # a minute hardly tells how loud n_u is: too much of it costs little, too little makes slow errors look certain
    loudest = raise_unknown(cost, likely.x, 0, MAX_LOUDER, BISECTIONS)
    noise = recorded.fitted_noise(recorded.search.at(loudest, likely.free))
    if noise is None:
        return None
    explained = baseline.model_copy(update={"exact": ExactPredictorFit(noise=noise, misfit=0.0)})
    windows = (RefitWindow.from_recording(explained, rec, 0, min(rec.samples, MAX_SAMPLES)) for rec in recordings)
    return ExactPredictorFit(noise=noise, misfit=max(_misfit(window) for window in windows))


def _misfit(window: RefitWindow) -> float:
    """Return the score statistic of a healthy window over its limit."""
    m, always = window.nuisance_count, ChangeProfile(window.samples)
    nothing = np.zeros(m)
    residual = window.residual(nothing, (), always)
    jacobian = window.jacobian(nothing, (), always)
    noise_variance = float(residual @ residual) / window.samples
    Z = misspecification_columns(window, window.healthy, always, np.ones(window.samples, dtype=np.bool_))
    goodness_of_fit = score_test(Z, jacobian, residual, noise_variance, 0.0)
    return goodness_of_fit.statistic / goodness_of_fit.limit
