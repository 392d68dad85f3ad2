"""The command bench: how fast the monitor runs on this machine, on one log, sample by sample and as a fleet."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Annotated

import typer

from servoscope.cli.app import app
from servoscope.cli.exit import print_json
from servoscope.cli.options import JsonOption

LOG_SAMPLES, STEPS, FLEET_ASSETS, FLEET_SAMPLES = 60_000, 20_000, 10_000, 100
MIN_COUNT = 100  # of samples and assets: an evaluation comes within so many samples
FILLING_BLOCKS = 3  # blocks of a fleet before it is measured: with its noise filter empty, fewer samples are tested


@dataclass(frozen=True)
class JobTiming:
    """Times of one job [s]: median, and the quartiles around it; `processor`, the median of what all cores spent."""

    median: float
    low: float
    high: float
    processor: float

    def per_sample(self, samples: int) -> JobTiming:
        """Return the times of one of its samples [ns]."""
        return JobTiming(*(1e9 * seconds / samples for seconds in asdict(self).values()))


def time_interleaved(jobs: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, JobTiming]:
    """Run all jobs once uncounted, then in turns, so that a busy moment meets all of them; return their times."""
    for job in jobs.values():
        job()
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in jobs}
    for _ in range(repeats):
        for name, job in jobs.items():
            begin, spent = time.perf_counter(), time.process_time()
            job()
            times[name].append((time.perf_counter() - begin, time.process_time() - spent))
    timings = {}
    for name, pairs in times.items():
        walls, processor = (sorted(column) for column in zip(*pairs, strict=True))
        median, low, high = (walls[round(q * (repeats - 1))] for q in (0.5, 0.25, 0.75))
        timings[name] = JobTiming(median, low, high, processor[repeats // 2])
    return timings


def measure_monitor(repeats: int, share: float) -> dict[str, JobTiming]:
    """Return times per sample [ns] of the monitor of the reference rig, with all its tests."""
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

    jobs: dict[str, Callable[[], object]] = {
        "one log": lambda: single.run(single.init(), *long),
        "one sample at a time": step_all,
    }
    counts = {"one log": log, "one sample at a time": steps}
    blocks = np.broadcast_to(signals[:, None, :FLEET_SAMPLES], (3, assets, FLEET_SAMPLES))
    for precision, number in (("double", np.float64), ("single", np.float32)):
        monitor, name = Monitor([baseline] * assets, precision=precision), f"fleet of {assets}, {precision}"  # type: ignore[arg-type]
        fleet, block = monitor.init(), np.ascontiguousarray(blocks, dtype=number)
        for _ in range(FILLING_BLOCKS):
            fleet, _ = monitor.run(fleet, *block)
        jobs[name] = lambda monitor=monitor, fleet=fleet, block=block: monitor.run(fleet, *block)  # type: ignore[misc]
        counts[name] = assets * FLEET_SAMPLES
    return {name: timing.per_sample(counts[name]) for name, timing in time_interleaved(jobs, repeats).items()}


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
        timings = measure_monitor(repeats, share)
    if as_json:
        print_json({"ns_per_sample": {name: asdict(timing) for name, timing in timings.items()}}, lines=False)
        return
    rows = [
        (name, f"{t.median:.1f}", f"{t.low:.1f} to {t.high:.1f}", f"{1e3 / t.median:.3g}")
        for name, t in timings.items()
    ]
    print_table(create_console(), ("", "ns per sample", "quartiles", "million/s"), rows)
