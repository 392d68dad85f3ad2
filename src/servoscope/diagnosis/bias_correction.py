"""The estimates of an examination without the biases of the regression, and the trace made of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from servoscope.baseline.expectation import Expectation
from servoscope.core import outofcore
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import SimulationError
from servoscope.detection.onset import Onset
from servoscope.detection.trace import Trace
from servoscope.diagnosis.result import VIBRATION, FinalCoefficient, ResponsePoint
from servoscope.estimation import frequency_response
from servoscope.estimation.filter_bank import nominal_theta
from servoscope.estimation.frequency_response import FrequencyResponse, response_rows
from servoscope.evidence.examination import Examination
from servoscope.fit.search import Experiment, fit
from servoscope.isolation.candidate import UNKNOWN, Candidate
from servoscope.models.plants import Plant

AT_ONCE = 4096  # evaluations whose responses are computed together
PRIOR_LOG_STD = 3.0  # standard deviation of the logarithm of a parameter before anything is known
STEP = 1e-3  # of the logarithm of a parameter, for derivatives
EXACT = 1e-9  # of the squared distance in standard deviations: a trace is made of it, not only a size
MAX_STEPS = 12  # of the search for the actuator


@dataclass(frozen=True, eq=False)
class BiasCorrection:
    """How estimates become those of the actuator itself.

    After a change, the past that theta_hat has not forgotten yet is a bias too. The covariance becomes that of the
    estimate alone: the noise in the coefficients under the fitted actuator, and what is left of the initial value. The
    actuator was fitted to one evaluation, whose noise is in the bias, and so in all evaluations after the change.
    """

    gain: FloatArray  # how an error of theta_hat at `evaluation` reaches the corrected coefficients, shape (n, n)
    evaluation: int  # to which the actuator was fitted
    faulty_plant: Plant | None = None  # the fitted actuator; None where nothing changed
    onset_sample: int = 0


def estimate_bias_correction(
    exam: Examination, candidates: Sequence[Candidate], onset: Onset | None, at: int
) -> BiasCorrection | None:
    """Fit the actuator to evaluation `at`; None where the loop cannot be simulated. No onset means no change."""
    e, baseline = exam.estimates, exam.baseline
    if exam.noise is None or not exam.evaluations or not e.updates[at] > 0 or baseline.loop.monitor.structure != "svf":
        return None
    if onset is None:
        return BiasCorrection(np.eye(exam.pipeline.bank.n), at)
    likely = next((c for c in candidates if c.name != UNKNOWN), None)
    ratios = {fault.parameter: fault.ratio for fault in likely.faults} if likely else {}
    ratios.pop(VIBRATION, None)  # it changes no parameter
    guess = baseline.plant.expand_rays(ratios)
    first, start = exam.memory_start(at), np.array(baseline.healthy.theta)
    expectation, since = exam.expectation(first, int(e.index[at]) + 1), max(onset.sample - first, 0)
    plant, gain = fit_actuator(expectation, baseline.plant, start, e.theta[at], exam.covariance(at), since, guess)
    return BiasCorrection(gain, at, plant, onset.sample)


def corrected_trace(exam: Examination, correction: BiasCorrection | None, at: slice | None = None) -> Trace:
    """Return the trace of an examination, all of it or some evaluations: estimates without bias, and responses."""
    at = slice(0, exam.evaluations) if at is None else at
    e, baseline, K = exam.estimates, exam.baseline, at.stop - at.start
    n, f = exam.pipeline.bank.n, np.asarray(baseline.loop.monitor.frequencies, dtype=np.float64)
    F, shape = len(f), outofcore.empty
    theta, covariance, expected = shape((K, n)), shape((K, n, n)), shape((K, n))
    response, healthy = (FrequencyResponse(f, shape((K, F), np.complex128), shape((K, F, 2, 2))) for _ in range(2))
    faulty = _faulty_path(exam, correction, at)
    for rows in outofcore.iter_chunks(0, K, e.S, e.Psi, e.theta, exam.expected, at_once=AT_ONCE):
        part = slice(at.start + rows.start, at.start + rows.stop)
        th, S, th0 = _correct_bias(
            exam, correction, part, *(None if array is None else array[rows] for array in faulty)
        )
        theta[rows], covariance[rows], expected[rows] = th, S, th0
        for whole, estimate, spread in (
            (response, th, S),
            (healthy, th0, np.broadcast_to(baseline.covariance_array(), S.shape)),
        ):
            piece = frequency_response.frequency_response(exam.pipeline.bank, f, estimate, spread)
            whole.H[rows], whole.covariance[rows] = piece.H, piece.covariance
        outofcore.release(theta, covariance, expected, response.H, response.covariance, healthy.H, healthy.covariance)
    ready, crossed = exam.ready[at], e.crossed[at].astype(np.int64)
    passed = np.full(K, np.nan)
    passed[crossed > 0] = exam.recording.t[crossed[crossed > 0] - 1]
    return Trace(
        t=exam.t(at),
        names=exam.pipeline.bank.names,
        theta=theta,
        covariance=covariance,
        expected=expected,
        statistic=np.where(ready, exam.statistic[at], 0.0),
        threshold=baseline.thresholds.statistic,
        level=e.level[at],
        crossed=passed,
        ifrf=response,
        ifrf_expected=healthy,
        ready=ready,
        features=None if exam.features is None else exam.features.at(e.index[at]),
    )


def _faulty_path(
    exam: Examination, correction: BiasCorrection | None, at: slice
) -> tuple[FloatArray | None, FloatArray | None]:
    """Return the expected path of the faulty actuator and the covariance under its noise, None where not known."""
    if correction is None or correction.faulty_plant is None or at.start == at.stop:
        return None, None
    spread = exam.covariance_under(at, correction.faulty_plant) if exam.baseline.healthy.loudest is not None else None
    return exam.expected_path(at, correction.faulty_plant, correction.onset_sample), spread


def _correct_bias(
    exam: Examination, correction: BiasCorrection | None, at: slice, path: FloatArray | None, spread: FloatArray | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return theta, its covariance and what a healthy loop would show, without biases as far as they are known."""
    e, C, expected = exam.estimates, exam.baseline.covariance_array(), exam.expected[at]
    if correction is None:
        return e.theta[at], exam.covariance(at), expected
    plant, start = exam.baseline.plant, np.array(exam.baseline.healthy.theta)
    true = nominal_theta(exam.pipeline.loop, plant)
    # the healthy path: what was expected, without what the model leaves unexplained
    bias = shift = expected - (exam.tuning.theta - start) - true
    S, late = exam.noise_growth * e.S[at], np.zeros(len(e.index[at]), dtype=np.bool_)
    if correction.faulty_plant is not None and path is not None:
        late = e.index[at] >= correction.onset_sample
        bias = path - np.where(late[:, None], nominal_theta(exam.pipeline.loop, correction.faulty_plant), true)
        S = S if spread is None else np.where(late[:, None, None], spread, S)
    covariance = S + e.Psi[at] @ C @ np.swapaxes(e.Psi[at], -1, -2)
    if late.any():
        covariance[late] = _corrected_covariance(exam, correction, covariance[late], e.updates[at][late])
    return e.theta[at] - bias, covariance, expected - shift


def _corrected_covariance(
    exam: Examination, correction: BiasCorrection, covariance: FloatArray, updates: FloatArray
) -> FloatArray:
    """Return the covariance of theta_hat less a bias that comes from one evaluation, shape (K, n, n).

    With e the error of an evaluation, e_0 that of the one, G the gain: e + (G - 1) e_0. Both errors share the noise
    that theta_hat has not forgotten between them, exp(-lag / memory) of it.
    """
    lag = np.abs(updates - exam.estimates.updates[correction.evaluation])
    shared = np.exp(-lag / exam.pipeline.memory)[:, None, None]
    G, M = correction.gain, correction.gain - np.eye(len(correction.gain))
    corrected: FloatArray = shared * (G @ covariance @ G.T) + (1.0 - shared) * (covariance + M @ covariance @ M.T)
    return corrected


def fit_actuator(
    expectation: Expectation,
    healthy: Plant,
    start: FloatArray,
    theta: FloatArray,
    S: FloatArray,
    since: int,
    guess: Mapping[str, float],
) -> tuple[Plant, FloatArray]:
    """Return the actuator whose expected estimate is `theta`, and the gain of `BiasCorrection`.

    `start`: theta_hat before the first sample, (n,); `theta`: estimate of the last evaluation of `expectation`, (n,),
    with covariance `S`; `since`: sample of the onset; `guess`: ratios from which the search starts.
    """
    names = healthy.parameters
    size = np.sqrt(np.diag(S))
    L = np.linalg.cholesky(S / np.outer(size, size) + 1e-9 * np.eye(len(size)))

    def faulty(x: FloatArray) -> Plant:
        return healthy.with_ratios(dict(zip(names, np.exp(x).tolist(), strict=True)))

    def expected(x: FloatArray) -> FloatArray:
        last: FloatArray = expectation.mean_path(start, healthy, faulty(x), since)[-1]
        return last

    def misfit(x: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.solve(L, (theta - expected(x)) / size))

    begin = np.log([guess.get(name, 1.0) for name in names])
    try:
        expected(begin)
    except SimulationError:  # a size far from healthy may make the loop unstable
        begin = np.zeros(len(names))
    experiment = Experiment(misfit, np.full(len(names), PRIOR_LOG_STD), difference=STEP)
    x = fit(experiment, begin, steps=MAX_STEPS, tolerance=EXACT).x
    here = expected(x)
    J, T = np.empty((len(theta), len(names))), np.empty((len(theta), len(names)))
    loop = expectation.pipeline.loop
    true = nominal_theta(loop, faulty(x))
    for i, e in enumerate(np.eye(len(names))):
        moved = x + STEP * e
        J[:, i] = (expected(moved) - here) / STEP
        T[:, i] = (nominal_theta(loop, faulty(moved)) - true) / STEP
    white = np.linalg.solve(L, J / size[:, None])
    fitted = np.linalg.solve(white.T @ white + np.eye(len(names)) / PRIOR_LOG_STD**2, white.T @ np.linalg.inv(L) / size)
    return faulty(x), np.eye(len(theta)) + (T - J) @ fitted


def final_coefficients(trace: Trace) -> dict[str, FinalCoefficient]:
    """Return the coefficients at the end of a trace."""
    if not len(trace.t):
        return {}
    std = np.sqrt(np.diag(trace.covariance[-1]))
    return {
        name: FinalCoefficient(value=float(value), std=float(s), nominal=float(nominal))
        for name, value, s, nominal in zip(trace.names, trace.theta[-1], std, trace.expected[-1], strict=True)
    }


def final_response(trace: Trace) -> tuple[ResponsePoint, ...]:
    """Return the iFRF at the end of a trace."""
    if not len(trace.t):
        return ()
    rows = response_rows(trace.ifrf, trace.ifrf_expected, -1)
    columns = np.column_stack([rows[:, :3], np.sqrt(rows[:, [5, 7]]), rows[:, 3:5]])
    names = ResponsePoint.model_fields
    return tuple(ResponsePoint(**dict(zip(names, row, strict=True))) for row in columns.tolist())
