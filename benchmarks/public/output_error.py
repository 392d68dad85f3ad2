"""A motor axis driven by u alone: its simulation from a measured start, and the coefficients that make it come out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.jit.array_function import ArrayFunction
from servoscope.core.jit.arrays import Variable
from servoscope.isolation.ml.window import delay_input, plant_input
from servoscope.models.loop import Loop
from servoscope.models.plants.axis import AxisPlant
from servoscope.signals import Recording
from servoscope.simulation.linear_kernels import AxisConstants, advance_axis, axis_constants

SPEED_OVER = 2  # samples of the central difference that gives the speed at the start
MOST_STEPS = 60


@ArrayFunction
def run_free_axis(
    printer: Any, motion: AxisConstants, position: Any, speed: Any, u: Any, y: Any, *, order: int
) -> None:
    """Run the first axis driven by what acts on it, u (N,), from a position and a speed on; y (N,) is filled."""
    at, v = Variable(printer, position), Variable(printer, speed)
    for k in printer.loop(0, u.shape[0]):
        y[k] = v.value if motion.speed else at.value
        for _ in printer.loop(0, motion.steps):
            advance_axis(printer, motion, 0, at, v, motion.gain[0] * u[k], order)


@dataclass(frozen=True, eq=False)
class OutputErrorFit:
    """What makes the simulation of recordings come out; the force that no term explains is each one's own."""

    plant: AxisPlant  # with the coefficients that were found
    # per recording: force in the middle in addition to the plant's [unit of ``input_gain u``], its change from the
    # first sample to the last, and the root mean square error of y
    offset: tuple[float, ...]
    drift: tuple[float, ...]
    rmse: tuple[float, ...]


def simulate_free(
    loop: Loop, recording: Recording, plant: AxisPlant | None = None, *, start: int = 0, offset: float = 0.0,
    drift: float = 0.0, speed: float | None = None,
) -> FloatArray:  # fmt: skip
    """Return y (N - start,) of an axis that u drives in open loop, from the measured position and speed on.

    Parameters
    ----------
    loop
        Loop with a plant of kind ``axis`` that has coefficients, or whose coefficients `plant` has.
    recording
        Recording whose u acts.
    plant
        Plant to simulate; that of the loop if None.
    start
        First sample; at least 1 where the speed is measured.
    offset, drift
        Force that acts against the motion's positive direction in addition: in the middle, and its change from end to
        end of the recording [unit of ``input_gain u``].
    speed
        Speed at the first sample [output per s]; a central difference of the measured y if None.
    """
    plant = plant or loop.plant  # type: ignore[assignment]
    assert isinstance(plant, AxisPlant)
    N, rate = recording.samples, recording.sample_rate
    u = delay_input(plant_input(loop, recording.u), recording.restart, round(loop.delay * rate))
    u = u - (offset + drift * np.linspace(-0.5, 0.5, N)) / plant.input_gain
    first = start
    if speed is None:
        first = max(start, 1)
        speed = float(recording.y[first + 1] - recording.y[first - 1]) * rate / SPEED_OVER
    y = np.empty(N - first)
    position = float(recording.y[first])
    if plant.derivative:
        position, speed = 0.0, position
    run_free_axis(
        axis_constants([plant], loop),
        position,
        speed,
        np.ascontiguousarray(u[first:]),
        y,
        order=2 if "inertia" in plant.names else 1,
    )
    return y


def fit_output_error(
    loop: Loop,
    recordings: Sequence[Recording],
    plant: AxisPlant,
    *,
    free: Sequence[str] | None = None,
    drifts: bool = True,
    start: int = 0,
) -> OutputErrorFit:
    """Return the coefficients of least output error (Ljung, 1999, section 4.3), found from those of `plant`.

    Parameters
    ----------
    loop, recordings
        As `simulate_free` takes them, one or several.
    plant
        Plant with coefficients near the solution, those of `fit_axis` for example: the error is not convex.
    free
        Coefficients that are searched; all but ``offset`` if None. A constant force of each recording is searched
        always.
    drifts
        Whether its change within the recording is, too.
    start
        First sample that counts.
    """
    from scipy.optimize import least_squares

    nominal = dict(plant.coefficients or {})
    names = [name for name in nominal if name != "offset"] if free is None else list(free)
    each = [abs(plant.input_gain) * float(np.sqrt(np.mean(recording.u**2))) for recording in recordings]
    own = 1 + drifts

    def plant_at(x: FloatArray) -> AxisPlant:
        ratios = dict(zip(names, (1.0 + x[: len(names)]).tolist(), strict=True))
        return plant.model_copy(update={"coefficients": {n: v * ratios.get(n, 1.0) for n, v in nominal.items()}})

    def forces_at(x: FloatArray) -> FloatArray:
        forces = np.zeros((len(recordings), 2))
        forces[:, :own] = np.array(each)[:, None] * x[len(names) :].reshape(-1, own)
        return forces

    def errors(x: FloatArray) -> list[FloatArray]:
        moved = plant_at(x)
        return [
            simulate_free(loop, one, moved, start=start, offset=float(offset), drift=float(drift))
            - one.y[max(start, 1) :]
            for one, (offset, drift) in zip(recordings, forces_at(x), strict=True)
        ]

    def error(x: FloatArray) -> FloatArray:
        return np.concatenate(errors(x))

    # differences of 1e-6 are lost in what sticking does to the path
    found = least_squares(
        error,
        np.zeros(len(names) + own * len(recordings)),
        diff_step=[1e-4],
        x_scale=0.01,
        max_nfev=MOST_STEPS,
    )
    offset, drift = forces_at(found.x).T.tolist()
    rmse = tuple(float(np.sqrt(np.mean(e**2))) for e in errors(found.x))
    return OutputErrorFit(plant_at(found.x), tuple(offset), tuple(drift), rmse)
