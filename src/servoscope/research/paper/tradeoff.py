"""Noise immunity against speed: CV over rise time, over the memory, per estimator and operating conditions."""

from __future__ import annotations

from servoscope.estimation.filter_bank import nominal_theta
from servoscope.research.paper import metrics
from servoscope.research.paper.conditions import FAULT_AT, FREQUENCIES, TRACKING_CASE, OperatingConditions, paper_loop
from servoscope.research.paper.method import ResidualGenerator, ResidualTrace
from servoscope.research.paper.tracking import TUNING_SEED_OFFSET

ESTIMATORS = ("akf", "dfrls", "kf", "rls")
MEMORIES = (1.0, 2.0, 3.0, 5.0, 8.0, 12.0)  # s; N = 100 ... 1200, l of RLS 0.99 ... 0.9992
MEMORIES_BESIDE_NOMINAL = (1.0, 3.0, 8.0)
CONDITIONS = (
    OperatingConditions(),
    OperatingConditions("multisine"),
    OperatingConditions("trapezoid"),
    OperatingConditions(amplitude=0.3),
    OperatingConditions(amplitude=3.0),
    OperatingConditions(noise=0.3),
    OperatingConditions(noise=3.0),
    OperatingConditions(noise=10.0),
)
SPANS = {"": (50.0, 60.0), ".motion": (50.0, 55.0), ".rest": (55.0, 60.0)}
COLUMNS = ("rise", *(f"{what}{span}" for span in SPANS for what in ("cv_theta", "cv_H")))


def trade_off_curve(
    estimator: str, conditions: OperatingConditions, seed: int, memories: tuple[float, ...]
) -> dict[str, list[float]]:
    """Return rise time [s] and CVs (theta; H at 1 Hz) for each memory: over the last 10 s, in motion, at rest.

    Source: the paper's section 3.1 leaves this balance "to tuning P_d". With P_d = (R/N) R_phi^-1 it is one number,
    the memory N, and it is the same number for the forgetting factor of the others.
    """
    curves: dict[str, list[float]] = {name: [] for name in COLUMNS}
    for memory in memories:
        loop = paper_loop(estimator, memory)
        generator = ResidualGenerator.from_loop(loop, conditions.simulate(loop, seed + TUNING_SEED_OFFSET))
        healthy = generator.run(conditions.simulate(loop, seed))
        faulty = generator.run(conditions.simulate(loop, seed + 3 * TUNING_SEED_OFFSET, TRACKING_CASE))
        curves["rise"].append(ifrf_rise_time(generator, faulty))
        for name, (begin, end) in SPANS.items():
            part = healthy.between(begin, end)
            curves[f"cv_theta{name}"].append(metrics.cv_theta(part.theta))
            curves[f"cv_H{name}"].append(metrics.cv_H(part.H[:, 0]))
    return curves


def trade_off_metrics(conditions: OperatingConditions, seed: int) -> dict[str, float]:
    """Return all curves of one operating condition as flat numbers, ``condition|estimator|column|memory``."""
    flat: dict[str, float] = {}
    memories = MEMORIES if conditions == OperatingConditions() else MEMORIES_BESIDE_NOMINAL
    for estimator in ESTIMATORS:
        for column, values in trade_off_curve(estimator, conditions, seed, memories).items():
            for memory, value in zip(memories, values, strict=True):
                flat[f"{conditions}|{estimator}|{column}|{memory:g}"] = value
    return flat


def curve_column(flat: dict[str, float], conditions: OperatingConditions, estimator: str, name: str) -> list[float]:
    """Return one column of `trade_off_metrics`, by memory."""
    memories = MEMORIES if conditions == OperatingConditions() else MEMORIES_BESIDE_NOMINAL
    return [flat[f"{conditions}|{estimator}|{name}|{memory:g}"] for memory in memories]


def cv_ratio(
    flat: dict[str, float], conditions: OperatingConditions, name: str, first: str = "akf", other: str = "dfrls"
) -> float:
    """Return CV of one estimator over that of another at equal rise time; below 1 the first is the quieter."""
    pairs = [
        (curve_column(flat, conditions, curve, "rise"), curve_column(flat, conditions, curve, name))
        for curve in (first, other)
    ]
    return metrics.ratio_at_equal_rise(*pairs[0], *pairs[1])


def ifrf_rise_time(generator: ResidualGenerator, faulty: ResidualTrace) -> float:
    """Return how long the iFRF at 1 Hz takes to half of the step of `TRACKING_CASE` [s]."""
    loop = generator.pipeline.loop
    fault_plant = loop.plant.with_ratios({TRACKING_CASE.parameter: TRACKING_CASE.ratio})
    turn = generator.pipeline.bank.E(FREQUENCIES[:1]) @ nominal_theta(loop, fault_plant)
    level = complex(faulty.between(20.0, FAULT_AT).H[:, 0].mean())
    return metrics.rise_time(faulty.t, faulty.H[:, 0], FAULT_AT, level, level * complex(turn[0] / generator.nominal[0]))
