"""The command line of the simulated world: one seed with what happened in it, or as many as some minutes allow."""

from __future__ import annotations

import argparse
import multiprocessing
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from itertools import count

from simulated.faults import PAIRS
from simulated.planted import PLANTED
from simulated.world import Found, World

RARE = 10  # pairs of fault and place that are printed as the rarest
LONGEST_HISTORY_S = 60.0
MOST_BROKEN = 5  # after which no further seed is tried
MOST_SEEDS = 2000  # within which a planted fault has to be found


def describe(found: Found) -> str:
    """Return what came of one seed."""
    words = [f"seed {found.seed}: {found.steps} steps, {found.lives} lives, {found.seconds:.0f} s simulated"]
    words.append(f"  digest {found.digest}")
    words += [f"  {what}" for what in found.trace]
    words.append("  " + ", ".join(f"{name} {number}" for name, number in sorted(found.counts.items())))
    words += [f"  BROKEN {why}" for why in found.broken]
    return "\n".join(words)


def first_seed() -> int:
    """Return the first of new seeds: it differs from commit to commit."""
    git = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False)
    return int(git.stdout[:8], 16) if git.stdout else int(time.time())


def run_seeds(seeds: Iterator[int], steps: int, deadline: float) -> Iterator[Found]:
    """Yield what comes of seeds until then, by the monotonic clock [s]."""
    for seed in seeds:
        if time.monotonic() > deadline:
            return
        yield World(seed, steps).run()


Part = tuple[int, int, Counter[tuple[str, str]], Counter[str], list[Found]]  # of the histories of one processor


def _work(arguments: tuple[int, int, int, float]) -> Part:
    first, step, steps, deadline = arguments
    histories = ended = 0
    reached, counts, broken = Counter[tuple[str, str]](), Counter[str](), list[Found]()
    for found in run_seeds(count(first, step), steps, deadline):
        histories, ended = histories + 1, ended + (found.steps < steps)
        reached += found.reached
        counts += found.counts
        if found.broken:
            broken.append(found)
            if len(broken) >= MOST_BROKEN:
                break
    return histories, ended, reached, counts, broken


def run_minutes(first: int, steps: int, minutes: float) -> int:
    """Run as many seeds as there is time for on all processors; return how many broke an invariant."""
    jobs = os.cpu_count() or 1
    deadline = time.monotonic() + 60.0 * minutes
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        work = pool.map_async(_work, [(first + i, jobs, steps, deadline) for i in range(jobs)])
        parts = work.get(60.0 * minutes + LONGEST_HISTORY_S)  # a history that waits for ever is an error, too
    histories, ended = (sum(part[i] for part in parts) for i in range(2))
    reached = sum((part[2] for part in parts), Counter[tuple[str, str]]())
    counts = sum((part[3] for part in parts), Counter[str]())
    broken = [found for part in parts for found in part[4]]
    print(f"{histories} histories of {steps} steps from seed {first}, {ended} of them ended before")
    print(", ".join(f"{name} {number}" for name, number in sorted(counts.items())))
    print(f"{sum(pair in reached for pair in PAIRS)} of {len(PAIRS)} pairs of fault and place; the rarest:")
    for pair in sorted(PAIRS, key=lambda pair: reached[pair])[:RARE]:
        print(f"  {reached[pair]:6d}  {' at '.join(pair)}")
    for found in broken:
        print(describe(found))
        print(f"python benchmarks/chaos.py simulated --seed {found.seed} --steps {steps}")
    return len(broken)


def find_planted(steps: int, first: int = 0, most: int = MOST_SEEDS) -> dict[str, int]:
    """Return for each planted fault after how many seeds it was found, 0 where it was not."""
    after = dict.fromkeys(PLANTED, 0)
    for name, planted in PLANTED.items():
        for n in range(1, most + 1):
            with planted():
                found = World(first + n, steps).run()
            if found.broken:
                after[name] = n
                print(f"{name}: {n} seeds: {found.broken[0]}", flush=True)
                break
    return after


def main(words: list[str]) -> int:
    """Run the command line; return how many seeds broke an invariant."""
    if os.environ.get("PYTHONHASHSEED") != "0":  # the order of sets of names is a part of what a seed repeats
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, "PYTHONHASHSEED": "0"})
    command = argparse.ArgumentParser(prog="chaos.py simulated", description=(__doc__ or "").splitlines()[0])
    command.add_argument("--seed", type=int, help="the one to run, or the first of those of --minutes")
    command.add_argument("--steps", type=int, default=500, help="after which nothing happens any more")
    command.add_argument("--minutes", type=float, help="run new seeds for so long")
    command.add_argument("--planted", action="store_true", help="count the seeds that each planted fault takes")
    given = command.parse_args(words)
    if given.planted:
        return list(find_planted(given.steps).values()).count(0)
    if given.minutes is not None:
        return run_minutes(first_seed() if given.seed is None else given.seed, given.steps, given.minutes)
    found = World(given.seed or 0, given.steps).run()
    print(describe(found))
    return bool(found.broken)
