"""What a monitor is expected to say: the mean path of theta_hat for a given plant under a given reference.

Neither noise nor intersample behaviour is assumed away: the loop is simulated with the recording's own reference, its
regressors enter the same recursion, and the noise's mean effect on it (errors in variables) is added through its
moments. So the biases of the regression are in the expectation, and cancel from residuals and from fault sizes
(indirect inference; Gourieroux, Monfort and Renault, 1993).
"""

from __future__ import annotations

import copy
import hashlib
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.core.errors import LoopError, SimulationError
from servoscope.estimation.filter_bank import closed_loop_system, nominal_theta
from servoscope.estimation.moments import mean_path
from servoscope.estimation.noise_model import (
    ArmaNoise,
    WhiteNoise,
    arma_from_system,
    arma_from_white_noise,
    colour_error,
)
from servoscope.estimation.pipeline import Pipeline, Regression, RegressionRunner, Tuning
from servoscope.models.lti import LinearSystem, autocovariances, solve_scaled
from servoscope.models.plants import Plant
from servoscope.signals import Recording
from servoscope.simulation.closed_loop import LoopSimulation

COLOUR_TOLERANCE = 0.1  # autocorrelation, and error of the variance, that a whitening may leave
CACHED_MODELS = 4  # models of noise per loop: a recording asks for the same again and again
MAX_FILL_S = 10.0  # s; a longer gap in r tells nothing about what the loop did meanwhile


class Moments(NamedTuple):
    """The noise's share of the moments: ``c = E[phi_n eta_n]`` (n,) and ``S = E[phi_n phi_n']`` (n, n)."""

    c: FloatArray
    S: FloatArray


class ReferencePath(NamedTuple):
    """A reference on a gapless clock, and which of its samples were recorded."""

    r: FloatArray
    recorded_index: np.ndarray[tuple[int, ...], np.dtype[np.int64]]
    restart: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]

    def at_recorded(self, x: FloatArray) -> FloatArray:
        """Return the recorded samples of a signal on the gapless clock."""
        return x if len(self.recorded_index) == len(x) else x[self.recorded_index]


NO_REFERENCE = ReferencePath(np.zeros(0), np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.bool_))


def reference_path(recording: Recording, before: tuple[float, float] | None = None) -> ReferencePath:
    """Put r on a gapless clock; short gaps are bridged by straight lines, for simulation only.

    `before` are t and r of the row before the recording, where that is part of a longer one: its clock goes on there.
    """
    t, r = recording.t, recording.r
    if before is not None:
        t, r = np.append(before[0], t), np.append(before[1], r)
    steps = np.round(np.diff(t) * recording.sample_rate).astype(np.int64)
    steps = np.clip(steps, 1, round(MAX_FILL_S * recording.sample_rate))
    kept = np.concatenate([[0], np.cumsum(steps)])
    if kept[-1] >= len(kept):
        r = np.interp(np.arange(kept[-1] + 1), kept, r)
    begin = int(before is not None)
    return ReferencePath(np.ascontiguousarray(r[begin:], dtype=np.float64), kept[begin:] - begin, recording.restart)


def reference_piece(recording: Recording, rows: slice, first: int) -> ReferencePath:
    """Return the reference of a chunk; the run began at sample `first`."""
    ahead = (float(recording.t[rows.start - 1]), float(recording.r[rows.start - 1])) if rows.start > first else None
    return reference_path(recording.rows(rows), ahead)


def noise_system(pipeline: Pipeline, plant: Plant) -> LinearSystem:
    """Return [n_u, n_y] -> [eta, phi] through the closed loop with a plant.

    Raises SimulationError if the loop is unstable with the plant.
    """
    try:
        noisy = closed_loop_system(pipeline.loop, plant).input(np.eye(3, 2, -1))
    except LoopError as error:
        raise SimulationError(str(error)) from None
    if pipeline.stage_one is not None:
        noisy = noisy.output(np.diag([0.0, 1.0]))  # u_a is simulated from r: the noise does not reach eta
    return noisy.then(pipeline.bank.linear)


def residual_system(pipeline: Pipeline, plant: Plant) -> LinearSystem:
    """Return [n_u, n_y] -> v = eta - phi' theta through the closed loop, with the plant's own coefficients."""
    row = np.concatenate([[1.0], -nominal_theta(pipeline.loop, plant)])[None, :]
    return noise_system(pipeline, plant).output(row)


def residual_noise_model(pipeline: Pipeline, plant: Plant, noise: WhiteNoise) -> ArmaNoise:
    """Return the model of v for white noise in the closed loop with a plant; the newest ones are remembered.

    The colour is that of the filters and the power exact, as long as that is nearly white noise behind the whitening:
    between samples the output that answers to the noise does not run in straight lines either, which takes a few per
    cent from it. Where a resonance makes more of that, the model is the one of the whole closed loop.
    """
    known, key = pipeline.noise_models, (plant.model_dump_json(), noise)
    model = known.get(key)
    if model is None:
        if len(known) >= CACHED_MODELS:
            known.clear()
        known[key] = model = _make_noise_model(pipeline, plant, noise)
    return model


def _make_noise_model(pipeline: Pipeline, plant: Plant, noise: WhiteNoise) -> ArmaNoise:
    model = arma_from_white_noise(pipeline.bank, nominal_theta(pipeline.loop, plant), noise, pipeline.stride)
    system = residual_system(pipeline, plant).input(np.diag([noise.u_std, noise.y_std]))
    power = float(autocovariances(system, 0)[0, 0, 0])
    model = model.times(power / float(model.gamma[0]))
    # the simple one where it does: it has four poles, and is forgotten sooner
    return (
        model
        if colour_error(model, system, pipeline.stride) <= COLOUR_TOLERANCE
        else arma_from_system(system, pipeline.stride)
    )


def noise_moments(pipeline: Pipeline, plant: Plant, noise: WhiteNoise) -> Moments:
    """Return the moments of the noise in the regressors; zero with an instrument, for E[z v] = 0 is its point."""
    n = pipeline.bank.n
    if pipeline.bank.has_instrument or not (noise.u_std or noise.y_std):
        return Moments(np.zeros(n), np.zeros((n, n)))
    system = noise_system(pipeline, plant).input(np.diag([noise.u_std, noise.y_std]))
    (covariance,) = autocovariances(system, 0)
    return Moments(covariance[1:, 0].copy(), covariance[1:, 1:].copy())


@dataclass(frozen=True)
class Expectation:
    """Expected estimates for one loop's recursion under one reference."""

    pipeline: Pipeline
    tuning: Tuning
    noise: WhiteNoise  # of the loop
    reference: ReferencePath

    @cached_property
    def _moments(self) -> dict[str, Moments]:
        return {}

    def moments(self, plant: Plant) -> Moments:
        """Return the noise's moments with a plant; remembered."""
        key = plant.model_dump_json()
        if key not in self._moments:
            self._moments[key] = noise_moments(self.pipeline, plant, self.noise)
        return self._moments[key]

    @cached_property
    def hash(self) -> str:
        """Digest of all that the path of a plant depends on: loop, recursion, noise, reference."""
        tuning, noise = self.tuning, self.noise
        numbers = np.array([tuning.R, noise.u_std, noise.y_std, self.pipeline.every])
        digest = hashlib.sha256(self.pipeline.loop.hash().encode())
        for array in (tuning.theta, tuning.scale, tuning.P_d, numbers, *self.reference):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def regression(self, plant: Plant, faulty: Plant | None = None, onset: int = 0) -> Regression:
        """Return the noise-free regression of the loop with a plant that may become faulty.

        `plant`: the plant, up to then; `faulty`: what it turns into; None: it stays as it is; `onset`: sample of the
        recording from which it is faulty; 0: it has always been; raises SimulationError if the loop is unstable with
        one of the plants.
        """
        return NoiseFreeRegression(self.pipeline, plant, faulty, onset).advance(self.reference)[0]

    def mean_path(self, start: FloatArray, plant: Plant, faulty: Plant | None = None, onset: int = 0) -> FloatArray:
        """Return the mean of theta_hat at every evaluation, shape (K, n), from `start` (n,) before the first sample.

        The other arguments and errors are those of `regression`.
        """
        return self.propagator(start, plant, faulty, onset).advance(self.reference)

    def propagator(
        self, start: FloatArray, plant: Plant, faulty: Plant | None = None, onset: int = 0
    ) -> MeanPropagator:
        """Return what follows the mean of theta_hat piece by piece; the arguments are those of `path`."""
        return MeanPropagator(self, start, plant, faulty, onset)

    def truncate(self, seconds: float) -> Expectation:
        """Return the expectation for the recording's first seconds only."""
        r, kept, restart = self.reference
        samples = min(round(seconds * self.pipeline.loop.sample_rate), len(kept))
        begin = ReferencePath(r[: int(kept[samples - 1]) + 1], kept[:samples], restart[:samples])
        return replace(self, reference=begin)

    def healthy_path(self, plant: Plant, model_theta: FloatArray) -> FloatArray:
        """Return what a healthy loop would show at every evaluation, shape (K, n).

        `model_theta` is what `plant` gives under the baseline's own references; what it leaves unexplained of the
        baseline's theta is kept as a constant difference.
        """
        return self.mean_path(model_theta, plant) + (self.tuning.theta - model_theta)

    def batch_estimate(self, plant: Plant) -> FloatArray:
        """Return what least squares over the whole reference converges to, shape (n,)."""
        return solve_scaled(*self.normal_equations(plant))

    def normal_equations(self, plant: Plant) -> tuple[FloatArray, FloatArray]:
        """Return the mean normal equations of least squares over the reference, shapes (n, n) and (n,)."""
        g = self.regression(plant)
        phi, z, eta = g.phi[g.ok], g.z[g.ok], g.eta[g.ok]
        c, S = self.moments(plant)
        return z.T @ phi + len(eta) * S, z.T @ eta + len(eta) * c

    def mean_residual(self, plant: Plant, theta: FloatArray, ok: BoolArray | None = None) -> FloatArray:
        """Return the mean of v = eta - phi' theta for fixed coefficients at every usable sample, shape (M,).

        `ok` (N,) are the usable samples of the measured loop, where they are others. The mean is exact: with theta
        fixed, v is linear in u and y, and the noise has none.
        """
        g = self.regression(plant)
        return (g.eta - g.phi @ theta)[g.ok if ok is None else ok]


class NoiseFreeRegression:
    """The regression of a loop without noise whose plant may become faulty, piece by piece."""

    def __init__(self, pipeline: Pipeline, plant: Plant, faulty: Plant | None = None, onset: int = 0) -> None:
        self.plants, onsets = plant_sequence(plant, faulty, onset)
        self._onsets, self._pipeline = np.array(onsets), pipeline
        self._simulation, self._regressing = LoopSimulation(pipeline.loop, self.plants), RegressionRunner(pipeline)
        self._samples = 0

    def again(self) -> Self:
        """Return one at the first sample, whose constants are these."""
        other = copy.copy(self)
        other._simulation, other._regressing = self._simulation.again(), RegressionRunner(self._pipeline)
        other._samples = 0
        return other

    def advance(self, reference: ReferencePath) -> tuple[Regression, IntArray]:
        """Return the regression of the next piece of a reference, and which plant each sample (N,) had."""
        r, kept, restart = reference
        onset = self._onsets - self._samples  # in samples of this piece
        inside = (onset >= 0) & (onset < len(kept))
        edges = np.where(inside, kept[np.clip(onset, 0, len(kept) - 1)], np.where(onset < 0, 0, len(r)))
        u, _, y = self._simulation.run(_segment_index(edges, len(r)), r)
        self._samples += len(kept)
        which = _segment_index(onset, len(kept))
        r, u, y = (reference.at_recorded(x) for x in (r, u, y))
        return self._regressing.advance(r, u, y, restart), which


def _segment_index(edges: IntArray, samples: int) -> IntArray:
    """Return which stretch each sample belongs to, shape (N,), of those that begin at the edges, the first before 0."""
    which = np.zeros(samples, dtype=np.int64)
    for edge in edges[1:]:
        which[max(edge, 0) :] += 1
    return which


class MeanPropagator:
    """The mean of theta_hat, piece by piece; see `Expectation.path`."""

    def __init__(
        self, expectation: Expectation, start: FloatArray, plant: Plant, faulty: Plant | None = None, onset: int = 0
    ) -> None:
        self._pipeline, self._tuning = expectation.pipeline, expectation.tuning
        self._undisturbed = NoiseFreeRegression(self._pipeline, plant, faulty, onset)
        moments = [expectation.moments(plant) for plant in self._undisturbed.plants]
        self._moments = np.array([m.c for m in moments]), np.array([m.S for m in moments])
        self._start = np.array(start, dtype=np.float64)
        self._theta, self._samples = self._start.copy(), 0

    def again(self) -> Self:
        """Return one at the first sample, whose constants are these."""
        other = copy.copy(self)
        other._undisturbed, other._theta, other._samples = self._undisturbed.again(), self._start.copy(), 0
        return other

    def advance(self, reference: ReferencePath) -> FloatArray:
        """Return the mean at the evaluations of the next piece of a reference, shape (K, n)."""
        g, which = self._undisturbed.advance(reference)
        tuning, number = self._tuning, self._samples
        self._samples += len(which)
        P_d, R, every = tuning.P_d, tuning.R, self._pipeline.every
        path = np.empty((self._samples // every - number // every, len(P_d)))
        signals = (np.ascontiguousarray(part) for part in (g.eta, g.phi, g.z, g.ok, which))
        mean_path(*signals, *self._moments, P_d, R, self._theta, number, every, path, n=len(P_d))
        return path


def plant_sequence(plant: Plant, faulty: Plant | None, onset: int) -> tuple[list[Plant], list[int]]:
    """Return the plants that follow each other when one becomes faulty, and the sample from which each holds."""
    if faulty is None:
        return [plant], [0]
    return ([plant, faulty], [0, onset]) if onset else ([faulty], [0])
