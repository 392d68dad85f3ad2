"""Two faults at once: whether they are named, and whether the joint covariance holds the truth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import combinations

import numpy as np

import servoscope as ss
from accuracy.draws import KINDS, PARAMETERS, SECONDS, large
from accuracy.innovations import known
from accuracy.rig import FAULT_AT, baseline, loop, record
from accuracy.scenario import Numbers, Row, Scenario, Table
from accuracy.told import is_named, is_right, percent, seen, told
from servoscope.isolation.ml.window import ChangeProfile
from servoscope.research.paper.conditions import FAULT_NAMES
from servoscope.simulation import FaultEvent

RUNS = 2  # per baseline and pair
UNITS = 10
ALLOWED = 6.0  # standard deviations that the Fisher information gives each size at least, for a pair to be resolvable
WITHIN_95 = 5.991  # chi-square with two degrees of freedom


def job(seed: int, kind: str, runs: int = RUNS) -> Numbers:
    """Diagnose all pairs after one baseline."""
    learned, rng = baseline(kind, SECONDS, seed), np.random.default_rng(seed)
    said = []
    for i, pair in enumerate([*combinations(PARAMETERS, 2)] * runs):
        faults = tuple(FaultEvent(name, ratio, FAULT_AT) for name, ratio in large(rng, *pair).items())
        recording = record(kind, SECONDS, seed, 1 + i, faults)
        said.append(told(learned, recording, faults) | {"clear": clear(recording, faults)})
    return {"runs": said}


def clear(recording: ss.Recording, faults: Sequence[FaultEvent]) -> float:
    """Return how far from healthy the less clear of two faults is, in standard deviations by the Fisher information."""
    names, x = [fault.parameter for fault in faults], np.log([fault.ratio for fault in faults])
    J = known(recording, loop().plant).jacobian(x, names, ChangeProfile(round(FAULT_AT * loop().sample_rate)))
    std = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
    return float(f"{np.min(np.abs(x) / std):.4g}")


def shares(words: str, found: Sequence[Numbers]) -> list[Row]:
    """Show what was named, pair by pair and in all."""
    runs = seen(found)
    rows = []
    for pair in (*combinations(FAULT_NAMES.values(), 2), ()):
        own = [run for run in runs if set(run["truth"]) == set(pair) or not pair]
        allowed = [run for run in own if run["clear"] >= ALLOWED]
        rest = [run for run in own if run["clear"] < ALLOWED]
        right = [run for run in own if is_right(run)]
        others = Counter(run["first"] if run["named"] else "nothing" for run in own if not is_named(run))
        rows.append(
            (
                words,
                " + ".join(pair) or "all",
                f"{len(own)}",
                percent(sum(is_named(run) for run in allowed), len(allowed), low=0.95),
                percent(sum(run["named"] and not is_right(run) for run in rest), len(rest), high=0.05),
                "; ".join(f"{name} {count}" for name, count in others.most_common(3)),
                percent(sum(run["distance"] <= WITHIN_95 for run in right), len(right), low=0.9, high=0.99),
            )
        )
    return rows


TABLES = (
    Table(
        "pairs",
        (
            *("reference", "pair", "detected", "named, where resolvable", "wrongly named elsewhere"),
            *("named instead", "covariance holds the truth"),
        ),
        tuple(Scenario(f"pairs/{kind}", kind, UNITS, job, (kind,), shares) for kind in KINDS),
    ),
)
