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
    """Return all curves of one operating condition as flat numbers, ``condition|estimator|column|memory``.

    CVs of the AKF over those of another estimator at equal rise time are ``equal_rise.column.estimator|condition``, and
    without the condition where it is the nominal one; below 1 the AKF is the quieter.
    """
    is_nominal = conditions == OperatingConditions()
    memories = MEMORIES if is_nominal else MEMORIES_BESIDE_NOMINAL
    curves = {estimator: trade_off_curve(estimator, conditions, seed, memories) for estimator in ESTIMATORS}
    flat = {
        f"{conditions}|{estimator}|{column}|{memory:g}": value
        for estimator, curve in curves.items()
        for column, values in curve.items()
        for memory, value in zip(memories, values, strict=True)
    }
    akf, places = curves["akf"], (f"|{conditions}", "") if is_nominal else (f"|{conditions}",)
    for estimator in ESTIMATORS[1:]:
        curve = curves[estimator]
        for column in COLUMNS[1:]:
            ratio = metrics.ratio_at_equal_rise(akf["rise"], akf[column], curve["rise"], curve[column])
            flat |= {f"equal_rise.{column}.{estimator}{place}": ratio for place in places}
    return flat


def ifrf_rise_time(generator: ResidualGenerator, faulty: ResidualTrace) -> float:
    """Return how long the iFRF at 1 Hz takes to half of the step of `TRACKING_CASE` [s]."""
    loop = generator.pipeline.loop
    fault_plant = loop.plant.with_ratios({TRACKING_CASE.parameter: TRACKING_CASE.ratio})
    turn = generator.pipeline.bank.E(FREQUENCIES[:1]) @ nominal_theta(loop, fault_plant)
    level = complex(faulty.between(20.0, FAULT_AT).H[:, 0].mean())
    return metrics.rise_time(faulty.t, faulty.H[:, 0], FAULT_AT, level, level * complex(turn[0] / generator.nominal[0]))
