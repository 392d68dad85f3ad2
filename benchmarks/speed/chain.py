"""The chain of a sample in one run: one log, single steps, a fleet, the service; beside peers and the machine's limits.

    python benchmarks speed/chain [--repeats 9] [--share 1.0] [--json]

About a minute. Jobs take turns, so that a busy moment of the machine meets all of them. Where two lines follow the same
algorithm, the largest relative difference of their results stands beside them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tables import Table, parser, show
from tools import limits, oracle, peers
from tools.layers import measure_layers, vector_bits
from tools.timing import JobTiming, time_interleaved

from servoscope.core.errors import ServoscopeError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servoscope.baseline.baseline import Baseline
    from servoscope.models.loop import Loop
    from servoscope.signals import Recording

FLEET_SAMPLES = 100  # samples of each asset of the fleet


@dataclass(frozen=True)
class BenchmarkSize:
    """How much is measured: assets of fleet and service, samples of a log and of slow ones, steps, simulations."""

    fleet: int = 10_000
    log: int = 60_000
    slow_log: int = 2_000
    steps: int = 20_000
    simulations: int = 1_000
    assets: int = 200  # of the service

    @classmethod
    def scaled(cls, share: float) -> BenchmarkSize:
        """Return a part of it all, in (0, 1], in hundreds, so that an evaluation comes with the last sample."""
        whole = cls()
        return cls(*(100 * max(1, round(share * getattr(whole, field.name) / 100)) for field in fields(cls)))


@dataclass(frozen=True)
class BenchmarkRow:
    """One line of the table."""

    name: str
    ns: tuple[float, float, float]  # nanoseconds per sample: median, lower and upper quartile
    # nanoseconds of processor time per sample, which other work on the machine does not lengthen much; median
    processor: float
    # of the processor time to that of the line that it is compared with, and `to`, the name of that line
    ratio: float | None = None
    to: str = ""
    # largest relative difference between the results of the two, where they follow the same algorithm
    error: float | None = None


@dataclass(frozen=True)
class BenchmarkResult:
    """What a run found."""

    figures: tuple[BenchmarkRow, ...]  # lines of the table
    # single numbers: peak and bandwidth, scaling over cores, bytes of state, percentiles of a step, simulations
    facts: Mapping[str, float]

    def table(self) -> Table:
        """Return its lines as a table."""
        rows = []
        for row in self.figures:
            median, low, high = (f"{x:.1f}" if x < 1000.0 else f"{x:.0f}" for x in row.ns)
            ratio = "" if row.ratio is None else f"{row.ratio:.3g}"
            rows.append((row.name, median, f"{low} to {high}", ratio, "" if row.error is None else f"{row.error:.0e}"))
        note = "bare: without the sequential test; times as long as the first of its kind"
        return Table("Time per sample", note, ("", "ns per sample", "quartiles", "times", "difference"), tuple(rows))


WHOLE = "everything"
WARM_UP = 3  # blocks of a fleet before it is measured: until the noise filter is full, fewer samples are tested


def benchmark_loop(**monitor: Any) -> Loop:
    """Return the reference rig with other monitor settings."""
    from servoscope.models.loop import Loop

    content = Loop.load(Path(str(files("servoscope"))) / "simulation" / "reference-rig.toml").to_dict()
    return Loop.from_dict(content | {"monitor": content["monitor"] | monitor})


def run_benchmarks(repeats: int = 9, *, share: float = 1.0) -> BenchmarkResult:
    """Measure everything; about a minute."""
    from servoscope.learning.learn import learn_baseline
    from servoscope.simulation import reference, simulate

    loop, amount = benchmark_loop(), BenchmarkSize.scaled(share)
    recording, _ = simulate(loop, reference("profile", 60.0, loop.sample_rate), seed=1)
    baseline = learn_baseline(loop, [recording])
    facts = _measure_machine(repeats)
    figures = _measure_log(baseline, recording, repeats, amount)
    figures += _measure_two_stage(recording, repeats, amount)
    facts |= _measure_steps(baseline, recording, amount)
    more, scaling = _measure_fleet(baseline, recording, repeats, amount)
    figures += more
    facts |= scaling
    figures += _measure_layers(baseline, recording, amount)
    figures += _measure_peers(baseline, recording, max(3, repeats // 3), amount)
    facts |= _compare_fleet_with_peer(figures)
    facts |= monte_carlo(baseline, amount.simulations)
    return BenchmarkResult(tuple(figures), facts)


def _benchmark_row(
    name: str, measured: JobTiming, samples: int, base: tuple[str, JobTiming, int] | None = None
) -> BenchmarkRow:
    ns = 1e9 * measured.median / samples, 1e9 * measured.low / samples, 1e9 * measured.high / samples
    processor = 1e9 * measured.processor / samples
    if base is None:
        return BenchmarkRow(name, ns, processor)
    return BenchmarkRow(name, ns, processor, processor / (1e9 * base[1].processor / base[2]), base[0])


def _measure_machine(repeats: int) -> dict[str, float]:
    burn, count = limits.multiply_add_job(200_000)
    copy, moved = limits.copy_job()
    timings = time_interleaved({"fma": burn, "copy": copy}, repeats)
    return {
        "peak multiply-adds per ns, one core, double": count / timings["fma"].processor / 1e9,
        "memory, GB/s read and written, one core": moved / timings["copy"].processor / 1e9,
        "bits of a vector (256: AVX2, 512: AVX-512)": vector_bits(),
    }


def _measure_layers(baseline: Baseline, recording: Recording, amount: BenchmarkSize) -> list[BenchmarkRow]:
    try:
        spent = measure_layers(baseline, recording, amount.assets)
    except (ImportError, ServoscopeError):  # the service is an extra, and its decoder another
        return []
    rows = []
    for layer, seconds in spent.items():
        ratio, to = (None, "") if layer == "kernel" else (seconds / spent["kernel"], "service, kernel")
        rows.append(BenchmarkRow(f"service, {layer}", (1e9 * seconds,) * 3, 1e9 * seconds, ratio, to))
    return rows


def _repeat_signals(recording: Recording, samples: int) -> list[np.ndarray[Any, Any]]:
    return [np.resize(signal, samples) for signal in (recording.r, recording.u, recording.y)]


def _without_cusum(baseline: Baseline) -> Baseline:
    thresholds = baseline.thresholds.model_copy(update={"hypotheses": ()})
    return baseline.model_copy(update={"thresholds": thresholds})


def _measure_log(baseline: Baseline, recording: Recording, repeats: int, amount: BenchmarkSize) -> list[BenchmarkRow]:
    from servoscope.diagnosis.monitor import Monitor
    from servoscope.estimation.recursion import Recursion

    monitors = {"whole": Monitor(baseline), "bare": Monitor(_without_cusum(baseline))}
    signals, few = _repeat_signals(recording, amount.log), _repeat_signals(recording, amount.slow_log)
    pipeline = baseline.pipeline()
    c = pipeline.constants(baseline.tuning)
    jobs: dict[str, Callable[[], object]] = {
        name: lambda m=monitor: m.run(m.init(), *signals)  # type: ignore[misc]
        for name, monitor in monitors.items()
    }
    jobs["numpy"] = lambda: oracle.reference_recursion(c, few[0], few[1], few[2])
    timings = time_interleaved(jobs, repeats)
    theta, S = oracle.reference_recursion(c, few[0], few[1], few[2])
    recursion = Recursion([c])
    _, rows = recursion.run(recursion.start(), *(signal[None] for signal in few))
    n = len(theta)
    ours = rows[0, -1, 5 : 5 + n], rows[0, -1, 5 + n : 5 + n + n * n].reshape(n, n)
    error = max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in zip(ours, (theta, S), strict=True))
    base = "log, NumPy", timings["numpy"], amount.slow_log
    bare = _benchmark_row("log, bare", timings["bare"], amount.log, base)
    return [
        _benchmark_row(base[0], timings["numpy"], amount.slow_log),
        replace(bare, error=error),
        _benchmark_row("log, everything", timings["whole"], amount.log, base),
    ]


def _measure_two_stage(recording: Recording, repeats: int, amount: BenchmarkSize) -> list[BenchmarkRow]:
    from servoscope.diagnosis.monitor import Monitor
    from servoscope.learning.learn import learn_baseline

    monitor = Monitor(_without_cusum(learn_baseline(benchmark_loop(two_stage="adaptive"), [recording])))
    signals = _repeat_signals(recording, amount.log)
    timings = time_interleaved({"two": lambda: monitor.run(monitor.init(), *signals)}, repeats)
    return [_benchmark_row("log, bare, with a FIR of 40", timings["two"], amount.log)]


def _measure_steps(baseline: Baseline, recording: Recording, amount: BenchmarkSize) -> dict[str, float]:
    from servoscope.diagnosis.monitor import Monitor

    monitor = Monitor(baseline)
    state = monitor.init()
    samples = list(zip(*(x.tolist() for x in _repeat_signals(recording, amount.steps)), strict=True))
    times = np.empty(amount.steps)
    for k, (r, u, y) in enumerate(samples):
        begin = time.perf_counter_ns()
        monitor.step(state, r, u, y)
        times[k] = time.perf_counter_ns() - begin
    median, rare = np.percentile(times[100:], [50.0, 99.9])
    return {
        "one step from Python, us, median": float(median) / 1e3,
        "one step from Python, us, 99.9 %": float(rare) / 1e3,
        "state of an asset, bytes": float(state.nbytes),
    }


@contextmanager
def _single_core() -> Iterator[None]:
    from servoscope.estimation.kernel import threads

    cores = threads.core_count
    threads.core_count = lambda: 1
    try:
        yield
    finally:
        threads.core_count = cores


def _measure_fleet(
    baseline: Baseline, recording: Recording, repeats: int, amount: BenchmarkSize
) -> tuple[list[BenchmarkRow], dict[str, float]]:
    from servoscope.diagnosis.monitor import Monitor

    rng, total = np.random.default_rng(0), amount.fleet * FLEET_SAMPLES
    begin = rng.integers(0, recording.samples - FLEET_SAMPLES, amount.fleet)
    at = begin[:, None] + np.arange(FLEET_SAMPLES)
    jobs: dict[str, Callable[[], object]] = {}
    for precision, number in (("double", np.float64), ("single", np.float32)):
        signals = [signal[at].astype(number) for signal in (recording.r, recording.u, recording.y)]
        for what, each in (("bare", _without_cusum(baseline)), (WHOLE, baseline)):
            monitor = Monitor([each] * amount.fleet, precision=precision)  # type: ignore[arg-type]
            state = monitor.init()
            for _ in range(WARM_UP):
                state, _ = monitor.run(state, *signals)
            name = f"fleet of {amount.fleet}, {precision}, {what}"

            def job(m: Any = monitor, s: Any = state, x: Any = signals) -> None:
                m.run(s, *x)

            def alone(job: Callable[[], None] = job) -> None:
                with _single_core():
                    job()

            jobs[name] = job
            jobs[f"{name}, 1 core"] = alone
    timings = time_interleaved(jobs, repeats)
    figures = [_benchmark_row(name, measured, total) for name, measured in timings.items()]
    from servoscope.estimation.kernel.threads import core_count

    first = next(iter(timings))
    single, whole = timings[f"{first}, 1 core"], timings[first]
    return figures, {
        "scaling of a fleet over cores, share of the ideal": single.median / whole.median / core_count(),
        "processor time of a fleet on one core, share of that on all": single.processor / whole.processor,
        "cores": float(core_count()),
    }


def _measure_peers(baseline: Baseline, recording: Recording, repeats: int, amount: BenchmarkSize) -> list[BenchmarkRow]:
    pipeline, tuning = baseline.pipeline(), baseline.tuning
    g = pipeline.regression(recording.r, recording.u, recording.y, recording.restart)
    eta, phi = (
        g.eta[g.ok][: amount.slow_log].copy(),
        np.ascontiguousarray(g.phi[g.ok][: amount.slow_log] / tuning.scale),
    )
    P_d = tuning.P_d * np.outer(tuning.scale, tuning.scale)
    figures = []
    for what, jobs in (
        ("Kalman filter", peers.kalman_jobs(eta, phi, P_d, tuning.R, pipeline.memory)),
        ("least squares", peers.least_squares_jobs(eta, phi, pipeline.memory)),
    ):
        timings = time_interleaved(jobs, repeats)
        results = {name: job() for name, job in jobs.items()}
        base = f"{what}, servoscope", timings["servoscope"], amount.slow_log
        for name, measured in timings.items():
            figure = _benchmark_row(f"{what}, {name}", measured, amount.slow_log, base)
            error = float(np.abs(results[name] - results["servoscope"]).max() / np.abs(results["servoscope"]).max())
            figures.append(replace(figure, error=error))
    return figures


def _compare_fleet_with_peer(figures: list[BenchmarkRow]) -> dict[str, float]:
    """Return how often all of a fleet's sample goes into one update of the best-known peer, if that is installed."""
    peer = next((each.processor for each in figures if each.name == "Kalman filter, filterpy"), None)
    if peer is None:
        return {}
    fleet = next(row for row in figures if row.name.endswith(f"double, {WHOLE}, 1 core"))
    return {f"filterpy's update over a fleet's sample, {WHOLE}, one core": peer / fleet.processor}


def monte_carlo(baseline: Baseline, count: int, seconds: float = 60.0) -> dict[str, float]:
    """Simulate closed loops, half of them with a leak, and follow them as one fleet; return times [s] and alarms."""
    from servoscope.diagnosis.monitor import Monitor
    from servoscope.simulation import FaultEvent, reference, simulate

    loop = baseline.loop
    r = reference("profile", seconds, loop.sample_rate)
    leak = (FaultEvent("C_ie", 1.2, seconds / 2.0),)
    begin = time.perf_counter()
    signals = np.empty((3, count, len(r)))
    for seed in range(count):
        recording, _ = simulate(loop, r, faults=leak if seed % 2 else (), seed=1000 + seed)
        signals[:, seed] = recording.r, recording.u, recording.y
    simulated = time.perf_counter()
    monitor = Monitor([baseline] * count)
    _, trace = monitor.run(monitor.init(), *signals)
    alarms = np.asarray(trace.exceeded.any(axis=1), dtype=np.bool_).reshape(-1)
    done = time.perf_counter()
    return {
        f"{count} simulations of {seconds:g} s, s": simulated - begin,
        f"{count} simulations followed as a fleet, s": done - simulated,
        "alarms among those with a leak, share": float(alarms[1::2].mean()),
        "alarms among the healthy, share": float(alarms[::2].mean()),
    }


def main() -> None:
    """Measure and print."""
    command = parser(__doc__)
    command.add_argument("--repeats", type=int, default=9)
    command.add_argument("--share", type=float, default=1.0, help="of assets, samples and simulations")
    given = command.parse_args()
    result = run_benchmarks(given.repeats, share=given.share)
    show([result.table()], given.json, {name: f"{number:.4g}" for name, number in result.facts.items()})
