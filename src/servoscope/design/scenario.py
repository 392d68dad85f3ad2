"""A recording that is to come: the loop under a reference, and what a change would leave in the innovations.

One realisation of the noise is part of it: what reaches u through the controller moves the actuator as well, and where
the reference is smooth that tells more than the reference does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import BaselineError, LoopError, SimulationError
from servoscope.estimation.noise_model import WhiteNoise
from servoscope.fit.predictor import Predictor
from servoscope.isolation.ml.least_squares import orthonormal_basis
from servoscope.isolation.ml.search import BEFORE_S
from servoscope.isolation.ml.start_values import GRID
from servoscope.isolation.ml.window import ChangeProfile, RefitWindow
from servoscope.models.loop import Loop
from servoscope.signals import Recording
from servoscope.simulation import FaultEvent, simulate
from servoscope.simulation.measurement import check_reference

LEAD = 300  # samples before the onset, after which a predictor knows the state
SEED = 3  # of the noise; it is the same whatever changes
MIN_CHANGED_SAMPLES = 50  # samples with the change


@dataclass(frozen=True, eq=False)
class Scenario:
    """What is studied; build it with `of`."""

    baseline: Baseline  # what healthy looks like
    r: FloatArray  # reference of the recording, shape (N,)
    onset: int  # first sample with the change; what is before is healthy
    # inverse of a root of the covariance that the healthy parameters' logarithms have when the healthy seconds before
    # the onset are known as well, shape (m, m)
    prior: FloatArray

    @classmethod
    def from_baseline(cls, baseline: Baseline, r: FloatArray, after_s: float = 30.0) -> Self:
        """Prepare the study of changes that are `after_s` [s] old when the reference r (N,) ends.

        Raises BaselineError, LoopError if the loop cannot be simulated, or not by the exact predictor; raises
        SimulationError if r is no reference, or shorter than `after_s`.
        """
        require_study(baseline)
        r = check_reference(r)
        after = round(after_s * baseline.loop.sample_rate)
        if not MIN_CHANGED_SAMPLES <= after <= len(r):
            least = MIN_CHANGED_SAMPLES / baseline.loop.sample_rate
            longest = len(r) / baseline.loop.sample_rate
            raise SimulationError(f"{after_s:g} s after the onset: give at least {least:g} s, at most {longest:g} s")
        plain = cls(baseline, r, len(r) - after, np.zeros((0, 0)))
        return replace(plain, prior=plain._prior_before_onset())

    @property
    def loop(self) -> Loop:
        """The loop."""
        return self.baseline.loop

    @property
    def noise(self) -> WhiteNoise:
        """Its noise."""
        return self.baseline.exact.noise if self.baseline.exact else WhiteNoise(0.0, 0.0)  # `of` made sure of the first

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters of the k faults."""
        return tuple(fault.parameter for fault in self.loop.plant.faults)

    @property
    def after_s(self) -> float:
        """Seconds with the change."""
        return (len(self.r) - self.onset) / self.loop.sample_rate

    @property
    def lead_samples(self) -> int:
        """Samples of a window before the onset."""
        return min(self.onset, LEAD)

    @property
    def profile(self) -> ChangeProfile:
        """The change, in samples of a window."""
        return ChangeProfile(self.lead_samples)

    def window(self, ratios: Mapping[str, float]) -> RefitWindow:
        """Return what a refit would see of parameters that change to so many times their values."""
        onset_s = self.onset / self.loop.sample_rate
        recording = self._simulate_recording([FaultEvent(name, ratio, onset_s) for name, ratio in ratios.items()])
        seen = RefitWindow.from_recording(self.baseline, recording, self.onset - self.lead_samples, len(self.r))
        return replace(seen, prior=self.prior)

    @cached_property
    def healthy(self) -> RefitWindow:
        """The window of a healthy loop."""
        return self.window({})

    @cached_property
    def size_grids(self) -> dict[str, dict[float, Predictor]]:
        """Predictors of each fault at sizes all over its range, by parameter and logarithm of the ratio."""
        window, nothing = self.healthy, np.zeros(self.healthy.nuisance_count)
        predictions = {}
        for fault in self.loop.plant.faults:
            sizes = np.linspace(np.log(fault.ratio_range[0]), np.log(fault.ratio_range[1]), GRID).tolist()
            name = (fault.parameter,)
            predictions[name[0]] = {x: window.predictor(nothing, name, np.array([x]), self.profile) for x in sizes}
        return predictions

    @cached_property
    def jacobian(self) -> FloatArray:
        """Innovations and prior by the errors of the m healthy parameters and by the k changes, (N + m, m + k)."""
        window = self.healthy
        return window.jacobian(np.zeros(window.nuisance_count + len(self.names)), self.names, self.profile)

    @property
    def sensitivity(self) -> FloatArray:
        """Innovations by the changes alone, shape (N + m, k): logarithms of ratios in standard deviations."""
        return self.jacobian[:, self.healthy.nuisance_count :]

    def project_out_nuisances(self, columns: FloatArray) -> FloatArray:
        """Return what columns (N + m, q) say that errors of the healthy parameters do not say as well."""
        nuisance = self.jacobian[:, : self.healthy.nuisance_count]
        if not nuisance.shape[1]:
            return columns
        Q = orthonormal_basis(nuisance)
        return np.asarray(columns - Q @ (Q.T @ columns))

    def _prior_before_onset(self) -> FloatArray:
        C = np.array(self.baseline.healthy.covariance)
        if not len(C):
            return np.zeros((0, 0))
        known = np.linalg.inv(C)
        if self.onset:
            first = max(self.onset - round(BEFORE_S * self.loop.sample_rate), 0)
            window = RefitWindow.from_recording(self.baseline, self._simulate_recording([]), first, self.onset)
            J = window.jacobian(np.zeros(window.nuisance_count), (), ChangeProfile(0))[: window.samples]
            known = known + J.T @ J
        return np.asarray(np.linalg.cholesky(known).T)

    def _simulate_recording(self, faults: Sequence[FaultEvent]) -> Recording:
        loop = self.loop.model_copy(update={"plant": self.baseline.plant})
        u_std, y_std = self.noise.u_std, self.noise.y_std
        return simulate(loop, self.r, faults=faults, noise_u_std=u_std, noise_y_std=y_std, seed=SEED)[0]


def require_study(baseline: Baseline) -> None:
    """Refuse a baseline whose loop cannot be simulated, or not by the exact predictor."""
    require_exact_predictor(baseline.loop)
    if baseline.exact is None:
        raise BaselineError(
            "the baseline has no exact predictor: a study needs a linear plant, a held input, and noise in the "
            "healthy recordings, without which every change is seen"
        )


def require_exact_predictor(loop: Loop) -> None:
    """Refuse a loop whose predictor would not be exact."""
    if loop.controller is None or not loop.plant.has_physics:
        raise LoopError(f"{loop.name}: a study before deployment needs [controller] and the plant's nominal values")
    if not loop.plant.linear or loop.plant.extras or loop.hold != "zoh":
        raise LoopError(
            f"{loop.name}: a study before deployment needs a linear plant with hold = 'zoh': leave out friction, "
            "offset and the square-root valve"
        )
