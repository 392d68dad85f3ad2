"""What a monitor is expected to say: the mean path of theta_hat for a given plant under a given reference.

Neither noise nor intersample behaviour is assumed away: the loop is simulated with the recording's own reference, its
regressors enter the same recursion, and the noise's mean effect on it (errors in variables) is added through its
moments. So the biases of the regression are in the expectation, and cancel from residuals and from fault sizes
(indirect inference; Gourieroux, Monfort and Renault, 1993).
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from servoscope.errors import LoopError, SimulationError
from servoscope.inverse import closed_loop, nominal_theta
from servoscope.linear import Linear, autocovariances
from servoscope.noise import Coloured, Noise, coloured
from servoscope.pipeline import Pipeline, Regressing, Regression, Tuning
from servoscope.plants import FloatArray, Plant
from servoscope.recording import Recording
from servoscope.simulation.closed_loop import Simulation

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

LONGEST_FILL = 10.0  # s; a longer gap in r tells nothing about what the loop did meanwhile


class Moments(NamedTuple):
    """The noise's share of the moments: ``c = E[phi_n eta_n]`` (n,) and ``S = E[phi_n phi_n']`` (n, n)."""

    c: FloatArray
    S: FloatArray


class Course(NamedTuple):
    """A reference on a gapless clock, and which of its samples were recorded."""

    r: FloatArray
    kept: np.ndarray[tuple[int, ...], np.dtype[np.int64]]
    restart: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]

    def of_kept(self, x: FloatArray) -> FloatArray:
        """Return the recorded samples of a signal on the gapless clock."""
        return x if len(self.kept) == len(x) else x[self.kept]


def course(recording: Recording, before: tuple[float, float] | None = None) -> Course:
    """Put r on a gapless clock; short gaps are bridged by straight lines, for simulation only.

    `before` are t and r of the row before the recording, where that is part of a longer one: its clock goes on there.
    """
    t, r = recording.t, recording.r
    if before is not None:
        t, r = np.append(before[0], t), np.append(before[1], r)
    steps = np.round(np.diff(t) * recording.sample_rate).astype(np.int64)
    steps = np.clip(steps, 1, round(LONGEST_FILL * recording.sample_rate))
    kept = np.concatenate([[0], np.cumsum(steps)])
    if kept[-1] >= len(kept):
        r = np.interp(np.arange(kept[-1] + 1), kept, r)
    begin = int(before is not None)
    return Course(np.ascontiguousarray(r[begin:], dtype=np.float64), kept[begin:] - begin, recording.restart)


def noise_system(pipeline: Pipeline, plant: Plant) -> Linear:
    """Return [n_u, n_y] -> [eta, phi] through the closed loop with a plant.

    Raises
    ------
    SimulationError
        If the loop is unstable with the plant.
    """
    try:
        noisy = closed_loop(pipeline.loop, plant).input(np.eye(3, 2, -1))
    except LoopError as error:
        raise SimulationError(str(error)) from None
    if pipeline.stage_one is not None:
        noisy = noisy.output(np.diag([0.0, 1.0]))  # u_a is simulated from r: the noise does not reach eta
    return noisy.then(pipeline.bank.linear)


def residual_system(pipeline: Pipeline, plant: Plant) -> Linear:
    """Return [n_u, n_y] -> v = eta - phi' theta through the closed loop, with the plant's own coefficients."""
    row = np.concatenate([[1.0], -nominal_theta(pipeline.loop, plant)])[None, :]
    return noise_system(pipeline, plant).output(row)


def colour_of(pipeline: Pipeline, plant: Plant, noise: Noise) -> Coloured:
    """Return the model of v for white noise in the closed loop with a plant.

    The colour is that of the filters; the power is exact: between samples the output that answers to the noise does
    not run in straight lines either, which takes a few per cent from it.
    """
    model = coloured(pipeline.bank, nominal_theta(pipeline.loop, plant), noise, pipeline.stride)
    system = residual_system(pipeline, plant).input(np.diag([noise.u_std, noise.y_std]))
    power = autocovariances(system, 0)[0, 0, 0]
    return model.times(float(power) / float(model.gamma[0]))


def noise_moments(pipeline: Pipeline, plant: Plant, noise: Noise) -> Moments:
    """Return the moments of the noise in the regressors; zero with an instrument, for E[z v] = 0 is its point."""
    n = pipeline.bank.n
    if pipeline.bank.has_instrument or not (noise.u_std or noise.y_std):
        return Moments(np.zeros(n), np.zeros((n, n)))
    system = noise_system(pipeline, plant).input(np.diag([noise.u_std, noise.y_std]))
    (covariance,) = autocovariances(system, 0)
    return Moments(covariance[1:, 0].copy(), covariance[1:, 1:].copy())


@dataclass(frozen=True)
class Expectation:
    """Expected estimates for one loop's recursion under one reference.

    Parameters
    ----------
    pipeline, tuning
        The recursion.
    noise
        Of the loop.
    course
        The reference.
    """

    pipeline: Pipeline
    tuning: Tuning
    noise: Noise
    course: Course

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
        for array in (tuning.theta, tuning.scale, tuning.P_d, numbers, *self.course):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def regression(self, plant: Plant, ill: Plant | None = None, since: int = 0) -> Regression:
        """Return the noise-free regression of the loop with a plant that may turn ill.

        Parameters
        ----------
        plant
            The plant, up to then.
        ill
            What it turns into; None: it stays as it is.
        since
            Sample of the recording from which it is ill; 0: it has always been.

        Raises
        ------
        SimulationError
            If the loop is unstable with one of the plants.
        """
        return Undisturbed(self.pipeline, plant, ill, since).advance(self.course)[0]

    def path(self, start: FloatArray, plant: Plant, ill: Plant | None = None, since: int = 0) -> FloatArray:
        """Return the mean of theta_hat at every evaluation, shape (K, n), from `start` (n,) before the first sample.

        The other arguments and errors are those of `regression`.
        """
        return self.walk(start, plant, ill, since).advance(self.course)

    def walk(self, start: FloatArray, plant: Plant, ill: Plant | None = None, since: int = 0) -> Walk:
        """Return what follows the mean of theta_hat piece by piece; the arguments are those of `path`."""
        return Walk(self, start, plant, ill, since)

    def first(self, seconds: float) -> Expectation:
        """Return the expectation for the recording's first seconds only."""
        r, kept, restart = self.course
        samples = min(round(seconds * self.pipeline.loop.sample_rate), len(kept))
        return self.under(Course(r[: int(kept[samples - 1]) + 1], kept[:samples], restart[:samples]))

    def under(self, course: Course) -> Expectation:
        """Return the expectation under another reference."""
        return replace(self, course=course)

    def healthy(self, plant: Plant, model_theta: FloatArray) -> FloatArray:
        """Return what a healthy loop would show at every evaluation, shape (K, n).

        `model_theta` is what `plant` gives under the baseline's own references; what it leaves unexplained of the
        baseline's theta is kept as a constant difference.
        """
        return self.path(model_theta, plant) + (self.tuning.theta - model_theta)

    def batch(self, plant: Plant) -> FloatArray:
        """Return what least squares over the whole reference converges to, shape (n,)."""
        return solve_scaled(*self.normal(plant))

    def normal(self, plant: Plant) -> tuple[FloatArray, FloatArray]:
        """Return the mean normal equations of least squares over the reference, shapes (n, n) and (n,)."""
        g = self.regression(plant)
        phi, z, eta = g.phi[g.ok], g.z[g.ok], g.eta[g.ok]
        c, S = self.moments(plant)
        return z.T @ phi + len(eta) * S, z.T @ eta + len(eta) * c

    def residual(self, plant: Plant, theta: FloatArray, ok: BoolArray | None = None) -> FloatArray:
        """Return the mean of v = eta - phi' theta for fixed coefficients at every usable sample, shape (M,).

        `ok` (N,) are the usable samples of the measured loop, where they are others. The mean is exact: with theta
        fixed, v is linear in u and y, and the noise has none.
        """
        g = self.regression(plant)
        return (g.eta - g.phi @ theta)[g.ok if ok is None else ok]


class Undisturbed:
    """The regression of a loop without noise whose plant may turn ill, piece by piece; see `Expectation.regression`."""

    def __init__(self, pipeline: Pipeline, plant: Plant, ill: Plant | None = None, since: int = 0) -> None:
        self.plants, onsets = in_turn(plant, ill, since)
        self._onsets = np.array(onsets)
        self._simulation, self._regressing = Simulation(pipeline.loop, self.plants), Regressing(pipeline)
        self._samples = 0

    def advance(self, course: Course) -> tuple[Regression, IntArray]:
        """Return the regression of the next piece of a reference, and which plant each sample (N,) had."""
        r, kept, restart = course
        since = self._onsets - self._samples  # in samples of this piece
        inside = (since >= 0) & (since < len(kept))
        edges = np.where(inside, kept[np.clip(since, 0, len(kept) - 1)], np.where(since < 0, 0, len(r)))
        u, _, y = self._simulation.advance(_in_turn(edges, len(r)), r)
        self._samples += len(kept)
        which = _in_turn(since, len(kept))
        r, u, y = (course.of_kept(x) for x in (r, u, y))
        return self._regressing.advance(r, u, y, restart), which


def _in_turn(edges: IntArray, samples: int) -> IntArray:
    """Return which stretch each sample belongs to, shape (N,), of those that begin at the edges, the first before 0."""
    which = np.zeros(samples, dtype=np.int64)
    for edge in edges[1:]:
        which[max(edge, 0) :] += 1
    return which


class Walk:
    """The mean of theta_hat, piece by piece; see `Expectation.path`."""

    def __init__(
        self, expectation: Expectation, start: FloatArray, plant: Plant, ill: Plant | None = None, since: int = 0
    ) -> None:
        self._pipeline, self._tuning = expectation.pipeline, expectation.tuning
        self._undisturbed = Undisturbed(self._pipeline, plant, ill, since)
        moments = [expectation.moments(each) for each in self._undisturbed.plants]
        self._moments = np.array([m.c for m in moments]), np.array([m.S for m in moments])
        self._theta, self._samples = np.array(start, dtype=np.float64), 0

    def advance(self, course: Course) -> FloatArray:
        """Return the mean at the evaluations of the next piece of a reference, shape (K, n)."""
        from servoscope.propagation import mean_path

        g, which = self._undisturbed.advance(course)
        tuning, number = self._tuning, self._samples
        self._samples += len(which)
        P_d, R, every = tuning.P_d, tuning.R, self._pipeline.every
        path = np.empty((self._samples // every - number // every, len(P_d)))
        room = np.empty((2, len(P_d)))
        mean_path(g.eta, g.phi, g.z, g.ok, which, *self._moments, P_d, R, self._theta, number, every, room, path)
        return path


def in_turn(plant: Plant, ill: Plant | None, since: int) -> tuple[list[Plant], list[int]]:
    """Return the plants that follow each other when one turns ill, and the sample from which each holds."""
    if ill is None:
        return [plant], [0]
    return ([plant, ill], [0, since]) if since else ([ill], [0])


def solve_scaled(A: FloatArray, b: FloatArray) -> FloatArray:
    """Solve A x = b for a matrix whose rows and columns have very different units."""
    s = 1.0 / np.sqrt(np.abs(np.diag(A)))
    scaled = np.linalg.lstsq(A * np.outer(s, s), (b.T * s).T, rcond=None)[0]
    return np.asarray((scaled.T * s).T, dtype=np.float64)
