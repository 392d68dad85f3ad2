"""What features of windows cost beside the recursion, per sample on one core: alone and in a fleet; a Markdown table.

python benchmarks speed/feature_cost [--json]

A motor axis at 200 Hz, in blocks of a quarter of a second; with and without features in turns, in one run.
"""

from __future__ import annotations

import os

import numpy as np
from tables import Table, parser, show
from tools.timing import time_interleaved

import servoscope as ss
from servoscope.simulation import reference, simulate
from servoscope.simulation.tutorial import AXIS

LOAD = os.getloadavg()[0]
BLOCK, BLOCKS, REPEATS = 50, 40, 9
ASSETS = (1, 64, 1000)


def record(seed: int, seconds: float = 40.0) -> ss.Recording:
    """Simulate a healthy axis."""
    loop = ss.Loop.from_dict(AXIS)
    r = reference("trapezoid", seconds, loop.sample_rate)
    return simulate(loop, r, seed=seed, noise_u_std=5e-3, noise_y_std=1e-5)[0]


def main() -> None:
    """Measure and print."""
    given = parser(__doc__).parse_args()
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})  # before a fleet asks how many cores there are
    learned = ss.learn(ss.Loop.from_dict(AXIS), [record(seed) for seed in range(6)])
    assert learned.features is not None, "six recordings are enough for features"
    made, jobs = record(9), {}
    for assets in ASSETS:
        signals = [np.tile(signal[: BLOCK * BLOCKS], (assets, 1)) for signal in (made.r, made.u, made.y)]
        for name, baseline in (("without", learned.model_copy(update={"features": None})), ("with", learned)):
            monitor = ss.Monitor([baseline] * assets) if assets > 1 else ss.Monitor(baseline)

            def follow(monitor: ss.Monitor = monitor, signals: list[np.ndarray] = signals) -> None:
                state = monitor.init()
                for k in range(0, BLOCK * BLOCKS, BLOCK):
                    part = [signal[:, k : k + BLOCK] for signal in signals]
                    state, _ = monitor.run(state, *(part if monitor.fleet else (one[0] for one in part)))

            jobs[assets, name] = follow
    timings = time_interleaved(jobs, REPEATS)
    us = {key: 1e6 * timing.processor / (key[0] * BLOCK * BLOCKS) for key, timing in timings.items()}
    rows = tuple(
        (f"{n}", f"{us[n, 'without']:.2f}", f"{us[n, 'with']:.2f}", f"{us[n, 'with'] / us[n, 'without']:.1f}")
        for n in ASSETS
    )
    note = f"Blocks of {BLOCK} samples, one core, medians of {REPEATS} runs in turns; load average before {LOAD:.1f}."
    show([Table("Cost of features", note, ("assets", "us without", "us with", "ratio"), rows)], given.json)
