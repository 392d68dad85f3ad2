"""Logs and loop files as nobody wants them, through init, inspect, learn, diagnose and assess.

    python benchmarks hostile/logs [--seed 1] [--logs 1000] [--loops 2000]

Each answer is a result or an error of one line; a traceback, an error of several lines and more than 20 s of processor
time are printed, and counted. The program ends with 1 where there is one; Ctrl-C ends it with what was tried so far.
"""

from __future__ import annotations

import argparse
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import servoscope as ss
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import ServoscopeError
from servoscope.simulation import simulate

MAX_S = 20.0  # of processor time for one command
MAX_SHOWN = 10  # tracebacks
LONGEST_S = 20.0  # of a log; the shortest is a quarter of it
Generator = np.random.Generator
Log = dict[str, FloatArray]

PLANTS: tuple[dict[str, Any], ...] = (
    {"kind": "axis"},
    {"kind": "axis", "terms": ["viscous", "coulomb", "gravity", "offset"]},
    {"kind": "polynomial", "order": 1},
    {"kind": "polynomial", "order": 2, "friction": "coulomb", "offset": True},
    {"kind": "polynomial", "order": 3},
    {"kind": "cylinder", "terms": ["spring", "overlap", "offset"]},
)


@dataclass
class Count:
    """What came of the commands."""

    logs: int = 0
    loops: int = 0
    answers: Counter[str] = field(default_factory=Counter)
    broken: list[str] = field(default_factory=list)
    slowest_s: float = 0.0

    def run(self, words: str, command: Callable[[], Any]) -> Any:
        """Return what a command returns, None where it refuses or breaks; counted by its first word."""
        name, begun, answer = words.split()[0], time.process_time(), None
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                answer = command()
            self.answers[f"{name}: done"] += 1
        except ServoscopeError as error:
            self.answers[f"{name}: refused"] += 1
            if "\n" in str(error).strip():
                self.broken.append(f"{words}: an error of several lines: {error}")
        except Exception as error:
            self.broken.append(f"{words}: {type(error).__name__}: {error}")
            if len(self.broken) <= MAX_SHOWN:
                traceback.print_exc()
        took = time.process_time() - begun
        self.slowest_s = max(self.slowest_s, took)
        if took > MAX_S:
            self.broken.append(f"{words}: {took:.0f} s")
        return answer


def healthy_log(rng: Generator, longest_s: float) -> Log:
    """Draw a log of a simulated axis: length, rate, motion, friction, units and resolution."""
    seconds = rng.uniform(0.25 * longest_s, longest_s)
    rate = float(rng.choice([50.0, 100.0, 200.0]))
    inertia, viscous, coulomb = rng.uniform([0.5, 1.0, 0.0], [3.0, 10.0, 4.0]).tolist()
    coefficients = {"inertia": inertia, "viscous_friction": viscous, "coulomb_friction": coulomb}
    loop = ss.Loop.from_dict({
        "sample_rate": rate, "controller": {"kind": "pi", "k_p": 0.5 * viscous * rate, "k_i": 0.0},
        "plant": {"kind": "axis", "terms": ["viscous", "coulomb"], "coefficients": coefficients},
    })  # fmt: skip
    t = np.arange(max(round(seconds * rate), 3)) / rate
    frequency, kind = rng.uniform(0.3, 3.0), rng.integers(4)
    sine = np.sin(frequency * t)
    r = (sine, np.sign(sine), sine + 0.3 * np.sin(4.3 * frequency * t), np.where(t % 4.0 < 2.0, sine, 0.0))[kind]
    recording = simulate(loop, r, noise_u_std=0.02, noise_y_std=1e-5, seed=int(rng.integers(1 << 30)))[0]
    scale = 10.0 ** rng.integers(-4, 5, 2)
    log = {"t": t, "r": scale[0] * r, "u": scale[1] * recording.u, "y": scale[0] * recording.y}
    if rng.random() < 0.3:
        log = {name: x if name == "t" else quantised(x, float(rng.choice([30.0, 1000.0]))) for name, x in log.items()}
    return log


def quantised(x: FloatArray, steps: float) -> FloatArray:
    """Return a signal in so many steps of its range."""
    step = max(float(np.ptp(x)), 1e-300) / steps
    return np.asarray(np.round(x / step) * step)


def spoiled(rng: Generator, log: Log) -> tuple[str, Log]:
    """Return a log in which one thing is wrong, and what."""
    N, name = len(log["t"]), str(rng.choice(["r", "u", "y"]))
    x, begin = log[name].copy(), int(rng.integers(N))
    some = rng.random(N) < 0.05
    stretch = slice(begin, begin + int(rng.integers(1, 40)))
    ways: dict[str, Callable[[], Mapping[str, FloatArray]]] = {
        "as it is": lambda: {},
        "spikes": lambda: {name: np.where(some, 1e9, x)},
        "a wide spike": lambda: {name: np.concatenate([x[:begin], np.full(len(x[stretch]), 1e9), x[stretch.stop :]])},
        "far off": lambda: {name: x + 1e9},
        "huge": lambda: {name: x * 10.0 ** rng.integers(3, 200)},
        "tiny": lambda: {name: x * 10.0 ** -float(rng.integers(3, 200))},
        "other sign": lambda: {name: -x},
        "other unit": lambda: {name: x * float(rng.choice([1e3, 1e-3, 57.29578, 60.0]))},
        "stuck": lambda: {name: np.where(np.arange(N) < begin, x, x[begin])},
        "empty cells": lambda: {name: np.where(some, np.nan, x)},
        "all empty": lambda: {name: np.full(N, np.nan)},
        "infinite": lambda: {name: np.where(some, np.inf, x)},
        "constant": lambda: {name: np.full(N, x[0])},
        "noise": lambda: {name: rng.normal(size=N)},
        "louder": lambda: {name: x + np.where(np.arange(N) < begin, 0.0, 0.1 * np.std(x)) * rng.normal(size=N)},
        "coarse": lambda: {name: quantised(x, 3.0)},
        "exchanged": lambda: {"u": log["y"], "y": log["u"]},
        "r and y exchanged": lambda: {"r": log["y"], "y": log["r"]},
        "wraps": lambda: {name: np.mod(x, 0.6 * np.ptp(x) + 1e-300)},
        "shuffled rows": lambda: {"t": rng.permutation(log["t"])},
        "jitter": lambda: {"t": log["t"] + rng.uniform(0.0, 0.02, N)},
        "all at once": lambda: {"t": np.zeros(N)},
        "gaps": lambda: {"t": log["t"] + 5.0 * np.cumsum(rng.random(N) < 0.01)},
        "a gain": lambda: {"u": log["u"] * np.where(np.arange(N) < begin, 1.0, float(rng.uniform(0.3, 3.0)))},
    }
    way = str(rng.choice(list(ways)))
    return f"{name} {way}", log | dict(ways[way]())


def try_log(count: Count, rng: Generator, words: str, longest_s: float) -> None:
    """Put a log, in which up to two things are wrong, through all commands."""
    good, wrong = healthy_log(rng, longest_s), []
    bad = good
    for _ in range(int(rng.integers(1, 3))):
        what, bad = spoiled(rng, bad)
        wrong.append(what)
    words = f"{words}: {', '.join(wrong)}"
    with TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        rows = np.column_stack(list(bad.values()))
        np.savetxt(path, rows, delimiter=",", header=",".join(bad), comments="", fmt="%.9g")
        proposal = count.run(f"init {words}", lambda: ss.init(path))
        count.run(f"inspect {words}", lambda: ss.inspect(path))
        count.run(f"assess {words}", lambda: ss.assess(path))
    plant, rate = PLANTS[rng.integers(len(PLANTS))], 1.0 / float(np.median(np.diff(good["t"])))
    loop = ss.Loop.from_dict({"sample_rate": float(f"{rate:.6g}"), "plant": plant})
    proposed = loop if proposal is None else proposal.loop
    count.run(f"learn {words}", lambda: ss.learn(proposed, [ss.read(bad, proposed)]))
    # what is learned from the log as it should be judges the spoiled one
    learned = count.run(f"learn {words}, before", lambda: ss.learn(loop, [ss.read(good, loop)]))
    if learned is not None:
        count.run(f"diagnose {words}", lambda: ss.diagnose(learned, ss.read(bad, loop)))


def drawn_loop(rng: Generator) -> dict[str, Any]:
    """Draw a loop file in which keys have odd values, are missing, or are none."""
    settings: dict[str, Any] = {
        "sample_rate": 100.0, "delay": 0.0, "hold": "zoh", "plant": dict(PLANTS[rng.integers(len(PLANTS))]),
        "monitor": {"cutoff": 10.0, "memory": 2.0, "frequencies": [1.0, 5.0]}, "columns": {},
        "controller": {"kind": "pi", "k_p": 10.0, "k_i": 0.0}, "input_limits": [-10.0, 10.0],
    }  # fmt: skip
    values = (0, -1, 1e-9, 1e9, float("nan"), float("inf"), "", "text", True, [], [1.0], {}, None, "akf", "foh", 3, 0.5)
    for _ in range(int(rng.integers(1, 4))):
        name = str(rng.choice(["plant", "monitor", "columns", "controller"]))
        table = settings.get(name) if rng.random() < 0.7 else settings
        if not isinstance(table, dict):
            continue
        keys = [*table, "model_error", "rest_speed", "estimator", "update_when", "input", "unknown"]
        key = str(rng.choice(keys))
        if rng.random() < 0.2:
            table.pop(key, None)
        else:
            table[key] = values[rng.integers(len(values))]
    return settings


def try_loop(count: Count, rng: Generator, words: str, log: Log) -> None:
    """Read a loop file, and learn and diagnose with it where it is one."""
    settings = drawn_loop(rng)
    words = f"{words}: {settings}"
    loop = count.run(f"loop {words}", lambda: ss.Loop.from_dict(settings))
    if loop is not None:
        learned = count.run(f"learn {words}", lambda: ss.learn(loop, [ss.read(log, loop)]))
        if learned is not None:
            count.run(f"diagnose {words}", lambda: ss.diagnose(learned, ss.read(log, loop)))


def try_all(count: Count, seed: int, logs: int, loops: int, longest_s: float = LONGEST_S) -> None:
    """Draw logs and loop files; those of one seed are the same however many are drawn."""
    for i in range(logs):
        try_log(count, np.random.default_rng([seed, 0, i]), f"log {i}", longest_s)
        count.logs += 1
    log = healthy_log(np.random.default_rng([seed, 1]), longest_s)
    log["t"] = np.arange(len(log["t"])) / 100.0
    for i in range(loops):
        try_loop(count, np.random.default_rng([seed, 2, i]), f"file {i}", log)
        count.loops += 1


def main() -> None:
    """Run the command line of this process."""
    command = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    command.add_argument("--seed", type=int, default=1)
    command.add_argument("--logs", type=int, default=1000)
    command.add_argument("--loops", type=int, default=2000)
    given = command.parse_args()
    count = Count()
    with suppress(KeyboardInterrupt):
        try_all(count, given.seed, given.logs, given.loops)
    print(f"{count.logs} logs and {count.loops} loop files of seed {given.seed}")
    for words, times in sorted(count.answers.items()):
        print(f"{words} {times}")
    print(f"{len(count.broken)} broken, the slowest command took {count.slowest_s:.1f} s of processor time")
    for broken in count.broken:
        print(broken.replace("\n", " "))
    sys.exit(bool(count.broken))


if __name__ == "__main__":
    main()
