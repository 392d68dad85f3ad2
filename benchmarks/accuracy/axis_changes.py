"""Several changes in one log of an axis, and their repair: `diagnose`, sums, and partitioned least squares compared.

    python benchmarks accuracy/axis_changes [--seed 0] [--logs 24] [--healthy 6] [--json]

Each axis (accuracy/axis.py) is learned from six recordings of 60 s, whose Coulomb friction scatters by 2 %. The logs
have 300 s with one to three changes. The last state of a log counts as named if its causes are those that were
changed, each with its size in its 95 % interval. Processor time: 15 minutes on one core, most of it of `diagnose`.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from tables import Table, parser, show

import servoscope as ss
from accuracy.axis import AXES, LIMIT, RATE, Axis, moves, record_course
from accuracy.block_partition import BlockPartition
from servoscope.sums.axis import AxisEquations
from servoscope.sums.healthy import Healthy
from servoscope.sums.learning import learn
from servoscope.sums.verdict import judge

DAYS, DAY_S, LOG_S = 6, 60.0, 300.0
SCATTER = 0.02  # of Coulomb friction between recordings
MIN_CHANGE, MAX_CHANGE = 0.12, 0.6  # of a parameter
MIN_APART_S = 35.0
MAX_DATE_ERROR_S = 2.0
SURE = 0.8  # probability from which sums name
COURSES = ("one", "two", "three", "repaired", "two, repaired", "first repaired")
FIELDS = {"payload": "mass", "lubrication": "viscous", "dry_friction": "coulomb", "motor_constant": "gain"}
COEFFICIENTS = {"inertia": "payload", "viscous_friction": "lubrication", "coulomb_friction": "dry_friction"}

State = dict[str, float]
"""Ratio by cause; none: healthy."""
Intervals = dict[str, tuple[float, float, float]]


class Answer(NamedTuple):
    """What a detector says of a log: times of change, and its last state; None: changed, and nothing named."""

    times: list[float]
    last: list[Intervals] | None  # sets of causes that it cannot distinguish; an empty one: healthy


def loop() -> ss.Loop:
    """Return the loop file of all axes."""
    return ss.Loop.from_dict(
        {
            "name": "axis",
            "sample_rate": RATE,
            "input_limits": [-LIMIT, LIMIT],
            "plant": {"kind": "axis", "terms": ["viscous", "coulomb", "offset"]},
            "monitor": {"cutoff": 10.0},
        }
    )


def changed(axis: Axis, state: State) -> Axis:
    """Return an axis in a state; all dry friction goes together, and a weak motor needs more u."""
    values = {FIELDS[cause]: getattr(axis, FIELDS[cause]) * ratio for cause, ratio in state.items()}
    if "dry_friction" in state:
        values["static"] = axis.static * state["dry_friction"]
    if "motor_constant" in state:
        values["gain"] = axis.gain / state["motor_constant"]
    return replace(axis, **values)


def of_day(name: str, rng: np.random.Generator) -> Axis:
    """Return an axis on some day."""
    axis, factor = AXES[name], float(np.exp(SCATTER * rng.standard_normal()))
    return replace(axis, coulomb=axis.coulomb * factor, static=axis.static * factor)


def drawn(rng: np.random.Generator, course: str) -> list[tuple[float, State]]:
    """Draw a course: states with the times from which they hold."""
    first, second = rng.permutation(list(FIELDS))[:2].tolist()
    while {first, second} == {"payload", "motor_constant"}:  # those of friction and inertia, or of friction and gain
        first, second = rng.permutation(list(FIELDS))[:2].tolist()
    a, b = ({cause: size(rng)} for cause in (first, second))
    states = {
        "one": [a],
        "two": [a, a | b],
        "three": [a, a | b, b],
        "repaired": [a, {}],
        "two, repaired": [a, a | b, {}],
        "first repaired": [a, {}, b],
    }[course]
    while True:
        times = np.sort(rng.uniform(MIN_APART_S, LOG_S - MIN_APART_S, len(states)))
        if (np.diff(times) > MIN_APART_S).all():
            return [(float(t), state) for t, state in zip(times, states, strict=True)]


def size(rng: np.random.Generator) -> float:
    """Draw a ratio, as often up as down."""
    ratio = 1.0 + float(rng.uniform(MIN_CHANGE, MAX_CHANGE))
    return ratio if rng.integers(2) else 1.0 / ratio


@functools.cache
def days(name: str, seed: int) -> tuple[ss.Recording, ...]:
    """Return the healthy recordings of an axis."""
    made = []
    for i in range(DAYS):
        rng = np.random.default_rng([seed, list(AXES).index(name), i])
        r = moves(int(rng.integers(2**31)), seconds=DAY_S)
        made.append(record_course([(0.0, of_day(name, rng))], r, int(rng.integers(2**31))))
    return tuple(made)


@functools.cache
def baseline(name: str, seed: int) -> ss.Baseline:
    """Return what `diagnose` learns."""
    return ss.learn(loop(), days(name, seed))


@functools.cache
def sums(name: str, seed: int) -> tuple[AxisEquations, Healthy]:
    """Return what sums learn."""
    equations = AxisEquations.of_healthy(loop(), days(name, seed))
    return equations, learn(equations, [equations.sums(day) for day in days(name, seed)])


@functools.cache
def partition(name: str, seed: int) -> BlockPartition:
    """Return what partitioned least squares learn."""
    detector = BlockPartition(10.0)
    detector.learn(days(name, seed))
    return detector


def by_diagnose(name: str, seed: int, log: ss.Recording) -> Answer:
    """Ask `diagnose`."""
    told = ss.diagnose(baseline(name, seed), log)
    times = []
    for interval in told.intervals:
        if interval.onset_s is not None and not interval.from_start:
            times.append(interval.onset_s[1])
        times += [interval.end_s] if interval.end_s is not None else []
    if told.verdict == "healthy" or (told.intervals and told.intervals[-1].end_s is not None):
        return Answer(times, [{}])
    named = told.intervals[-1].faults if told.intervals else ()
    return Answer(times, [{f.name: (f.interval[0], f.ratio, f.interval[1]) for f in named}] if named else None)


def by_sums(name: str, seed: int, log: ss.Recording) -> Answer:
    """Ask `servoscope.sums`."""
    equations, healthy = sums(name, seed)
    segments = judge(healthy, equations.sums(log)).segments
    times = [segment.begin_s[1] for segment in segments[1:]]
    if not segments[-1].changed:
        return Answer(times, [{}])
    best = segments[-1].explanations[0]
    known = best.causes and best.probability >= SURE
    return Answer(times, [e.ratios for e in (best, *best.alike)] if known else None)


def by_partition(name: str, seed: int, log: ss.Recording) -> Answer:
    """Ask partitioned least squares, which know coefficients: all of them times the same is the motor."""
    stretches = partition(name, seed).judge(log)
    ratios = {COEFFICIENTS[key]: interval for key, interval in stretches[-1].ratios.items()}
    low, high = (f(interval[k] for interval in ratios.values()) if ratios else 1.0 for f, k in ((max, 0), (min, 2)))
    if len(ratios) == len(COEFFICIENTS) and low < high:
        ratios = {"motor_constant": (low, 0.5 * (low + high), high)}
    return Answer([stretch.begin_s for stretch in stretches[1:]], [ratios])


DETECTORS = {"diagnose": by_diagnose, "sums": by_sums, "partitioned least squares": by_partition}


def judged(answer: Answer, truth: list[tuple[float, State]]) -> dict[str, float]:
    """Compare an answer with the truth."""
    times, last = [t for t, _ in truth], truth[-1][1] if truth else {}
    near = [min((abs(t - told) for told in answer.times), default=np.inf) for t in times]
    extra = [told for told in answer.times if min((abs(t - told) for t in times), default=np.inf) > MAX_DATE_ERROR_S]
    told = next((one for one in answer.last or () if set(one) == set(last)), None)
    held = told is not None and all(told[cause][0] <= ratio <= told[cause][2] for cause, ratio in last.items())
    wrong = bool(answer.last) and told is None and any(answer.last or ())
    return {
        "named": told is not None,
        "held": held,
        "wrong": wrong,
        "changes": len(times),
        "dated": sum(error <= MAX_DATE_ERROR_S for error in near),
        "extra": len(extra),
        "false": not truth and (bool(answer.times) or answer.last != [{}]),
    }


def logs(seed: int, count: int, healthy: int) -> Iterator[tuple[str, list[tuple[float, State]], ss.Recording]]:
    """Yield axis, truth and log."""
    for i in range(count + healthy):
        rng = np.random.default_rng([seed, 1000 + i])
        name = list(AXES)[i % len(AXES)]
        truth = drawn(rng, COURSES[(i // len(AXES)) % len(COURSES)]) if i < count else []
        day = of_day(name, rng)
        course = [(0.0, day), *((t, changed(day, state)) for t, state in truth)]
        r = moves(int(rng.integers(2**31)), seconds=LOG_S)
        yield name, truth, record_course(course, r, int(rng.integers(2**31)))


def main() -> None:
    """Print the table."""
    command = parser(__doc__)
    command.add_argument("--seed", type=int, default=0)
    command.add_argument("--logs", type=int, default=24)
    command.add_argument("--healthy", type=int, default=6)
    command.add_argument("--only", choices=list(DETECTORS), help="one detector")
    command.add_argument("--verbose", action="store_true", help="print each answer that is not right")
    given = command.parse_args()
    detectors = {key: ask for key, ask in DETECTORS.items() if given.only in (None, key)}
    results: dict[str, list[dict[str, float]]] = {key: [] for key in detectors}
    for name, truth, log in logs(given.seed, given.logs, given.healthy):
        for key, ask in detectors.items():
            ask(name, given.seed, log) if not results[key] else None  # what is compiled and learned first
            begin = time.process_time()
            answer = ask(name, given.seed, log)
            result = judged(answer, truth) | {"seconds": time.process_time() - begin}
            results[key].append(result)
            wrong = not result["held"] or result["extra"] or result["dated"] < result["changes"]
            if given.verbose and wrong:
                print(key, name, truth, answer, flush=True)
    rows = []
    for key, found in results.items():
        faulty, healthy = found[: given.logs], found[given.logs :]
        total = {field: int(sum(result[field] for result in faulty)) for field in faulty[0]}
        rows.append(
            (
                key,
                f"{total['named']} of {len(faulty)}",
                f"{total['held']}",
                f"{total['wrong']}",
                f"{total['dated']} of {total['changes']}",
                f"{total['extra']}",
                f"{int(sum(result['false'] for result in healthy))} of {len(healthy)}",
                f"{np.median([result['seconds'] for result in found]):.2g}",
            )
        )
    columns = ("detector", "last state named", "and every size in its interval", "another name", "dates within 2 s")
    columns += ("further changes", "healthy logs called changed", "processor time [s]")
    note = f"{given.logs} logs with one to three changes, {given.healthy} healthy ones, seed {given.seed}."
    show([Table("Several changes in one log of an axis", note, columns, tuple(rows))], given.json)


if __name__ == "__main__":
    main()
