"""How much the sizes of the refit scatter, against the Cramer-Rao bound, and how long a refit takes."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from accuracy.draws import KINDS, SECONDS
from accuracy.rig import FAULT_AT, baseline, loop, record
from accuracy.scenario import Numbers, Row, Scenario, Table
from servoscope.isolation.ml import fit_hypotheses
from servoscope.isolation.ml.least_squares import last_unknown_std
from servoscope.isolation.ml.window import ChangeProfile, RefitWindow
from servoscope.research.paper.conditions import FAULT_NAMES
from servoscope.simulation import FaultEvent

RUNS = 1  # per baseline and fault: the error of the baseline is part of the size's
UNITS = 100
RATIOS = {"p_s": 0.8, "C_ie": 1.2, "b_p": 20.0, "beta": 0.1}
ANNOUNCED_S = 2.0  # after the onset
MOST = 1.3  # times the bound's variance
SLOW = 1.0  # s


def job(seed: int, kind: str, runs: int = RUNS) -> Numbers:
    """Return errors of sizes in the bound's standard deviations, and seconds of processor time, by fault.

    The bound is that of the window at the truth, onset known, healthy parameters as uncertain as the baseline says.
    """
    learned = baseline(kind, SECONDS, seed)
    onset = round(FAULT_AT * loop().sample_rate)
    announced = onset + round(ANNOUNCED_S * loop().sample_rate)
    found: Numbers = {}
    for i, (name, ratio) in enumerate(RATIOS.items()):
        errors, seconds = [], []
        for j in range(runs):
            recording = record(kind, SECONDS, seed, 1 + runs * i + j, (FaultEvent(name, ratio, FAULT_AT),))
            begin = time.process_time()
            refined = fit_hypotheses(learned, recording, onset, announced, recording.samples - 1)
            seconds.append(round(time.process_time() - begin, 3))
            own = next(h.fitted for h in refined.hypotheses if h.fitted.names == (name,))
            window = RefitWindow.from_recording(learned, recording, 0, recording.samples)
            truth = np.append(np.zeros(window.nuisance_count), np.log(ratio))
            bound = last_unknown_std(window.jacobian(truth, (name,), ChangeProfile(onset)))
            errors.append(float(f"{(own.x[0] - np.log(ratio)) / bound:.5g}"))
        found[name] = {"errors": errors, "seconds": seconds}
    return found


def scatter(words: str, found: Sequence[Numbers]) -> list[Row]:
    """Show mean and variance of the errors, and the seconds."""
    rows = []
    for name, ratio in RATIOS.items():
        errors = np.array([each[name]["errors"] for each in found]).ravel()
        seconds = np.concatenate([each[name]["seconds"] for each in found])
        square = errors**2
        worst = square.mean()
        mark = "" if worst <= MOST else "**"
        late = "" if np.median(seconds) < SLOW else "**"
        rows.append(
            (
                words,
                f"{FAULT_NAMES[name]} x{ratio:g}",
                f"{len(errors)}",
                f"{mark}{worst:.2f}{mark} ± {square.std() / np.sqrt(len(errors)):.2f}",
                f"{errors.mean():.2f} ± {errors.std() / np.sqrt(len(errors)):.2f}",
                f"{late}{np.median(seconds):.2f}{late}, {np.quantile(seconds, 0.9):.2f}",
            )
        )
    return rows


TABLES = (
    Table(
        "sizes",
        ("reference", "fault", "runs", "mean square, in bounds (1.3)", "mean, in bounds", "median, 90 % [s]"),
        tuple(Scenario(f"sizes/{kind}", kind, UNITS, job, (kind,), scatter) for kind in KINDS),
    ),
)
