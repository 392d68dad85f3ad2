"""The command bench: how fast the monitor runs on this machine, on one log, sample by sample and as a fleet."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Annotated

import typer

from servoscope.cli.app import app
from servoscope.cli.exit import print_json
from servoscope.cli.options import JsonOption

LOG_SAMPLES, STEPS, FLEET_ASSETS, FLEET_SAMPLES = 60_000, 20_000, 10_000, 100
MIN_COUNT = 100  # of samples and assets: an evaluation comes within so many samples
FILLING_BLOCKS = 3  # blocks of a fleet before it is measured: with its noise filter empty, fewer samples are tested


def median_time(job: Callable[[], object], repeats: int) -> float:
    """Run a job once uncounted, then so many times; return the median of its times [s]."""
    job()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        job()
        times.append(time.perf_counter() - begin)
    return sorted(times)[repeats // 2]


def measure_monitor(repeats: int, share: float) -> dict[str, float]:
    """Return the time of a sample [ns] in the monitor of the reference rig, with all its tests."""
    from importlib.resources import files

    import numpy as np

    from servoscope.diagnosis.monitor import Monitor
    from servoscope.learning.learn import nominal_baseline
    from servoscope.models.loop import Loop
    from servoscope.simulation import reference, simulate

    rig = files("servoscope").joinpath("simulation", "reference-rig.toml").read_text(encoding="utf-8")
    loop = Loop.from_text(rig, "reference-rig.toml")
    log, steps, assets = (max(MIN_COUNT, round(share * count)) for count in (LOG_SAMPLES, STEPS, FLEET_ASSETS))
    recording, _ = simulate(loop, reference("profile", 60.0, loop.sample_rate), seed=1)
    signals = np.stack([recording.r, recording.u, recording.y])
    baseline = nominal_baseline(loop)
    single = Monitor(baseline)
    long, samples = np.resize(signals, (3, log)), signals[:, np.arange(steps) % recording.samples].T.tolist()
    state = single.init()

    def step_all() -> None:
        for r, u, y in samples:
            single.step(state, r, u, y)

    ns = {
        "one log": 1e9 * median_time(lambda: single.run(single.init(), *long), repeats) / log,
        "one sample at a time": 1e9 * median_time(step_all, repeats) / steps,
    }
    blocks = np.broadcast_to(signals[:, None, :FLEET_SAMPLES], (3, assets, FLEET_SAMPLES))
    for precision, number in (("double", np.float64), ("single", np.float32)):
        monitor, block = Monitor([baseline] * assets, precision=precision), np.ascontiguousarray(blocks, dtype=number)  # type: ignore[arg-type]
        fleet = monitor.init()
        for _ in range(FILLING_BLOCKS):
            fleet, _ = monitor.run(fleet, *block)
        spent = median_time(partial(monitor.run, fleet, *block), repeats)
        ns[f"fleet of {assets}, {precision}"] = 1e9 * spent / (assets * FLEET_SAMPLES)
    return ns


@app.command()
def bench(
    repeats: Annotated[int, typer.Option(metavar="N", min=1, help="Of each measurement; medians count.")] = 9,
    share: Annotated[float, typer.Option(metavar="SHARE", min=0.001, max=1.0, help="Of assets and samples.")] = 1.0,
    as_json: JsonOption = False,
) -> None:
    """Measure how many samples per second the monitor takes on this machine: one log, single samples, a fleet."""
    from servoscope.cli.progress import show_steps
    from servoscope.cli.render.results import create_console, print_table

    with show_steps(1, 1) as steps:
        steps.begin("measuring")
        times = measure_monitor(repeats, share)
    if as_json:
        print_json({"ns_per_sample": times}, lines=False)
        return
    rows = [(name, f"{ns:.1f}", f"{1e3 / ns:.3g}") for name, ns in times.items()]
    print_table(create_console(), ("", "ns per sample", "million/s"), rows)
