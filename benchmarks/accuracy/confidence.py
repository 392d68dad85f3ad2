"""Do 95 % intervals hold the truth in 95 % of the runs? Of H, of theta, and of a fault's size."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from accuracy.rig import FAULT_AT, baseline, loop, record
from accuracy.scenario import Numbers, Row, Scenario, Table
from servoscope.diagnosis.diagnose import diagnose_with_trace
from servoscope.estimation.frequency_response import CHI2_95_2DOF
from servoscope.scoring import share
from servoscope.simulation import FaultEvent

RUNS = 20  # per baseline
TARGET = (0.93, 0.97)
FREQUENCIES = ("1 Hz", "10 Hz", "20 Hz")
THETA = ("theta_0", "theta_1", "theta_2", "theta_3")


def job(seed: int, learned_on: str, kind: str, ratios: dict[str, float]) -> Numbers:
    """Return in how many of the runs each interval held the truth at the end of the recording."""
    count: Counter[str] = Counter()
    plant = loop().plant.with_ratios(ratios)
    faults = tuple(FaultEvent(name, ratio, FAULT_AT) for name, ratio in ratios.items())
    learned = baseline(learned_on, 60.0, seed)
    for i in range(RUNS):
        said, trace = diagnose_with_trace(learned, record(kind, 60.0, seed, 1 + i, faults))
        count["runs"] += 1
        off = trace.ifrf.H[-1] - plant.frequency_response(trace.ifrf.frequencies)
        for name, d, C in zip(FREQUENCIES, off, trace.ifrf.covariance[-1], strict=True):
            parts = np.array([d.real, d.imag])
            count[name] += int(parts @ np.linalg.solve(C, parts) <= CHI2_95_2DOF)
        for (name, told), truth in zip(said.parameters.items(), plant.theta(), strict=True):
            count[name] += int(abs(told.value - truth) <= 1.96 * told.std)
        count["alarms"] += int(said.verdict in ("suspect", "fault"))
        if [fault.parameter for fault in said.faults] == list(ratios) and ratios:
            low, high = said.faults[0].interval
            count["named"] += 1
            count["size"] += int(low <= next(iter(ratios.values())) <= high)
    return dict(count)


def shares(words: str, found: Sequence[Numbers]) -> list[Row]:
    """Show the share of runs whose interval held the truth, with Wilson's interval around it."""
    count: Counter[str] = Counter()
    for each in found:
        count.update(each)
    runs = count["runs"]
    size = _cell(count["size"], count["named"]) if count["named"] else ""
    cells = [_cell(count[name], runs) for name in (*FREQUENCIES, *THETA)]
    return [(words, f"{runs}", *cells, f"{count['named']}", size)]


def _cell(inside: int, total: int) -> str:
    told = share(inside, total)
    mark = "" if TARGET[0] <= told.value <= TARGET[1] else "**"
    return f"{mark}{100 * told.value:.1f}{mark} ({100 * told.low:.1f}, {100 * told.high:.1f})"


def _scenario(id_: str, words: str, learned_on: str, kind: str, ratios: dict[str, float]) -> Scenario:
    runs = 200 if ratios else 2000
    return Scenario(f"coverage/{id_}", words, runs // RUNS, job, (learned_on, kind, ratios), shares)


TABLES = (
    Table(
        "coverage",
        ("learned on, judged", "runs", *(f"H, {f}" for f in FREQUENCIES), *THETA, "named", "size"),
        (
            _scenario("multisine-60s", "multisine, multisine", "multisine", "multisine", {}),
            _scenario("profile-60s", "profile, profile", "profile", "profile", {}),
            _scenario("profile-then-multisine", "profile, multisine", "profile", "multisine", {}),
            _scenario("multisine-then-profile", "multisine, profile", "multisine", "profile", {}),
            _scenario("leakage", "multisine, C_ie x1.2", "multisine", "multisine", {"C_ie": 1.2}),
            _scenario("pump", "multisine, p_s x0.8", "multisine", "multisine", {"p_s": 0.8}),
        ),
    ),
)
