"""Recordings of one linear plant by the exact predictor of y from u as logged: parameters, noise and delay.

Given y, an exact controller makes u carry nothing more, so the likelihood of y given the logged u is the joint one, in
closed loop too, and no controller is needed: ``x+ = A x + b_now (u[k-m] + n_u) + b_late (u[k-m-1] + n_u),
y = c x + n_y`` with white n_u and n_y (Ljung, 1999, section 13.4). The level of the noise is concentrated out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray, IndexArray
from servoscope.estimation.noise_model import WhiteNoise
from servoscope.fit.kernels import samples_since_restart
from servoscope.fit.predictor import MAX_GAIN_SAMPLES, Predictor, PredictorFactory
from servoscope.fit.search import Experiment, Fit
from servoscope.fit.tuning import sandwich_covariance, sum_covariance
from servoscope.models.discretise import split_delay
from servoscope.models.loop import Loop
from servoscope.models.plants import Column, Plant
from servoscope.signals import Recording

MAX_SAMPLES = 60_000  # samples of a recording that are looked at
NOISE_PRIOR = 3.0  # standard deviation of the logarithm of the ratio of the noises
MIN_NOISE_RATIO = 1e-3  # of the noise on y relative to that on u, in their usual units: what is quieter was simulated
SILENT_NOISE_SHARE = 1e-6  # of the noise's variance at the start: what is quieter was simulated without any
MAX_LOGARITHM = 6.0  # of a parameter relative to its start, and of the ratio of the noises
DIFFERENCE, DELAY_DIFFERENCE = 1e-5, 1e-3  # of a logarithm, and of samples of delay, for derivatives
LAGS = 20  # samples, up to which innovations are correlated with themselves
MAX_AUTOCORRELATION = 0.1  # of innovations, up to which a plant is believed to be of the kind of the loop file


@dataclass(frozen=True, eq=False)
class PlantExperiment:
    """Recordings, the plant to begin with, and the rows that all delays have in common.

    Unknowns are, in this order: logarithms of the parameters `names` relative to the plant's, (m,); that of the ratio
    of n_u to n_y, relative to the start; a constant of u, where the plant has one; samples of delay.
    """

    loop: Loop
    plant: Plant
    names: tuple[str, ...]  # parameters of the plant that may be free, m
    spread: FloatArray  # standard deviations of the logarithms of these, shape (m,)
    factory: PredictorFactory  # noise in it: where the search begins
    u: FloatArray  # what acted, but for the delay
    rows: IndexArray  # samples that are predicted, none of whose inputs lies before its run, shape (N,)
    y: FloatArray  # shape (N,)
    restart: BoolArray  # shape (N,)
    latest: int  # samples, the longest delay
    offset: float  # unit of the constant that is taken off u; 0: none

    @classmethod
    def from_recordings(
        cls,
        loop: Loop,
        recordings: Sequence[Recording],
        plant: Plant,
        names: tuple[str, ...],
        spread: FloatArray,
        noise: WhiteNoise,
        latest: int | None = None,
    ) -> PlantExperiment:
        """Prepare recordings for delays of up to `latest` samples, that of the loop file and one more if None."""
        latest = math.ceil(loop.delay * loop.sample_rate) if latest is None else latest
        heads = [slice(0, min(rec.samples, MAX_SAMPLES)) for rec in recordings]
        logged = np.concatenate([rec.u[head] for rec, head in zip(recordings, heads, strict=True)])
        u = plant_input(loop, logged)
        y = np.concatenate([rec.y[head] for rec, head in zip(recordings, heads, strict=True)])
        restart = np.concatenate([begun(rec.restart[head]) for rec, head in zip(recordings, heads, strict=True)])
        rows = np.flatnonzero(samples_since_restart(restart, latest + 2) > latest)
        base = loop.model_copy(update={"plant": plant, "delay": 0.0})
        return cls(
            loop,
            plant,
            names,
            spread,
            PredictorFactory.from_input(base, noise, logged),
            u,
            rows,
            y[rows],
            np.diff(rows, prepend=-2) != 1,
            latest,
            float(u.std()) if Column.CONSTANT in plant.extras else 0.0,
        )

    @cached_property
    def search(self) -> Experiment:
        """The experiment that is searched."""
        others = 1 + bool(self.offset)
        prior = np.concatenate([self.spread, [NOISE_PRIOR, 1.0][:others], [np.inf]])
        low, high = (np.full(len(prior), way * MAX_LOGARITHM) for way in (-1.0, 1.0))
        low[-1], high[-1] = 0.0, self.latest
        differences = np.full(len(prior), DIFFERENCE)
        differences[-1] = DELAY_DIFFERENCE
        return Experiment(self.innovations, prior, False, low, high, differences)

    @property
    def all_but_delay(self) -> IndexArray:
        """Unknowns that are free where the delay is not."""
        return np.arange(len(self.search.prior) - 1)

    def start(self, parameters: FloatArray | None = None, delay: float | None = None) -> FloatArray:
        """Return where a search begins: logarithms of the parameters, the file's if None, and samples of delay."""
        x = np.zeros(len(self.search.prior))
        x[: len(self.names)] = 0.0 if parameters is None else parameters
        x[-1] = self.loop.delay * self.loop.sample_rate if delay is None else delay
        return x

    def noise(self, x: FloatArray) -> WhiteNoise:
        """Return the noise of some unknowns, relative to the level of the start."""
        start = self.factory.noise
        return WhiteNoise(u_std=start.u_std * math.exp(x[len(self.names)]), y_std=start.y_std)

    def fitted_noise(self, fitted: Fit) -> WhiteNoise | None:
        """Return the noise of a fit, at the level of its innovations; None without noise, or where nothing fits."""
        e = self.standardised(fitted.x)[0] if np.isfinite(fitted.cost) else np.zeros(1)
        level = float(e @ e) / len(e)
        return None if level < SILENT_NOISE_SHARE else self.noise(fitted.x).times(math.sqrt(level))

    def innovations(self, x: FloatArray) -> FloatArray:
        """Return innovations whose sum of squares ranks as the likelihood does, shape (N,)."""
        e, volume = self.standardised(x)
        return np.asarray(e * math.exp(0.5 * volume))

    def standardised(self, x: FloatArray) -> tuple[FloatArray, float]:
        """Return innovations in standard deviations at the level of the start, (N,), and their mean log variance."""
        m, rate = len(self.names), self.loop.sample_rate
        plant = self.plant.scaled(dict(zip(self.names, np.exp(x[:m]).tolist(), strict=True)))
        whole, fraction = split_delay(float(x[-1]) / rate, rate)
        constant = self._nominal_offset + x[m + 1] * self.offset if self.offset else 0.0
        u = self.u[self.rows - whole] - constant
        predictor = self.factory.predictor(plant, later_s=fraction / rate, noise=self.noise(x))
        e = self._predicted(predictor, u, self.y)
        if fraction:
            # a predictor takes the input before a restart to be that at it; here it is known, and the likelihood would
            # jump at whole samples of delay without it
            missed = np.where(self.restart, self.u[self.rows - whole - 1] - self.u[self.rows - whole], 0.0)
            late = predictor._replace(b=predictor.b_late, b_late=np.zeros_like(predictor.b_late))
            e += self._predicted(late, missed, np.zeros_like(self.y))
        return e, float(np.log(predictor.S[0])[self.age].mean())

    def _predicted(self, predictor: Predictor, u: FloatArray, y: FloatArray) -> FloatArray:
        return np.asarray(predictor.innovations(0, 0, u, y, self.restart), dtype=np.float64)

    @cached_property
    def age(self) -> IndexArray:
        """Samples since a restart, as far as the gains change with them, shape (N,)."""
        return samples_since_restart(self.restart, MAX_GAIN_SAMPLES)

    @property
    def _nominal_offset(self) -> float:
        nominal = dict(zip(self.plant.names, self.plant.theta(), strict=True)) if self.plant.has_physics else {}
        return float(nominal.get("offset", 0.0)) / self.plant.input_gain


def initial_noise(loop: Loop, recordings: Sequence[Recording], noise: WhiteNoise | None) -> WhiteNoise | None:
    """Return the noise that a search begins with; None where the exact predictor cannot be written down.

    That is so where the noise is unknown, the plant is not linear, or the input is not held.
    """
    plant = loop.plant
    if noise is None or not noise.y_std > 0.0 or loop.hold != "zoh":
        return None
    if not plant.has_physics or not plant.linear or plant.extras:
        return None
    least = MIN_NOISE_RATIO * float(np.mean([rec.u.std() for rec in recordings]))
    return WhiteNoise(u_std=max(noise.u_std, least), y_std=noise.y_std)


def robust_covariance(fitted: Fit) -> FloatArray:
    """Return the covariance of a fit with each standard deviation that of correlated innovations, where larger."""
    C, score = fitted.covariance, fitted.weight * fitted.jacobian * fitted.residual[:, None]
    X = sum_covariance(score, LAGS) + fitted.prior_information
    robust = sandwich_covariance(C, X, np.ones(len(C)))
    factor = np.sqrt(np.maximum(np.diag(robust) / np.maximum(np.diag(C), 1e-300), 1.0))
    return np.asarray(C * np.outer(factor, factor))


def begun(restart: BoolArray) -> BoolArray:
    """Return restarts (N,) of which the first sample is one."""
    first = restart.copy()
    first[:1] = True
    return first


def plant_input(loop: Loop, u: FloatArray) -> FloatArray:
    """Return what acted on the plant, (N,): u within limits, nothing inside the dead zone, less on the rod's side."""
    if loop.input_logged == "before_limiter" and loop.input_limits is not None:
        u = np.clip(u, *loop.input_limits)
    if loop.input_deadzone is not None:
        low, high = loop.input_deadzone
        u = np.where((u >= low) & (u <= high), 0.0, u)
    return loop.plant.effective_input(u)
