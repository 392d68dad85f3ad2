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

from servoscope.baseline import Baseline
from servoscope.errors import BaselineError, LoopError, SimulationError
from servoscope.loop import Loop
from servoscope.noise import Noise
from servoscope.plants import FloatArray
from servoscope.recording import Recording
from servoscope.refinement.columns import basis
from servoscope.refinement.predictor import Predictor
from servoscope.refinement.refining import BEFORE_S
from servoscope.refinement.starts import GRID
from servoscope.refinement.window import Growth, Window
from servoscope.simulation import FaultEvent, simulate
from servoscope.simulation.closed_loop import checked

LEAD = 300  # samples before the onset, after which a predictor knows the state
SEED = 3  # of the noise; it is the same whatever changes
FEWEST = 50  # samples with the change


@dataclass(frozen=True, eq=False)
class Scene:
    """What is studied; build it with `of`.

    Parameters
    ----------
    baseline
        What healthy looks like.
    r
        Reference of the recording, shape (N,).
    onset
        First sample with the change; what is before is healthy.
    prior
        Inverse of a root of the covariance that the healthy parameters' logarithms have when the healthy seconds
        before the onset are known as well, shape (m, m).
    """

    baseline: Baseline
    r: FloatArray
    onset: int
    prior: FloatArray

    @classmethod
    def of(cls, baseline: Baseline, r: FloatArray, after_s: float = 30.0) -> Self:
        """Prepare the study of changes that are `after_s` [s] old when the reference r (N,) ends.

        Raises
        ------
        BaselineError, LoopError
            If the loop cannot be simulated, or not by the exact predictor.
        SimulationError
            If r is no reference, or shorter than `after_s`.
        """
        check(baseline.loop)
        if baseline.exact is None:
            raise BaselineError(
                "the baseline has no exact predictor: a study needs a linear plant, a held input, and noise in the "
                "healthy recordings, without which every change is seen"
            )
        r = checked(r)
        after = round(after_s * baseline.loop.sample_rate)
        if not FEWEST <= after <= len(r):
            least = FEWEST / baseline.loop.sample_rate
            longest = len(r) / baseline.loop.sample_rate
            raise SimulationError(f"{after_s:g} s after the onset: give at least {least:g} s, at most {longest:g} s")
        plain = cls(baseline, r, len(r) - after, np.zeros((0, 0)))
        return replace(plain, prior=plain._known_before())

    @property
    def loop(self) -> Loop:
        """The loop."""
        return self.baseline.loop

    @property
    def noise(self) -> Noise:
        """Its noise."""
        return self.baseline.exact.noise if self.baseline.exact else Noise(0.0, 0.0)  # `of` made sure of the first

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters of the k faults."""
        return tuple(fault.parameter for fault in self.loop.plant.faults)

    @property
    def after_s(self) -> float:
        """Seconds with the change."""
        return (len(self.r) - self.onset) / self.loop.sample_rate

    @property
    def lead(self) -> int:
        """Samples of a window before the onset."""
        return min(self.onset, LEAD)

    @property
    def growth(self) -> Growth:
        """The change, in samples of a window."""
        return Growth(self.lead)

    def window(self, ratios: Mapping[str, float]) -> Window:
        """Return what a refit would see of parameters that change to so many times their values.

        Raises
        ------
        SimulationError
            If the loop is unstable then.
        """
        onset_s = self.onset / self.loop.sample_rate
        recording = self._recorded([FaultEvent(name, ratio, onset_s) for name, ratio in ratios.items()])
        seen = Window.of(self.baseline, recording, self.onset - self.lead, len(self.r))
        return replace(seen, prior=self.prior)

    @cached_property
    def healthy(self) -> Window:
        """The window of a healthy loop."""
        return self.window({})

    @cached_property
    def ladders(self) -> dict[str, dict[float, Predictor]]:
        """Predictors of each fault at sizes all over its range, by parameter and logarithm of the ratio."""
        window, nothing = self.healthy, np.zeros(self.healthy.nuisances)
        found = {}
        for fault in self.loop.plant.faults:
            sizes = np.linspace(np.log(fault.ratio_range[0]), np.log(fault.ratio_range[1]), GRID).tolist()
            name = (fault.parameter,)
            found[name[0]] = {x: window.predictor(nothing, name, np.array([x]), self.growth) for x in sizes}
        return found

    @cached_property
    def jacobian(self) -> FloatArray:
        """Innovations and prior by the errors of the m healthy parameters and by the k changes, (N + m, m + k)."""
        window = self.healthy
        return window.jacobian(np.zeros(window.nuisances + len(self.names)), self.names, self.growth)

    @property
    def sensitivity(self) -> FloatArray:
        """Innovations by the changes alone, shape (N + m, k): logarithms of ratios in standard deviations."""
        return self.jacobian[:, self.healthy.nuisances :]

    def projected(self, columns: FloatArray) -> FloatArray:
        """Return what columns (N + m, q) say that errors of the healthy parameters do not say as well."""
        nuisance = self.jacobian[:, : self.healthy.nuisances]
        if not nuisance.shape[1]:
            return columns
        Q = basis(nuisance)
        return np.asarray(columns - Q @ (Q.T @ columns))

    def _known_before(self) -> FloatArray:
        C = np.array(self.baseline.ratios_covariance)
        if not len(C):
            return np.zeros((0, 0))
        known = np.linalg.inv(C)
        if self.onset:
            first = max(self.onset - round(BEFORE_S * self.loop.sample_rate), 0)
            window = Window.of(self.baseline, self._recorded([]), first, self.onset)
            J = window.jacobian(np.zeros(window.nuisances), (), Growth(0))[: window.samples]
            known = known + J.T @ J
        return np.asarray(np.linalg.cholesky(known).T)

    def _recorded(self, faults: Sequence[FaultEvent]) -> Recording:
        loop = self.loop.model_copy(update={"plant": self.baseline.plant})
        u_std, y_std = self.noise.u_std, self.noise.y_std
        return simulate(loop, self.r, faults=faults, noise_u_std=u_std, noise_y_std=y_std, seed=SEED)[0]


def check(loop: Loop) -> None:
    """Refuse a loop whose predictor would not be exact.

    Raises
    ------
    LoopError
        If so.
    """
    if loop.controller is None or not loop.plant.has_physics:
        raise LoopError(f"{loop.name}: a study before deployment needs [controller] and the plant's nominal values")
    if not loop.plant.linear or loop.plant.extras or loop.hold != "zoh":
        raise LoopError(
            f"{loop.name}: a study before deployment needs a linear plant with hold = 'zoh': leave out friction, "
            "offset and the square-root valve"
        )
