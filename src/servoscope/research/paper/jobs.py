"""All that one seed measures, cut into jobs that processes can share."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from servoscope.research.paper import sensitivity, table, tolerance, tracking, tradeoff, windup
from servoscope.research.paper.conditions import FREQUENCIES, rig_plant

PARTS: Mapping[str, Callable[[int], dict[str, float]]] = {  # the long ones first
    **{str(conditions): partial(tradeoff.trade_off_metrics, conditions) for conditions in tradeoff.CONDITIONS},
    "diagnosis": table.evaluate_default_method,
    "table": table.evaluate_paper_method,
    "windup": windup.windup_metrics,
    "tracking": tracking.tracking_metrics,
    "tolerance": tolerance.tolerance_metrics,
}
NOISE_FREE_PART = "physics"


@dataclass(frozen=True)
class SeedJob:
    """One part of one seed; a part that names an operating condition is its trade-off."""

    part: str
    seed: int


def list_jobs(seeds: Sequence[int]) -> list[SeedJob]:
    """Return all jobs, the long ones first so that no process is left alone with one at the end."""
    return [*(SeedJob(part, seed) for part in PARTS for seed in seeds), SeedJob(NOISE_FREE_PART, seeds[0])]


def run_job(job: SeedJob) -> dict[str, float]:
    """Do one job; return what it measured."""
    if job.part == NOISE_FREE_PART:
        return noise_free_metrics()
    return PARTS[job.part](job.seed)


def noise_free_metrics() -> dict[str, float]:
    """Return what needs no noise: sensitivities, stability, causes of the bias."""
    plant = rig_plant()
    h, g = sensitivity.sensitivity_of_H(plant, FREQUENCIES), sensitivity.sensitivity_of_G(plant, FREQUENCIES)
    metrics = {"stability.largest": max(float(poles[-1]) for poles in table.pole_magnitudes().values())}
    differences = []
    for i, j in itertools.combinations(range(len(plant.parameters)), 2):
        angles, same = sensitivity.angle_between(h[i], h[j]), sensitivity.angle_between(g[i], g[j])
        differences.append(float(np.abs(angles - same).max()))
        for f, value in zip(FREQUENCIES, angles, strict=True):
            metrics[f"sensitivity.{plant.parameters[i]}-{plant.parameters[j]}.{f:g}"] = float(value)
    metrics["sensitivity.angle_difference"] = round(max(differences), 9)
    for name, values in (("H", h), ("G", g)):
        size = np.linalg.norm(values, axis=0)
        metrics[f"sensitivity.growth_{name}"] = float(size[-1] / size[0])
    return metrics | tracking.bias_metrics()


def merge_metrics(results: Sequence[tuple[SeedJob, dict[str, float]]]) -> dict[str, list[float]]:
    """Return name -> one value per seed."""
    metrics: dict[str, list[float]] = {}
    for _, outcome in sorted(results, key=lambda result: result[0].seed):
        for name, value in outcome.items():
            metrics.setdefault(name, []).append(value)
    return metrics
