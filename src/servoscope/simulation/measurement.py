"""What a simulated loop is measured with: its noise, its settings, the recording and the truth beside it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import SimulationError
from servoscope.models.discretise import split_delay
from servoscope.models.loop import Loop
from servoscope.models.plants import Plant
from servoscope.signals import Recording
from servoscope.simulation.faults import FaultEvent
from servoscope.simulation.linear_kernels import ControllerConstants
from servoscope.simulation.stability import require_controller

NOISE_U_STD = 1e-4
NOISE_Y_STD = float(np.sqrt(1e-7))


@dataclass(frozen=True, eq=False)
class Truth:
    """What no recording contains."""

    t: FloatArray  # times of the samples [s], shape (N,)
    y_true: FloatArray  # output without measurement noise, shape (N,)
    # what acts on the plant: u after limits and dead zone, plus its noise, before the delay, shape (N,)
    u_true: FloatArray
    # parameters that change, each with its ratio to the nominal value from each sample to the next, shape (N,)
    ratios: dict[str, FloatArray]
    theta: FloatArray  # coefficients of the plant from each sample to the next, shape (N, n)
    faults: tuple[FaultEvent, ...]  # the events, in order of time, with the names of their parameters
    plant: Plant  # the nominal plant


def check_reference(r: npt.ArrayLike) -> FloatArray:
    """Return a reference as a row of numbers, or refuse it."""
    reference = np.ascontiguousarray(r, dtype=np.float64)
    if reference.ndim != 1 or reference.size == 0 or not np.all(np.isfinite(reference)):
        raise SimulationError("the reference must be one row of finite numbers")
    return reference


def draw_noise(samples: int, noise_u_std: float, noise_y_std: float, seed: int) -> tuple[FloatArray, FloatArray]:
    """Draw n_u and n_y, each (samples,)."""
    if not (noise_u_std >= 0.0 and noise_y_std >= 0.0):
        raise SimulationError("standard deviations of the noise must not be negative")
    rng = np.random.default_rng(seed)
    n_u = noise_u_std * rng.standard_normal(samples)
    return n_u, noise_y_std * rng.standard_normal(samples)


def make_recording(loop: Loop, r: FloatArray, u: FloatArray, y: FloatArray) -> Recording:
    """Return signals that begin at time 0 as a recording without defects."""
    first = np.zeros(r.size, dtype=bool)
    first[0] = True
    return Recording(
        name=f"{loop.name} simulated",
        t=np.arange(r.size) / loop.sample_rate,
        r=r,
        u=u,
        y=y,
        sample_rate=loop.sample_rate,
        restart=first,
        run=np.zeros(r.size, dtype=np.int32),
    )


def controller_constants(loop: Loop) -> ControllerConstants:
    """Return controller, limits, dead zone and delay of a loop as plain numbers."""
    controller = require_controller(loop)
    low, high = loop.input_limits or (-np.inf, np.inf)
    deadzone = loop.input_deadzone or (np.inf, -np.inf)
    delay, backward = split_delay(loop.delay, loop.sample_rate), loop.plant.retraction_gain
    if backward != 1.0 and loop.hold != "zoh":
        raise SimulationError(f"loop {loop.name!r}: two areas are simulated with a held u, set hold = 'zoh'")
    gains = (backward, 1.0) if loop.plant.input_gain > 0.0 else (1.0, backward)
    return ControllerConstants(controller.k_p, controller.k_i / loop.sample_rate, low, high, *deadzone, *delay, *gains)


class FeedForward:
    """The reference under which a PI controller alone gives the u of a loop with feed-forward.

    With r' = r + d the parts of r agree where ``(k_p + k_i T) d(k) = k_v (r(k) - r(k-1))/T - k_i T (d(k-1) + d(k-2) +
    ...)``. The sum of the error never stops, so this holds at limits, too.
    """

    def __init__(self, loop: Loop) -> None:
        controller = require_controller(loop)
        k_p, integral_gain = controller.k_p, controller.k_i / loop.sample_rate
        speed_gain, gain = controller.k_v * loop.sample_rate, k_p + integral_gain
        if integral_gain:
            self.denominator = np.array([1.0, -k_p / gain, 0.0])
            self.numerator = self.denominator + speed_gain / gain * np.array([1.0, -2.0, 1.0])
        else:
            self.denominator = np.array([1.0, 0.0])
            self.numerator = self.denominator + speed_gain / gain * np.array([1.0, -1.0])
        self.rewind()

    def rewind(self) -> None:
        """Forget all samples."""
        self._state: FloatArray | None = None

    def run(self, r: FloatArray) -> FloatArray:
        """Return r' of the next samples, shape (N,); before the first of all, r was what it is there."""
        from scipy.signal import lfilter, lfilter_zi

        if np.array_equal(self.numerator, self.denominator):
            return r
        if self._state is None:
            self._state = lfilter_zi(self.numerator, self.denominator) * (r[0] if r.size else 0.0)
        ahead, self._state = lfilter(self.numerator, self.denominator, r, zi=self._state)
        return np.asarray(ahead)
