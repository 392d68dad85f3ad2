"""Noise immunity against speed: CV over rise time, over the memory, per estimator and operating conditions."""

from __future__ import annotations

import numpy as np

from servoscope.inverse import nominal_theta
from servoscope.paper import metrics
from servoscope.paper.conditions import FAULT_AT, FREQUENCIES, TRACKED, Conditions, paper_loop
from servoscope.paper.method import Course, ResidualGenerator
from servoscope.paper.tracking import COMMISSIONING

ESTIMATORS = ("akf", "dfrls", "kf", "rls")
MEMORIES = (1.0, 2.0, 3.0, 5.0, 8.0, 12.0)  # s; N = 100 ... 1200, l of RLS 0.99 ... 0.9992
FEW = (1.0, 3.0, 8.0)
CONDITIONS = (
    Conditions(),
    Conditions("multisine"),
    Conditions("trapezoid"),
    Conditions(amplitude=0.3),
    Conditions(amplitude=3.0),
    Conditions(noise=0.3),
    Conditions(noise=3.0),
    Conditions(noise=10.0),
)
SPANS = {"": (50.0, 60.0), ".motion": (50.0, 55.0), ".rest": (55.0, 60.0)}
COLUMNS = ("rise", *(f"{what}{span}" for span in SPANS for what in ("cv_theta", "cv_H")))


def curve(estimator: str, conditions: Conditions, seed: int, memories: tuple[float, ...]) -> dict[str, list[float]]:
    """Return rise time [s] and CVs (theta; H at 1 Hz) for each memory: over the last 10 s, in motion, at rest.

    Source: the paper's section 3.1 leaves this balance "to tuning P_d". With P_d = (R/N) R_phi^-1 it is one number,
    the memory N, and it is the same number for the forgetting factor of the others.
    """
    found: dict[str, list[float]] = {name: [] for name in COLUMNS}
    for memory in memories:
        loop = paper_loop(estimator, memory)
        made = ResidualGenerator.of(loop, conditions.record(loop, seed + COMMISSIONING))
        healthy = made.run(conditions.record(loop, seed))
        faulty = made.run(conditions.record(loop, seed + 3 * COMMISSIONING, TRACKED))
        found["rise"].append(_rise(made, faulty))
        for name, (begin, end) in SPANS.items():
            part = healthy.between(begin, end)
            found[f"cv_theta{name}"].append(metrics.cv_theta(part.theta))
            found[f"cv_H{name}"].append(metrics.cv_H(part.H[:, 0]))
    return found


def curves(conditions: Conditions, seed: int) -> dict[str, float]:
    """Return all curves of one operating condition as flat numbers, ``condition|estimator|column|memory``."""
    flat: dict[str, float] = {}
    memories = MEMORIES if conditions == Conditions() else FEW
    for estimator in ESTIMATORS:
        for column, values in curve(estimator, conditions, seed, memories).items():
            for memory, value in zip(memories, values, strict=True):
                flat[f"{conditions}|{estimator}|{column}|{memory:g}"] = value
    return flat


def column(flat: dict[str, float], conditions: Conditions, estimator: str, name: str) -> list[float]:
    """Return one column of `curves`, by memory."""
    memories = MEMORIES if conditions == Conditions() else FEW
    return [flat[f"{conditions}|{estimator}|{name}|{memory:g}"] for memory in memories]


def ratio(flat: dict[str, float], conditions: Conditions, name: str, one: str = "akf", other: str = "dfrls") -> float:
    """Return CV of one estimator over that of another at equal rise time; below 1 the first is the quieter."""
    pairs = [(column(flat, conditions, each, "rise"), column(flat, conditions, each, name)) for each in (one, other)]
    return metrics.at_equal_rise(*pairs[0], *pairs[1])


def _rise(made: ResidualGenerator, faulty: Course) -> float:
    loop = made.pipeline.loop
    ill = loop.plant.with_ratios({TRACKED.parameter: TRACKED.ratio})
    turn = made.pipeline.bank.E(FREQUENCIES[:1]) @ nominal_theta(loop, ill)
    level = complex(faulty.between(20.0, FAULT_AT).H[:, 0].mean())
    return metrics.rise(faulty.t, faulty.H[:, 0], FAULT_AT, level, level * complex(turn[0] / made.nominal[0]))


def winner(medians: dict[str, float], conditions: Conditions, name: str) -> tuple[str, dict[str, float]]:
    """Return which estimator is quietest at equal rise time, and each one's CV relative to the AKF's."""
    relative = {"akf": 1.0}
    for other in ESTIMATORS[1:]:
        relative[other] = 1.0 / ratio(medians, conditions, name, "akf", other)
    known = {each: value for each, value in relative.items() if np.isfinite(value)}
    return min(known, key=lambda each: known[each]), relative
