"""How often `servoscope assess` is right: simulated loops of another family, process loops, healthy servo recordings.

    python benchmarks assessment/score [--data ../shared/data] [--number 1000]

Process loops are judged by posteriors that were fitted without them, one loop left out at a time, and servo recordings
without those of their folder. Textbook indices are judged on the same records.
"""

from __future__ import annotations

import itertools
import time

import numpy as np
import numpy.typing as npt
from assessment.records import Records, measured, servos, simulated
from assessment.train import SEED, SIMULATED, fit
from tables import Table, parse_with_data, parser, show

from servoscope.assessment.assess import MIN_PROBABILITY
from servoscope.assessment.causes import CAUSES, MIN_SURE_PROBABILITY, POOR_CONTROL
from servoscope.assessment.features import analyse
from servoscope.assessment.posterior import load_posterior

TEST_SEED = 0
BINS = (0.5, 0.7, 0.9, 1.0001)


def judge(probabilities: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.int_], npt.NDArray[np.bool_]]:
    """Return the likeliest cause of each record, and whether it is likely enough for a verdict."""
    return probabilities.argmax(axis=1), probabilities.max(axis=1) >= MIN_PROBABILITY


def verdict_table(test: Records, probabilities: npt.NDArray[np.float64]) -> Table:
    """Return how often each simulated cause was found."""
    best, told = judge(probabilities)
    truth = test.possible.argmax(axis=1)
    rows = []
    for i, cause in enumerate(CAUSES):
        of = truth == i
        confused = np.bincount(best[of & told & (best != i)], minlength=len(CAUSES))
        most = f"{CAUSES[int(confused.argmax())]} ({confused.max()})" if confused.any() else "-"
        right = (best == i) & told
        rows.append(
            (
                cause,
                str(of.sum()),
                f"{right[of].mean():.0%}",
                f"{right[of & told].mean():.0%}",
                f"{(~told[of]).mean():.0%}",
                most,
            )
        )
    right = (best == truth) & told
    rows.append(
        ("all", str(truth.size), f"{right.mean():.0%}", f"{right[told].mean():.0%}", f"{(~told).mean():.0%}", "-")
    )
    return Table(
        "Simulated loops",
        "Of the test family; its structures are in no model and in no training loop.",
        ("cause", "loops", "right", "right of those judged", "cannot tell", "most often taken for"),
        tuple(rows),
    )


def calibration_table(test: Records, probabilities: npt.NDArray[np.float64]) -> Table:
    """Return how often verdicts of a stated probability are right."""
    best, told = judge(probabilities)
    stated, right = probabilities.max(axis=1), best == test.possible.argmax(axis=1)
    rows = []
    for low, high in itertools.pairwise(BINS):
        inside = told & (stated >= low) & (stated < high)
        if inside.any():
            rows.append(
                (
                    f"{low:.1f} to {min(high, 1.0):.1f}",
                    str(inside.sum()),
                    f"{stated[inside].mean():.2f}",
                    f"{right[inside].mean():.2f}",
                )
            )
    rows.append(("all", str(told.sum()), f"{stated[told].mean():.2f}", f"{right[told].mean():.2f}"))
    return Table(
        "Calibration", "Verdicts on simulated loops.", ("probability", "verdicts", "stated", "right"), tuple(rows)
    )


def loop_table(records: Records, probabilities: npt.NDArray[np.float64]) -> Table:
    """Return how process loops were judged: a loop by the mean of its logs."""
    rows, stiction, valve = [], probabilities[:, 0], probabilities[:, :2].sum(axis=1)
    _, told = judge(probabilities)
    for sticks, name in ((True, "stiction"), (False, "no stiction")):
        names = sorted({str(x) for x, p in zip(records.loops, records.possible[:, 0], strict=True) if p == sticks})
        means = np.array([stiction[records.loops == loop].mean() for loop in names])
        judged = np.array([told[records.loops == loop].mean() >= 0.5 for loop in names])
        right = ((means >= 0.5) == sticks) & judged
        either = sum(valve[records.loops == loop].mean() >= 0.5 for loop in names)
        sure = np.array([np.any(np.abs(stiction[records.loops == loop] - (not sticks)) < 0.1) for loop in names])
        rows.append((name, str(len(names)), str(right.sum()), str((~judged).sum()), str(sure.sum()), str(either)))
    return Table(
        "Process loops, one left out at a time",
        "A loop is judged by the mean probability of stiction of its logs.",
        ("label", "loops", "right", "not judged", "with a wrong log above 0.9", "stiction or backlash"),
        tuple(rows),
    )


def index_table(test: Records, real: Records) -> Table:
    """Return how textbook indices tell stiction from the rest, at their published thresholds, and the posterior."""
    rows = []
    for label, records in (("simulated", test), ("process loops", real)):
        sticks = records.possible[:, 0]
        column = {name: records.features[:, i] for i, name in enumerate(records.names)}
        for name, rule in (
            (
                "half-cycle shape, above 0.6 (He et al., 2007)",
                np.maximum(column["u triangle"], column["y triangle"]) > 0.6,
            ),
            ("odd cross-correlation, above 2/3 (Horch, 1999)", column["odd"] > 2.0 / 3.0),
            ("y rests while u moves, above 0.25 (Yamashita, 2006)", column["steady"] > 0.25),
        ):
            rows.append((label, name, f"{rule[sticks].mean():.0%}", f"{(~rule[~sticks]).mean():.0%}"))
    return Table(
        "Textbook indices alone",
        "Logs, not loops.",
        ("records", "index", "stiction found", "others right"),
        tuple(rows),
    )


def servo_table(training: Records, real: Records, servo: Records) -> Table:
    """Return how many healthy servo recordings are called faulty, by folder."""
    rows = []
    alarming = [CAUSES.index(cause) for cause in POOR_CONTROL]
    for folder in sorted(set(servo.loops.tolist())):
        features = servo.features[servo.loops == folder]
        left_out, whole = fit(training, real, servo, folder).probabilities(features), load_posterior()
        sure = [
            str((p[:, alarming].max(axis=1) >= MIN_SURE_PROBABILITY).sum())
            for p in (left_out, whole.probabilities(features))
        ]
        rows.append((folder, str(len(features)), str((left_out[:, 0] > 0.5).sum()), *sure))
    return Table(
        "Healthy servo recordings",
        "Judged by a posterior that was fitted without the recordings of their folder, and by the one that is shipped.",
        ("folder", "recordings", "stiction above 0.5", "stiction or backlash above 0.9", "the same, shipped"),
        tuple(rows),
    )


def seconds(rows: int) -> float:
    """Return the processor time that one log takes [s]."""
    rng = np.random.default_rng(0)
    u = np.cumsum(rng.standard_normal(rows)) * 0.01
    y = np.convolve(u, np.full(20, 0.05))[:rows] + 0.01 * rng.standard_normal(rows)
    began = time.process_time()
    analyse(None, u, y)
    return time.process_time() - began


def main() -> None:
    """Measure, and print tables."""
    command = parser(__doc__)
    command.add_argument("--number", type=int, default=1000, help="simulated loops")
    given = parse_with_data(command, "real/process_loops")
    real, servo = measured(given.data / "real" / "process_loops"), servos(given.data / "real")
    test, training = simulated(given.number, TEST_SEED, "test"), simulated(SIMULATED, SEED, "training")
    probabilities = load_posterior().probabilities(test.features)
    left_out = np.zeros((len(real.features), len(CAUSES)))
    for loop in sorted(set(real.loops.tolist())):
        of = real.loops == loop
        left_out[of] = fit(training, real, servo, loop).probabilities(real.features[of], process=True)
    tables = (
        verdict_table(test, probabilities),
        calibration_table(test, probabilities),
        loop_table(real, left_out),
        servo_table(training, real, servo),
        index_table(test, real),
    )
    show(tables, given.json, {"10 000 rows": f"{seconds(10_000):.1f}", "200 000 rows": f"{seconds(200_000):.1f}"})
