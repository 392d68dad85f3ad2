"""A loop, and healthy recordings if there are any, to the study before deployment."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from servoscope.baseline import Baseline
from servoscope.design.findings import Study
from servoscope.design.scene import check
from servoscope.design.studying import study
from servoscope.learning import SHORTEST, learn
from servoscope.loop import Loop
from servoscope.noise import Noise
from servoscope.plants import FloatArray
from servoscope.recording import Recording
from servoscope.simulation import reference as motion
from servoscope.simulation import simulate
from servoscope.simulation.closed_loop import NOISE_U_STD, NOISE_Y_STD

LEARNED_S = 60.0  # of a healthy recording that is simulated, at least
BEFORE_S = 60.0  # of healthy motion before the onset
SEED = 1

Progress = Callable[[str], None]


def design_study(
    loop: Loop,
    recordings: Sequence[Recording] = (),
    *,
    reference: str | FloatArray = "profile",
    after_s: float = 30.0,
    noise_u_std: float = NOISE_U_STD,
    noise_y_std: float = NOISE_Y_STD,
    progress: Progress = lambda _: None,
) -> Study:
    """Say before deployment which faults of a loop can be detected and told apart, at which size, after how long.

    Parameters
    ----------
    loop
        Loop with a controller and a linear plant whose nominal values are known.
    recordings
        Healthy recordings: the baseline is learned from them, and their noise and the reference of the longest one are
        used. Without any, one is simulated under `reference` with noise as given, and learned from.
    reference
        Kind of reference or file, as for `servoscope.simulation.reference`, or the reference itself, shape (N,), which
        is repeated as often as it takes.
    after_s
        Seconds since the onset of a fault that may be used.
    noise_u_std, noise_y_std
        Standard deviations of the noise that enters with u and of the sensor of y; without recordings.
    progress
        Told what is being done.

    Raises
    ------
    LoopError
        If the loop has no controller, no nominal values, or a plant that is not linear.
    BaselineError, NotEnoughError, RecordingError, SimulationError
        If the baseline cannot be learned, or the reference does not fit.
    """
    check(loop)
    samples = round((BEFORE_S + after_s) * loop.sample_rate)
    if recordings:
        longest = max(recordings, key=lambda rec: rec.samples)
        progress("learning")
        return study(
            learn(loop, recordings),
            np.resize(longest.r, max(samples, 1)),
            after_s,
            reference=f"of {longest.name}",
            progress=progress,
        )
    learned = max(LEARNED_S, SHORTEST * loop.monitor.memory)
    progress("learning")
    r, called = _motion(loop, reference, max(learned, BEFORE_S + after_s))
    noise = Noise(noise_u_std, noise_y_std)
    baseline = _learned(loop, r[: round(learned * loop.sample_rate)], noise)
    return study(baseline, r[: max(samples, 1)], after_s, reference=called, progress=progress)


def _motion(loop: Loop, reference: str | FloatArray, duration_s: float) -> tuple[FloatArray, str]:
    if isinstance(reference, str):
        return motion(reference, duration_s, loop.sample_rate), reference
    return np.resize(reference, round(duration_s * loop.sample_rate)), "given"


def _learned(loop: Loop, r: FloatArray, noise: Noise) -> Baseline:
    healthy, _ = simulate(loop, r, noise_u_std=noise.u_std, noise_y_std=noise.y_std, seed=SEED)
    return learn(loop, [healthy])
