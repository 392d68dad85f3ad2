"""How often `servoscope assess` is right: measured loops, grids, planted defects, simulated valves.

    python benchmarks assessment/score [--data ../shared/data] [--number 200] [--every 1]

The threshold of the rule on sticking is chosen anew without each loop that is judged.
"""

from __future__ import annotations

import itertools
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from assessment.planted import DEFECTS, logs, valve_logs
from assessment.records import process_logs, servo_logs
from tables import Table, parse_with_data, parser, show

from servoscope.assessment.assess import MIN_RESTING, MIN_ROWS, Assessment, assess
from servoscope.signals.quantisation import find_quantum, white_noise_std
from servoscope.signals.samples import Samples

THRESHOLDS = np.arange(8.0, 60.0)
SEED = 0
MISTAKES = ("u at its upper limit", "frozen y", "straight lines in y", "u does not react")
# measured servos whose sensor is known: folder to the step of the grid of y
QUANTA = {"sts3215": 2.0 * np.pi / 4096.0, "xl330": 2.0 * np.pi / 4096.0, "qube": 2.0 * np.pi / 2048.0, "eha_pump": 1.0}

Loops = dict[tuple[bool, str], list[Assessment]]


def assess_loops(folder: Path) -> Loops:
    """Return the assessments of the process loops, by whether the valve sticks, and loop."""
    found: Loops = defaultdict(list)
    for loop, sticks, samples in process_logs(folder):
        found[sticks, loop].append(assess(samples, name=loop))
    return found


def called(logs: Sequence[Assessment], threshold: float) -> bool:
    """Return whether half the logs of a loop are judged to stick."""
    return float(np.mean([log.value("y rests while u moves on") > threshold for log in logs])) >= 0.5


def shows_signs(log: Assessment) -> bool:
    """Return what two textbook indices say: Horch above 2/3, or He and others above 0.6."""
    return log.value("odd cross-correlation") > 2.0 / 3.0 or log.value("triangular half cycles of u") > 0.6


def choose_threshold(loops: Loops) -> float:
    """Return the middle of the thresholds that are right in most loops."""
    right = [sum(called(logs, x) == sticks for (sticks, _), logs in loops.items()) for x in THRESHOLDS]
    return float(np.median(THRESHOLDS[np.array(right) == max(right)]))


def loop_table(loops: Loops) -> Table:
    """Return how the process loops are judged: with the threshold that is shipped, and one loop left out at a time."""
    rows = []
    for sticks, label in ((True, "sticks"), (False, "others")):
        of = [key for key in loops if key[0] == sticks]
        left_out = [
            called(loops[key], choose_threshold({other: logs for other, logs in loops.items() if other != key}))
            for key in of
        ]
        shipped = [called(loops[key], MIN_RESTING) for key in of]
        single = [log.verdict == "stiction" for key in of for log in loops[key]]
        simple = [float(np.mean([shows_signs(log) for log in loops[key]])) >= 0.5 for key in of]
        counts = (len(of), sum(left_out), sum(shipped), sum(simple))
        rows.append((label, *map(str, counts), f"{sum(single)} of {len(single)}"))
    return Table(
        "Process loops",
        "A loop is judged to stick where half of its logs are.",
        ("label", "loops", "judged to stick, one left out", "as shipped", "two textbook indices", "logs, as shipped"),
        tuple(rows),
    )


def valve_table(number: int) -> Table:
    """Return how simulated loops are judged under noise."""
    rows = []
    for noise in (0.05, 0.2, 0.5):
        count = Counter[tuple[bool, str]]()
        for sticks, samples in valve_logs(number, noise, SEED):
            log = assess(samples)
            count[sticks, "rule"] += log.verdict == "stiction"
            count[sticks, "signs"] += shows_signs(log)
        judged = (str(count[sticks, by]) for by in ("rule", "signs") for sticks in (True, False))
        rows.append((f"{noise:g}", str(number), *judged))
    columns = ("noise", "valves of each kind", "rule, sticks", "rule, others", "indices, sticks", "indices, others")
    note = "Noise of y as a share of half the stiction; the loads of the others swing."
    return Table("Simulated valves", note, columns, tuple(rows))


def rested(log: Samples, seconds: float, rng: np.random.Generator) -> Samples:
    """Return a log with rest at its end: the last values, with the noise that the log has."""
    valid = log[np.isfinite(log.t) & np.isfinite(log.u) & np.isfinite(log.y)]
    step = float(np.median(np.diff(valid.t)))
    rows = int(seconds / step)
    u, y = (np.r_[x, x[-1] + white_noise_std(x) * rng.standard_normal(rows)] for x in (valid.u, valid.y))
    known = not np.array_equal(valid.r, valid.u, equal_nan=True)
    t = np.r_[valid.t, valid.t[-1] + step * np.arange(1, rows + 1)]
    return Samples.from_columns(t, np.r_[valid.r, np.full(rows, valid.r[-1])] if known else u, u, y)


def forms(log: Samples) -> Iterator[tuple[str, Samples]]:
    """Yield a log whole, at half its rate and with rest added, each with and without r."""
    rng = np.random.default_rng(SEED)
    half = log[::2]
    changed = {
        "whole": log,
        "half the rate": Samples.from_columns(half.t, half.r, half.u, half.y),
        "20 s of rest": rested(log, 20.0, rng),
        "40 s of rest": rested(log, 40.0, rng),
    }
    for name, samples in changed.items():
        yield name, samples
        yield f"{name}, without r", Samples.from_columns(samples.t, samples.u, samples.u, samples.y)


def servo_table(folder: Path, every: int) -> Table:
    """Return how many healthy servo recordings get a judgement, and whether the grid of y is found."""
    count: dict[str, Counter[str]] = defaultdict(Counter)
    for of, name, log in itertools.islice(servo_logs(folder), 0, None, every):
        if len(log) < MIN_ROWS:
            continue
        for form, samples in forms(log):
            found = assess(samples, name=name)
            count[form]["logs"] += 1
            count[form][found.verdict] += 1
            if of in QUANTA and form.startswith(("whole", "half")):
                step = found.value("quantum of y")
                count[form]["grids"] += bool(found.facts)
                count[form]["right"] += bool(found.facts) and 0.49 < step / QUANTA[of] < 2.0
    quiet = ("nothing conspicuous", "cannot tell")
    rows = [
        (
            form,
            str(n["logs"]),
            str(n["stiction"]),
            str(n["logs"] - sum(n[word] for word in quiet)),
            str(n["cannot tell"]),
            f"{n['right']} of {n['grids']}" if n["grids"] else "-",
        )
        for form, n in count.items()
    ]
    return Table(
        "Healthy servo recordings",
        "Of eight machines. The step of the encoder is known of four of them; right: within a factor of two.",
        ("log", "recordings", "sticks", "any judgement", "cannot tell", "step of y right"),
        tuple(rows),
    )


def planted_table(number: int) -> Table:
    """Return how often planted defects are found, and how often there is a wrong one."""
    found, wrong = Counter[str](), Counter[str]()
    for defect, samples in logs(number, SEED):
        names = {fact.name for fact in assess(samples).facts}
        found[defect] += names.issuperset(DEFECTS[defect])
        wrong[defect] += any(name in names for name in MISTAKES if name not in DEFECTS[defect])
    rows = tuple(
        (defect, str(number), str(found[defect]) if DEFECTS[defect] else "-", str(wrong[defect])) for defect in DEFECTS
    )
    return Table(
        "Planted defects",
        "In simulated servo logs of a minute at 50 Hz; three of ten have a sensor of 12 bits.",
        ("defect", "logs", "found", "with a wrong fact"),
        rows,
    )


def grid_table(number: int) -> Table:
    """Return how often planted grids are found, and grids where there is none."""
    rng = np.random.default_rng(SEED)
    right, wrong = Counter[str](), Counter[str]()
    for _ in range(number):
        rows, bits = int(rng.choice([600, 1500, 6000])), int(rng.integers(8, 17))
        x = np.sin(np.arange(rows) * rng.uniform(0.001, 0.1)) + rng.choice([0.0, 0.003, 0.05]) * rng.normal(size=rows)
        step = 2.5 / 2.0**bits
        right["8 to 16 bits"] += 0.5 < (find_quantum(np.round(x / step) * step) or 0.0) / step < 2.0
        white = rng.standard_normal(rows)
        plain = {"no grid": x, "float32": x.astype(np.float32), "seven digits": np.round(x, 7), "white noise": white}
        for name, values in plain.items():
            wrong[name] += find_quantum(values.astype(np.float64)) is not None
    made = [("8 to 16 bits", str(number), str(right["8 to 16 bits"]))]
    made += [(name, str(number), str(wrong[name])) for name in ("no grid", "float32", "seven digits", "white noise")]
    return Table("Grids", "Found within a factor of two.", ("signal", "signals", "grid found"), tuple(made))


def seconds(rows: int) -> float:
    """Return the processor time that one log takes [s]."""
    rng = np.random.default_rng(SEED)
    u = np.cumsum(rng.standard_normal(rows)) * 0.01
    y = np.convolve(u, np.full(20, 0.05))[:rows] + 0.01 * rng.standard_normal(rows)
    began = time.process_time()
    assess(Samples.from_columns(np.arange(rows) * 0.01, np.convolve(u, np.full(40, 0.025))[:rows], u, y))
    return time.process_time() - began


def main() -> None:
    """Measure, and print tables."""
    command = parser(__doc__)
    command.add_argument("--number", type=int, default=200, help="planted logs of each kind")
    command.add_argument("--every", type=int, default=1, help="of the servo recordings, take one of so many")
    given = parse_with_data(command, "real/process_loops")
    tables = (
        loop_table(assess_loops(given.data / "real" / "process_loops")),
        servo_table(given.data / "real", given.every),
        grid_table(given.number),
        planted_table(given.number),
        valve_table(max(given.number // 8, 1)),
    )
    show(tables, given.json, {"10 000 rows": f"{seconds(10_000):.1f}", "1 000 000 rows": f"{seconds(1_000_000):.1f}"})
