"""Coefficients by refined instrumental variables, and whether u may be the source of the instrument."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.estimation.instrument import FOLDS, InstrumentTuning, Source, fit_reference_model, fold_of
from servoscope.estimation.noise_model import sample_autocovariance, yule_walker
from servoscope.estimation.pipeline import Pipeline, Regression
from servoscope.fit.tuning import TuningFit, fit_tuning, least_squares
from servoscope.signals import Recording

MAX_ROUNDS = 20  # of refinement; a fit that needs more does not settle
ROUND_TOLERANCE = 1e-3  # relative change of each coefficient of a round, below which it has settled
# stated relative standard deviation, above which an estimate is no better than its bias; near the deviation itself only
# those would pass that came out too large
MAX_RELATIVE_STD = 0.2
FEEDBACK_LAGS = 6  # samples, from 0 on, in which a controller answers noise in y
FEEDBACK_ORDER = 20  # of the autoregressions that whiten u and the residual
MIN_FEEDBACK_SAMPLES = 200  # samples of a recording that the question is asked of
FEEDBACK_FALSE_ALARMS = 1e-6  # probability with which a u without feedback may be taken for one with it


@dataclass(frozen=True, eq=False)
class InstrumentalFit:
    """What refined instrumental variables make of recordings."""

    pipeline: Pipeline
    regressions: list[Regression]
    fit: TuningFit
    settled: bool
    # the least certain coefficient of a power of s, and its relative standard deviation
    weakest: str
    deviation: float

    @property
    def trusted(self) -> bool:
        """Whether the estimate says enough to take the place of a biased one."""
        return self.settled and self.deviation <= MAX_RELATIVE_STD


def fit_with_instrument(
    pipeline: Pipeline, recordings: Sequence[Recording], source: Source, theta: FloatArray
) -> InstrumentalFit | None:
    """Fit the coefficients; with u as the source the model behind the instrument is refined from `theta` (n,) on.

    The loop of the pipeline takes an estimator with an instrument in the fit. None where the source tells nothing.
    """
    tuning = None if source == "input" else fit_reference_model(recordings)
    if source == "reference" and tuning is None:
        return None
    settled, powers = False, len(pipeline.loop.plant.powers)
    monitor = pipeline.loop.monitor.model_copy(update={"estimator": "iv-akf"})
    loop = pipeline.loop.model_copy(update={"monitor": monitor})
    for _ in range(MAX_ROUNDS):
        model = tuning or InstrumentTuning("input", tuple(theta[:powers].tolist()))
        pipeline = Pipeline.of(loop, None, pipeline.still_speed, model)
        regressions = [pipeline.regression(rec.r, rec.u, rec.y, rec.restart) for rec in recordings]
        if tuning is not None:
            regressions = _held_out(pipeline, recordings, regressions)
        before, theta = theta, least_squares(_joined(regressions))
        settled = bool(np.all(np.abs(theta - before)[:powers] <= ROUND_TOLERANCE * np.abs(theta[:powers])))
        if settled or tuning is not None or not np.isfinite(theta).all():
            break
    if not (np.isfinite(theta).all() and theta[powers - 1]):
        return None
    fit = fit_tuning(pipeline, regressions)
    relative = np.sqrt(np.diag(fit.covariance))[:powers] / np.abs(fit.tuning.theta[:powers])
    worst = int(np.argmax(relative))
    return InstrumentalFit(
        pipeline, regressions, fit, settled or tuning is not None, pipeline.bank.names[worst], float(relative[worst])
    )


def _held_out(
    pipeline: Pipeline, recordings: Sequence[Recording], regressions: Sequence[Regression]
) -> list[Regression]:
    """Return the regressions with z, in each fold, from a model r -> y that has not seen the fold.

    The weights of a model carry the noise of y that it was fitted to. Used on the same samples, z is correlated with
    the noise in phi, and where the motion says little the estimate is pulled back to that of least squares (Angrist,
    Imbens and Krueger, 1999: jackknife instruments).
    """
    z = np.vstack([g.z for g in regressions])
    folds = fold_of(len(z))
    for fold in range(FOLDS):
        model = fit_reference_model(recordings, fold)
        if model is None:
            continue
        other = Pipeline.of(pipeline.loop, None, pipeline.still_speed, model)
        made = np.vstack([other.regression(rec.r, rec.u, rec.y, rec.restart).z for rec in recordings])
        z[folds == fold] = made[folds == fold]
    ends = np.cumsum([len(g.z) for g in regressions])[:-1]
    return [Regression(g.eta, g.phi, own, g.ok) for g, own in zip(regressions, np.split(z, ends), strict=True)]


def has_feedback(pipeline: Pipeline, recordings: Sequence[Recording], theta: FloatArray) -> bool:
    """Return whether u answers the noise of y, which rules it out as the source of an instrument.

    Steps of u and the residual of `theta` (n,) are whitened; in a loop without feedback the step of u at a sample then
    has nothing to do with the residual of this sample and of those before (Haugh, 1976), even if the model is wrong:
    y answers u later. The filters are wide here, for a slow one hides the sample at which noise came.
    """
    from scipy import special

    wide = pipeline.loop.monitor.model_copy(update={"cutoff": None, "estimator": "akf"})
    wide_pipeline = Pipeline.of(pipeline.loop.model_copy(update={"monitor": wide}), None, pipeline.still_speed)
    for rec in recordings:
        g = wide_pipeline.regression(rec.r, rec.u, rec.y, rec.restart)
        used = np.flatnonzero(g.ok)
        residual, step = (g.eta - g.phi @ theta)[used][1:], np.diff(rec.u[used])
        if len(step) < MIN_FEEDBACK_SAMPLES or not (step.any() and residual.any()):
            continue
        a, b = (_whitened(x) for x in (step, residual))
        n = len(a)
        rho = np.array([np.mean(a[lag:] * b[: n - lag]) for lag in range(FEEDBACK_LAGS)])
        if special.chdtrc(FEEDBACK_LAGS, n * float(rho @ rho)) < FEEDBACK_FALSE_ALARMS / len(recordings):
            return True
    return False


def _whitened(x: FloatArray) -> FloatArray:
    white = yule_walker(sample_autocovariance([x], FEEDBACK_ORDER)).whiten(x)
    return np.asarray(white / np.sqrt(np.mean(white**2)))


def _joined(regressions: Sequence[Regression]) -> Regression:
    parts = [(g.eta[g.ok], g.phi[g.ok], g.z[g.ok]) for g in regressions]
    eta, phi, z = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return Regression(eta, phi, z, np.ones(len(eta), dtype=np.bool_))
