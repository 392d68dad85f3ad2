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
from servoscope.pipeline import Pipeline, Regression, Tuning
from servoscope.plants import FloatArray, Plant
from servoscope.recording import Recording
from servoscope.simulation import response

BoolArray = npt.NDArray[np.bool_]

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


def course(recording: Recording) -> Course:
    """Put r on a gapless clock; short gaps are bridged by straight lines, for simulation only."""
    steps = np.round(np.diff(recording.t) * recording.sample_rate).astype(np.int64)
    steps = np.clip(steps, 1, round(LONGEST_FILL * recording.sample_rate))
    kept = np.concatenate([[0], np.cumsum(steps)])
    r = np.interp(np.arange(kept[-1] + 1), kept, recording.r)
    return Course(np.asarray(r, dtype=np.float64), kept, recording.restart)


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
        r, kept, restart = self.course
        plants, onsets = in_turn(plant, ill, since)
        u, y = response(self.pipeline.loop, r, plants=plants, switch=[int(kept[k]) for k in onsets])
        return self.pipeline.regression(r[kept], u[kept], y[kept], restart)

    def path(self, start: FloatArray, plant: Plant, ill: Plant | None = None, since: int = 0) -> FloatArray:
        """Return the mean of theta_hat at every evaluation, shape (K, n), from `start` (n,) before the first sample.

        The other arguments and errors are those of `regression`.
        """
        from servoscope.propagation import mean_path

        g = self.regression(plant, ill, since)
        plants, onsets = in_turn(plant, ill, since)
        which = np.searchsorted(np.asarray(onsets), np.arange(len(g.ok)), side="right") - 1
        moments = [self.moments(each) for each in plants]
        return mean_path(
            g.eta,
            g.phi,
            g.z,
            g.ok,
            which,
            np.array([m.c for m in moments]),
            np.array([m.S for m in moments]),
            self.tuning.P_d,
            self.tuning.R,
            np.asarray(start, dtype=np.float64),
            self.pipeline.every,
        )

    def first(self, seconds: float) -> Expectation:
        """Return the expectation for the recording's first seconds only."""
        return self.until(min(round(seconds * self.pipeline.loop.sample_rate), len(self.course.kept)))

    def until(self, samples: int) -> Expectation:
        """Return the expectation for the recording's first samples only."""
        r, kept, restart = self.course
        shorter = Course(r[: int(kept[samples - 1]) + 1], kept[:samples], restart[:samples])
        return replace(self, course=shorter)

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
