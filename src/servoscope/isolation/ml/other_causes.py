"""What else it could be: causes outside the list of faults that explain a window as well as the best of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.messages import Message, message, text_message
from servoscope.fit.predictor import Predictor
from servoscope.fit.search import minimise_from_grid
from servoscope.isolation.ml.backlash import backlash_of_width, fit_backlash
from servoscope.isolation.ml.hypothesis import HypothesisFit
from servoscope.isolation.ml.least_squares import solve_least_squares
from servoscope.isolation.ml.window import ChangeProfile, ChangeWindow, RefitWindow, delayed, speed_sign

DELAY_COUNT = 9  # delays up to one further sample, before the best is refined
UNITS = {"delay": "s", "backlash": "of y", "sensor_offset": "of y", "coulomb_friction": "of u", "input_offset": "of u"}


@dataclass(frozen=True, eq=False)
class OtherCause:
    """Something that would explain the window."""

    name: str
    cause: Message
    value: float  # value, unit: A ratio to the healthy value (unit ``ratio``), or a size
    unit: str
    residual: FloatArray  # with it, shape (N + m,)

    @cached_property
    def cost(self) -> float:
        """Sum of squares with it."""
        return float(self.residual @ self.residual)


@dataclass(frozen=True, eq=False)
class CauseWindow:
    """A window, and what explains it from a sample on that is neither fault nor parameter."""

    window: ChangeWindow

    @cached_property
    def healthy(self) -> tuple[FloatArray, FloatArray]:
        """Jacobian by what is not quite known of the healthy plant, (N + m, m), and residual as learned, (N + m,)."""
        nothing, always = np.zeros(self.window.nuisance_count), ChangeProfile(self.window.samples)
        return self.window.jacobian(nothing, (), always), self.window.residual(nothing, (), always)

    @cached_property
    def healthy_cost(self) -> float:
        """Sum of squares without any change."""
        return solve_least_squares(*self.healthy)[1]

    @cached_property
    def disturbances(self) -> dict[str, tuple[FloatArray, FloatArray]]:
        """What a unit of each adds to u and to y, shapes (N,)."""
        nothing, ones = np.zeros(self.window.samples), np.ones(self.window.samples)
        moving = delayed(speed_sign(self.window.y, self.window.sample_rate), 1)
        disturbances = {
            "sensor_offset": (nothing, ones),
            "coulomb_friction": (-moving, nothing),
            "input_offset": (ones, nothing),
        }
        own = self.window.plant.names  # what has a fault of its own
        return {name: both for name, both in disturbances.items() if name not in own}

    @property
    def nonlinear(self) -> tuple[str, ...]:
        """Causes whose size is searched."""
        return ("delay", "backlash") if isinstance(self.window, RefitWindow) else ()

    def fit(self, name: str, onset: int, value: float | None = None) -> OtherCause:
        """Return a cause with its likeliest size; that of a nonlinear one may be given instead."""
        if name in self.disturbances:
            return self._fit_disturbance(name, onset)
        assert isinstance(self.window, RefitWindow)
        if name == "backlash":
            value = fit_backlash(self.window, onset) if value is None else value
            e = backlash_of_width(self.window, onset, value)
            return self._told(name, value, np.append(e, np.zeros(self.window.nuisance_count)))
        value = self._fit_delay(onset) if value is None else value
        return self._told(name, value, self._later_input(onset, value))

    def _told(self, name: str, value: float, residual: FloatArray) -> OtherCause:
        return OtherCause(name, message(f"cause.{name}"), value, UNITS[name], residual)

    def _fit_disturbance(self, name: str, onset: int) -> OtherCause:
        window, where = self.window, np.arange(self.window.samples) >= onset
        to_u, to_y = self.disturbances[name]
        column = window.disturbance_response(window.healthy, ChangeProfile(window.samples), to_u * where, to_y * where)
        J, e = self.healthy
        J = np.column_stack([J, np.append(column, np.zeros(window.nuisance_count))])
        step, _ = solve_least_squares(J, e)
        # a disturbance is taken off y to explain it, so its size has the other sign
        return self._told(name, float(step[-1]), e + J @ step)

    def _fit_delay(self, onset: int) -> float:
        """Return by how much later than the loop file says the input acts, up to a sample [s]."""
        assert isinstance(self.window, RefitWindow)
        factory, rate = self.window.factory, self.window.sample_rate

        def cost(samples: float) -> float:
            left = self._later_input(onset, samples / rate)
            return float(left @ left)

        latest = 1.0 - factory.fractional_delay_s * rate
        return minimise_from_grid(cost, np.linspace(0.0, latest, DELAY_COUNT), 1e-4) / rate

    def _later_input(self, onset: int, later_s: float) -> FloatArray:
        window = self.window
        assert isinstance(window, RefitWindow)
        last = window.factory.predictor(window.plant, later_s=later_s)
        both = Predictor.concatenate([window.healthy, last])
        e = np.asarray(window.innovations(both, ChangeProfile(onset)), dtype=np.float64)
        J, _ = self.healthy
        residual = np.append(e, np.zeros(window.nuisance_count))
        step, _ = solve_least_squares(J, residual)
        return np.asarray(residual + J @ step)


def parameter_cause(fitted: HypothesisFit) -> OtherCause:
    """Return a parameter that changed as a cause."""
    (fault,) = fitted.faults
    return OtherCause(fault.name, text_message(fault.words), float(np.exp(fitted.x[0])), "ratio", fitted.residual)


def causes_at(causes: CauseWindow, onset: int) -> list[OtherCause]:
    """Return everything that is no parameter, from a sample on."""
    names: Sequence[str] = (*causes.nonlinear, *causes.disturbances)
    return [causes.fit(name, onset) for name in names]
