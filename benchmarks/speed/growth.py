"""How the cost of a sample grows with assets, coefficients, FIR length and frequencies, beside the machine's limits.

python benchmarks speed/growth [-o docs/images/growth.png] [--json]
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from tables import machine, parser
from tools import limits
from tools.timing import time_interleaved

from servoscope.estimation.kernel.evaluation_steps import EvaluationSteps
from servoscope.estimation.kernel.sample_steps import TILE, SampleSteps
from servoscope.estimation.recursion import EvaluationConstants, Recursion, RecursionConstants
from servoscope.estimation.two_stage import StageOneRunner, StageOneTuning
from servoscope.models.lti import block_diagonal, sample_system, state_variable_filter

RATE = 100.0
REPEATS = 9


class Tally(float):
    """A number that counts what is done with numbers of its kind."""

    done = 0

    def _counted(self, other: float, name: str) -> Tally:
        Tally.done += 1
        return Tally(getattr(float, name)(self, float(other)))

    for _name in ("__add__", "__radd__", "__sub__", "__rsub__", "__mul__", "__rmul__", "__truediv__", "__rtruediv__"):
        locals()[_name] = functools.partialmethod(_counted, name=_name)

    def __neg__(self) -> Tally:
        return Tally(-float(self))


def constants(n: int = 4, frequencies: int = 3) -> RecursionConstants:
    """Return the recursion of a loop of n coefficients behind a state-variable filter of order n."""
    svf = state_variable_filter(10.0, n)
    bank = block_diagonal([sample_system(svf, RATE, "zoh").output(np.eye(1, n)), sample_system(svf, RATE, "foh")])
    route = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    system = type(bank)(bank.A, bank.B @ route, bank.C / np.abs(bank.C).max(axis=1)[:, None], bank.D @ route)
    velocity = sample_system(state_variable_filter(25.0, 2), RATE, "foh").output(np.array([[0.0, 1.0]]))
    rng = np.random.default_rng(0)
    view = EvaluationConstants(np.eye(n), np.zeros(n), rng.standard_normal((2 * frequencies, n)), RATE)
    one, a = np.eye(n), np.array([0.5, 0.1, 0.05, 0.01])
    return RecursionConstants(
        estimator="akf", steady=True, bank=system, velocity=velocity, v_of_r=False, nonlinear=(), shapes=(),
        limits=(-np.inf, np.inf), deadzone=(np.inf, -np.inf), sign_speed=0.0, rest_speed=0.0, still_speed=0.0,
        only_moving=False, wait=20, stride=1, every=10, scale=np.ones(n), basis=one, theta=np.zeros(n),
        origin=np.zeros(n), P_d=one, R=100.0, a=a, heads=a, variance=1.0, memory=500.0, extra=0, watch=None, view=view,
    )  # fmt: skip


def operations(c: RecursionConstants) -> float:
    """Return how many additions and multiplications one sample takes, its share of an evaluation included."""
    recursion = Recursion([c])
    gain = SimpleNamespace(steady_gain=lambda R, phi: [x * (1.0 / (R + sum(p * p for p in phi))) for x in phi])
    steps = SampleSteps(recursion._spec, gain)
    row = [Tally(x) for x in recursion._table[0]]
    s, h = ([Tally(0.1)] * size for size in (recursion.sizes.floats, 8))
    v, status, q = ([Tally(1.0)] * size for size in (recursion.sizes.rows, 1, recursion.sizes.row))
    tile = [Tally(0.1)] * (4 * TILE)
    Tally.done = 0
    steps.advance_filters(row, s, h, status, v, [], tile, 0, True)
    steps.update_estimate(row, s, h, v, [], [], [])
    each, Tally.done = Tally.done, 0
    for i in range(recursion.sizes.floats):
        s[i] = Tally(1.0 + i % 3)
    evaluation = EvaluationSteps(recursion._spec)
    evaluation.write_evaluation(row, s, h, q)
    for f in range(recursion.sizes.frequencies):
        evaluation.write_response(row, s, h, f, q)
    return each + Tally.done / c.every


def moved(c: RecursionConstants, samples: int) -> float:
    """Return how many bytes one sample reads and writes, its share of an evaluation and of the state included.

    What is written is read before, by the processor, to fill the cache's lines.
    """
    recursion = Recursion([c])
    return 8.0 * (3 + 2 * recursion.sizes.row / c.every + 3 * recursion.size / samples)


def fleet(c: RecursionConstants, assets: int, samples: int) -> tuple[Callable[[], object], int]:
    """Return a job of one core over a fleet, and its samples."""
    recursion = Recursion([c] * assets)
    signals = np.random.default_rng(1).standard_normal((3, assets, samples))
    state, _ = recursion.run(recursion.start(), *signals)
    return lambda: recursion.run(state, *signals), assets * samples


def fir(n: int) -> tuple[Callable[[], object], int]:
    """Return a job of stage 1 with n taps, and its samples."""
    from speed.chain import benchmark_loop

    loop = benchmark_loop(two_stage="adaptive", stage_one_length=n)
    P_d = np.eye(n) * 1e-3
    stage = StageOneRunner(loop, StageOneTuning((0.1,) * n, tuple(tuple(row) for row in P_d.tolist()), 1.0))
    r, u = np.random.default_rng(1).standard_normal((2, 20_000))
    restart = np.zeros(20_000, dtype=np.bool_)
    return lambda: stage.run(stage.start(), r, u, restart), 20_000


def main() -> None:
    """Measure, draw, print."""
    command = parser(__doc__)
    command.add_argument("-o", "--output", type=Path, help="also draw it")
    given = command.parse_args()
    from servoscope.estimation.kernel import threads

    threads.core_count = lambda: 1
    taps = "taps of stage 1 (FIR), one log"
    loops = {
        "assets": {A: (constants(), A, max(100, 100_000 // A)) for A in (1, 4, 16, 64, 1000, 10_000, 100_000)},
        "coefficients": {n: (constants(n), 1024, 100) for n in range(2, 9)},
        "frequencies": {F: (constants(4, F), 1024, 100) for F in (1, 3, 10, 30, 100)},
    }
    burn, count = limits.multiply_add_job(200_000)
    copy, copied = limits.copy_job()
    jobs: dict[str, Callable[[], object]] = {"fma": burn, "copy": copy}
    samples, least, bytes_ = {}, {}, {}
    for sweep, points in loops.items():
        for x, (c, assets, length) in points.items():
            jobs[f"{sweep}={x}"], samples[sweep, x] = fleet(c, assets, length)
            least[sweep, x], bytes_[sweep, x] = operations(c) / 2, moved(c, length)
    for n in (8, 16, 40, 64, 128):
        jobs[f"{taps}={n}"], samples[taps, n] = fir(n)
        least[taps, n], bytes_[taps, n] = n * n + 4 * n, 3 * 8.0
    found = time_interleaved(jobs, REPEATS)
    per_fma, per_byte = 1e9 * found["fma"].processor / count, 1e9 * found["copy"].processor / copied
    result: dict[str, Any] = {
        "machine": machine(),
        "ns per multiply-add at the peak, one core": per_fma,
        "ns per byte through memory, one core": per_byte,
    }
    for (sweep, x), number in samples.items():
        result.setdefault(sweep, {})[x] = {
            "ns": 1e9 * found[f"{sweep}={x}"].processor / number,
            "multiply-adds": least[sweep, x] * per_fma,
            "memory": bytes_[sweep, x] * per_byte,
        }
    sweeps = [*loops, taps]
    if given.output:
        draw(result, sweeps, given.output)
    if given.json:
        print(json.dumps(result, indent=1))
        return
    print(machine())
    print(f"{1.0 / per_fma:.1f} multiply-adds per ns, {1.0 / per_byte:.1f} GB/s")
    for sweep in sweeps:
        print(f"\n| {sweep} | ns per sample | its multiply-adds | its bytes |\n| --- | --- | --- | --- |")
        for x, p in result[sweep].items():
            print(f"| {x} | {p['ns']:.1f} | {p['multiply-adds']:.1f} | {p['memory']:.1f} |")


def draw(result: dict[str, Any], sweeps: list[str], path: Path) -> None:
    """Draw one panel per sweep."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(9.0, 6.5), layout="constrained")
    for ax, sweep in zip(axes.flat, sweeps, strict=True):
        points = result[sweep]
        x = list(points)
        for name, line, label in (
            ("ns", "o-", "measured, one core"),
            ("multiply-adds", "k--", "its multiply-adds at the peak rate"),
            ("memory", "k:", "its bytes through memory"),
        ):
            ax.plot(x, [p[name] for p in points.values()], line, label=label)
        ax.set(xlabel=sweep, ylabel="ns per sample", ylim=(0.0, None))
        if sweep in ("assets",):
            ax.set_xscale("log")
        ax.grid(alpha=0.3)
    axes[0, 0].legend()
    figure.savefig(path, dpi=120)
