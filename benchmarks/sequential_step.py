"""What it costs to step the sequential test once per evaluation: delays of faults, false alarms; Markdown tables.

python benchmarks/sequential_step.py [--seeds 20] [--hours 4] [--cost] [--json]

Each seed is a baseline of one healthy minute of the reference rig and a recording with the fault, on which neither
step was tuned; both steps see the same samples. Beside them stands T^2 alone, which needs no healthy loop beside it.
With --cost it measures instead what a sample of a fleet costs on one core.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import get_args

import numpy as np
from tables import Table, parser, show

import servoscope as ss
from servoscope.core.arrays import FloatArray
from servoscope.detection.baseline_run import cusum_constants
from servoscope.detection.statistic import apply_alarm_delays
from servoscope.models.loop import MonitorSettings
from servoscope.research.bench.timing import time_interleaved
from servoscope.simulation import FaultEvent, reference, simulate

RIG = Path(str(files("servoscope"))) / "simulation" / "reference-rig.toml"
STEPS: Sequence[str] = get_args(MonitorSettings.model_fields["sequential_step"].annotation)
AT, WITHIN = 30.0, 120.0  # s: the onset, and how long a fault is watched
FAULTS = {
    "p_s": (0.995, 0.99, 0.98, 0.95, 0.8),
    "C_ie": (1.01, 1.02, 1.05, 1.2, 1.4),
    "b_p": (1.5, 3.0, 10.0),
    "beta": (0.7, 0.5, 0.1),
}
PER_HOUR = 60.0  # false alarms that the second table asks for: so many that they can be counted
BASELINES = 5  # of the second table
HOURS_PER_YEAR = 8766.0
LOAD = os.getloadavg()[0]


def rig(step: str, per_hour: float = 1.0 / HOURS_PER_YEAR) -> ss.Loop:
    """Return the reference rig with a step of its sequential test and a budget of false alarms."""
    loop = ss.Loop.load(RIG)
    settings = {"sequential_step": step, "false_alarms_per_year": per_hour * HOURS_PER_YEAR}
    return ss.Loop.from_dict(loop.to_dict() | {"monitor": loop.to_dict()["monitor"] | settings})


def record(seconds: float, seed: int, *faults: FaultEvent) -> ss.Recording:
    """Simulate the rig; the loop is the same for both steps."""
    loop = rig(STEPS[0])
    return simulate(loop, reference("multisine", seconds, loop.sample_rate), faults=faults, seed=seed)[0]


def first_alarm(baseline: ss.Baseline, recording: ss.Recording) -> tuple[float, float]:
    """Return how long after the onset the sequential test and T^2 alone alarm [s]; infinity where they do not."""
    monitor = ss.Monitor(baseline)
    _, trace = monitor.run(monitor.init(), recording.r, recording.u, recording.y)
    after = trace.t > AT
    crossed = trace.crossed[after & np.isfinite(trace.crossed)]
    over = trace.t[after & trace.ready & (trace.statistic > trace.threshold)]
    return (float(crossed[0]) - AT if len(crossed) else np.inf), (float(over[0]) - AT if len(over) else np.inf)


def delays(seeds: int) -> Table:
    """Return the median delays of both steps, fault by fault."""
    learned = [[ss.learn(rig(step), [record(60.0, 5000 + seed)]) for step in STEPS] for seed in range(seeds)]
    rows = []
    for parameter, ratios in FAULTS.items():
        for ratio in ratios:
            fault = FaultEvent(parameter, ratio, AT)
            found = np.empty((seeds, len(STEPS) + 1))
            for seed, baselines in enumerate(learned):
                recording = record(AT + WITHIN, 6000 + seed, fault)
                both = [first_alarm(each, recording) for each in baselines]
                found[seed] = *(each[0] for each in both), both[0][1]
            rows.append((f"{parameter} x{ratio:g}", *map(seconds, np.median(found, axis=0)), later(found)))
    note = f"Medians over {seeds} baselines of a minute at one false alarm a year."
    heads = ("fault", "at each update", "once per evaluation", "T^2 alone", "later by, median of pairs")
    return Table("Delay of the sequential test", note, heads, tuple(rows))


def later(found: FloatArray) -> str:
    """Return by how much the second step is later than the first on the same samples."""
    both = found[np.isfinite(found[:, :2]).all(axis=1)]
    return f"{np.median(both[:, 1] - both[:, 0]):+.2f} s" if len(both) else "-"


def seconds(value: float) -> str:
    """Return a delay as text."""
    return f"{value:.3g} s" if np.isfinite(value) else f"> {WITHIN:g} s"


def false_alarms(hours: int) -> Table:
    """Return how many alarms the sequential test raises where so many are allowed that they can be counted."""
    rows, share = [], 0.5 * PER_HOUR * hours  # T^2 has the other half of the budget
    for step in STEPS:
        counts = []
        for number in range(BASELINES):
            learned = ss.learn(rig(step), [record(600.0, 7000 + number)]).model_dump(by_alias=True)
            baseline = ss.Baseline.model_validate(learned | {"loop": rig(step, PER_HOUR).to_dict()})
            healthy = (record(3600.0, 8000 + hours * number + hour) for hour in range(hours))
            counts.append(sum(raised(baseline, recording) for recording in healthy))
        cells = f"{BASELINES * share:.0f}", f"{sum(counts)}", f"{sum(counts) / (BASELINES * share):.2f}"
        rows.append((step, f"{BASELINES * hours}", *cells, f"{min(counts) / share:.2f}, {max(counts) / share:.2f}"))
    heads = "step", "healthy hours", "allowed", "raised", "share", "least, most of a baseline"
    note = f"{BASELINES} baselines of ten minutes; the share of the budget that is the sequential test's."
    return Table("False alarms of the sequential test", note, heads, tuple(rows))


def raised(baseline: ss.Baseline, recording: ss.Recording) -> int:
    """Return how many alarms the sequential test raises."""
    pipeline = baseline.pipeline()
    estimates = pipeline.estimate(baseline.tuning, recording, cusum_constants(baseline, pipeline))
    alarm = apply_alarm_delays(estimates.level >= 1.0, *pipeline.delays)
    return int(np.sum(alarm[1:] & ~alarm[:-1]))


def cost(assets: int = 10_000, samples: int = 100, repeats: int = 15) -> Table:
    """Return the processor time of a sample in a fleet, bare and with either step, measured in turns."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})  # before the fleet asks how many cores there are
    recording = record(60.0, 1)
    learned = {step: ss.learn(rig(step), [recording]) for step in STEPS}
    bare = learned[STEPS[0]].model_copy(update={"members": ()})
    at = np.random.default_rng(0).integers(0, recording.samples - samples, assets)[:, None] + np.arange(samples)
    signals = [signal[at] for signal in (recording.r, recording.u, recording.y)]
    jobs: dict[str, Callable[[], object]] = {}
    for name, baseline in {"none": bare, **learned}.items():
        monitor = ss.Monitor([baseline] * assets)
        state = monitor.init()
        for _ in range(3):  # until the whitening filter has forgotten its start
            state, _ = monitor.run(state, *signals)
        jobs[name] = lambda m=monitor, s=state: m.run(s, *signals)  # type: ignore[misc]
    timings = time_interleaved(jobs, repeats)
    each = {name: 1e9 * measured.processor / (assets * samples) for name, measured in timings.items()}
    rows = tuple((name, f"{ns:.1f}", f"{ns / each['none']:.2f}") for name, ns in each.items())
    note = f"{assets} assets, double, one core, medians of {repeats} runs in turns; load average before {LOAD:.1f}."
    return Table("Cost of the sequential test", note, ("step", "ns per sample", "over none"), rows)


def main() -> None:
    """Measure and print."""
    command = parser(__doc__)
    command.add_argument("--seeds", type=int, default=20)
    command.add_argument("--hours", type=int, default=4, help="of each baseline of the second table")
    command.add_argument("--cost", action="store_true", help="measure what a sample of a fleet costs")
    given = command.parse_args()
    if given.cost:
        show([cost()], given.json)
        return
    show([delays(given.seeds), false_alarms(given.hours)], given.json)


if __name__ == "__main__":
    main()
