"""The inverse regression as one filter bank: [r u y] -> (eta, phi, z), and E(f) from theta to the iFRF."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import ComplexArray, FloatArray
from servoscope.core.errors import LoopError
from servoscope.models.loop import Loop
from servoscope.models.lti import (
    LinearSystem,
    block_diagonal,
    sample_system,
    settling_samples,
    state_variable_filter,
    stretched_filter,
    tapped_delay_line,
)
from servoscope.models.plants import SIGN_CUTOFF, Column, Plant
from servoscope.simulation.measurement import FeedForward
from servoscope.simulation.stability import close_loop


@dataclass(frozen=True, eq=False)
class FilterBank:
    """Constant matrices that turn samples into regressors."""

    system: LinearSystem  # from ``w = [r, u, y, extra ...]`` to ``[eta, phi (n), z (n, only with an instrument)]``
    # from y (or r) to the velocity whose sign forms the non-linear columns and gates the estimator
    velocity: LinearSystem
    velocity_of_reference: bool  # whether `velocity` takes r instead of y
    extras: tuple[Column, ...]  # non-linear inputs after r, u, y
    names: tuple[str, ...]  # names of the n coefficients
    # powers of s (or of q for Tustin) of the first coefficients; the others do not enter the iFRF
    powers: tuple[int, ...]
    structure: str  # ``svf``, ``tustin`` or ``tustin-held``
    gain: float  # factor on u before it enters eta
    wait: int  # samples that the estimator waits after the filters are re-armed
    sample_rate: float  # in Hz
    poles: FloatArray  # of the filters that u and y pass, per sample; none where they only delay

    @property
    def n(self) -> int:
        """Number of coefficients."""
        return len(self.names)

    @property
    def linear(self) -> LinearSystem:
        """From [u, y] alone to [eta, phi (n)]; nothing reaches the columns of friction and offset."""
        return self.system.input(np.eye(3 + len(self.extras), 2, -1)).output(np.eye(1 + self.n, len(self.system.C)))

    @property
    def has_instrument(self) -> bool:
        """Whether the system also gives z."""
        return len(self.system.C) == 1 + 2 * self.n

    def E(self, frequencies: npt.ArrayLike) -> ComplexArray:
        """Return the matrix of ``H_hat(f) = E(f) theta``.

        For the state-variable filter the columns are (j 2 pi f)^i; for Tustin they are those of eq. (13) with
        q = exp(-j 2 pi f / f_s) -- the paper prints the sign the other way round, but q is a delay.

        Frequencies are in Hz, shape (F,), the matrix has shape (F, n); columns of friction and offset are zero.
        """
        f = np.atleast_1d(np.asarray(frequencies, dtype=np.float64))
        E = np.zeros((len(f), self.n), dtype=np.complex128)
        powers = np.asarray(self.powers)
        if self.structure == "svf":
            E[:, : len(powers)] = (2j * np.pi * f[:, None]) ** powers
        else:
            q = np.exp(-2j * np.pi * f / self.sample_rate)
            E[:, : len(powers)] = q[:, None] ** powers / (1.0 + q[:, None]) ** max(self.powers)
        return E / self.gain


def tustin_coefficients(theta: FloatArray, sample_rate: float) -> FloatArray:
    """Map theta of ``sum theta_i s^i`` to c of eq. (3), s = 2 f_s (1 - q)/(1 + q), both (n + 1,)."""
    from numpy.polynomial import polynomial as P

    n = len(theta) - 1
    c = np.zeros(n + 1)
    for i, theta_i in enumerate(theta):
        c += theta_i * (2.0 * sample_rate) ** i * P.polymul(P.polypow([1.0, -1.0], i), P.polypow([1.0, 1.0], n - i))
    return c


def nominal_theta(loop: Loop, plant: Plant | None = None) -> FloatArray:
    """Return the coefficients of a plant, or of the loop's own, in the loop's structure, shape (n,)."""
    theta = (loop.plant if plant is None else plant).theta()
    return theta if loop.monitor.structure == "svf" else tustin_coefficients(theta, loop.sample_rate)


def closed_loop_system(loop: Loop, plant: Plant) -> LinearSystem:
    """Build the sampled closed loop [r, n_u, n_y] -> [u, y as measured]: exact plant, PI controller, delay.

    Raises LoopError if the loop has no controller or the plant no nominal values, or if the loop is unstable with
    this plant.
    """
    if loop.controller is None or not plant.has_physics:
        raise LoopError(f"{loop.name}: the nominal closed loop needs [controller] and the plant's nominal values")
    loop_itself = close_loop(loop, sample_system(plant.state_space(), loop.sample_rate, loop.hold, loop.delay))
    if np.abs(np.linalg.eigvals(loop_itself.A)).max() >= 1.0:
        raise LoopError(f"{loop.name}: the closed loop is unstable, check [plant] and [controller]")
    if not loop.controller.k_v:
        return loop_itself
    feed = FeedForward(loop)
    ahead = stretched_filter(feed.numerator, feed.denominator, 1)
    plain = LinearSystem(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.eye(1))
    return block_diagonal([ahead, plain, plain]).then(loop_itself)


def instrument_system(loop: Loop) -> LinearSystem:
    """Return r -> y of the nominal closed loop without noise, the instrument (how-it-works, "Noise in the regressor").

    Raises LoopError as `closed_loop_system`.
    """
    whole = closed_loop_system(loop, loop.plant)
    return whole.input(np.eye(3, 1)).output(np.eye(1, 2, 1))


def _svf_paths(loop: Loop) -> tuple[LinearSystem, LinearSystem, list[LinearSystem], int]:
    """Return u -> eta, y -> phi, extras -> phi, and the samples to wait."""
    plant, rate, cutoff = loop.plant, loop.sample_rate, loop.cutoff
    order = max((1, *plant.powers)) + 1
    continuous = state_variable_filter(cutoff, order)
    to_eta = sample_system(continuous, rate, loop.hold, loop.delay).output(plant.input_gain * np.eye(1, order))
    to_phi = sample_system(continuous, rate, "foh").output(np.eye(order)[list(plant.powers)])
    system = LinearSystem(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.ones((1, 1)))
    smooth = sample_system(continuous, rate, "foh").output(np.eye(1, order))
    wait = settling_samples(cutoff, order, 1.0 / rate) + math.ceil(loop.delay * rate)
    return to_eta, to_phi, [system if extra == Column.CONSTANT else smooth for extra in plant.extras], wait


def _instrument_path(loop: Loop, instrument: InstrumentModel, to_phi: LinearSystem) -> LinearSystem:
    """Return the path from the source of the instrument to the columns of z that stand for those of y."""
    if not instrument.derivative:
        return instrument.system.then(to_phi)
    powers = loop.plant.powers
    continuous = state_variable_filter(loop.cutoff, max((1, *powers)) + 1)
    rows = np.eye(len(continuous[0]))[[power - instrument.derivative for power in powers]]
    return instrument.system.then(sample_system(continuous, loop.sample_rate, "foh").output(rows))


def _tustin_paths(loop: Loop) -> tuple[LinearSystem, LinearSystem, list[LinearSystem], int]:
    """Return the paths of eq. (4) as printed, or with (u(k) + u(k-1))/2 in place of u for a held input."""
    plant = loop.plant
    n = max(plant.powers, default=0)
    if plant.extras or plant.powers != tuple(range(n + 1)):
        raise LoopError(
            f"{loop.name}: [monitor] structure = {loop.monitor.structure!r} needs a plant with all powers of s "
            "(stiffness = true) and neither friction nor offset; use structure = 'svf'"
        )
    weights = plant.input_gain * np.array([math.comb(n, i) for i in range(n + 1)], dtype=np.float64)
    if loop.monitor.structure == "tustin-held":
        weights = np.convolve(weights, [0.5, 0.5])
    late = round(loop.delay * loop.sample_rate)
    to_eta = tapped_delay_line(np.concatenate([np.zeros(late), weights]))
    return to_eta, tapped_delay_line(np.eye(n + 1)), [], n + 2 + late


@dataclass(frozen=True, eq=False)
class InstrumentModel:
    """What leads to a noise-free output y_a, from which the instrument z is formed."""

    system: LinearSystem  # from r, or from u, to the derivative of y_a
    from_input: bool = False  # whether it takes u instead of r
    # power of s of the derivative, at most the lowest of the plant's inverse: a plant that integrates has no steady y_a
    derivative: int = 0


def build_filter_bank(loop: Loop, instrument: InstrumentModel | None = None) -> FilterBank:
    """Turn a loop's settings into constant matrices.

    With `instrument`, z is the same filters applied to its noise-free output (Young, 2011). Raises LoopError if
    the structure does not suit the plant.
    """
    plant = loop.plant
    svf = loop.monitor.structure == "svf"
    to_eta, to_phi, to_extras, wait = (_svf_paths if svf else _tustin_paths)(loop)
    n_powers, n_extras = len(plant.powers), len(plant.extras)
    n = n_powers + n_extras
    bricks = [to_eta, to_phi, *to_extras]
    feeds = [1, 2, *range(3, 3 + n_extras)]  # the input out of w = [r, u, y, extras] that each brick takes
    if instrument is not None:
        bricks.append(_instrument_path(loop, instrument, to_phi))
        feeds.append(1 if instrument.from_input else 0)
    whole = block_diagonal(bricks)
    route = np.zeros((len(bricks), 3 + n_extras))
    route[np.arange(len(bricks)), feeds] = 1.0
    C, D = whole.C, whole.D @ route
    if instrument is not None and n_extras:
        # the instrument replaces only the columns of y; friction and offset instrument themselves
        rows = np.r_[np.arange(1 + n), 1 + n + np.arange(n_powers), 1 + n_powers + np.arange(n_extras)]
        C, D = C[rows], D[rows]
    # second-order differentiator of its own: the sign of a strongly filtered velocity lags
    sign = plant.velocity_sign
    differentiator = state_variable_filter(min(sign.cutoff or SIGN_CUTOFF, 0.25 * loop.sample_rate), 2)
    # of an output that is a speed, its low pass
    velocity = sample_system(differentiator, loop.sample_rate, "foh").output(np.eye(1, 2, 1 - plant.derivative))
    return FilterBank(
        system=LinearSystem(whole.A, whole.B @ route, C, D),
        velocity=velocity,
        velocity_of_reference=sign.of_reference,
        extras=tuple(map(Column, plant.extras)),
        names=plant.names if svf else tuple(f"c_{i}" for i in range(n)),
        powers=plant.powers,
        structure=loop.monitor.structure,
        gain=plant.input_gain,
        wait=wait,
        sample_rate=loop.sample_rate,
        poles=np.full(max((1, *plant.powers)) + 1, math.exp(-2.0 * math.pi * loop.cutoff / loop.sample_rate))
        if svf
        else np.zeros(0),
    )
