"""All that one seed measures, cut into jobs that processes can share."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servoscope.paper import sensitivity, table, tolerance, tracking, tradeoff, windup
from servoscope.paper.conditions import FREQUENCIES, rig
from servoscope.plants.eha import EHA

PARTS = ("tracking", "table", "diagnosis", "windup", "tolerance")
ONCE = ("physics",)


@dataclass(frozen=True)
class Job:
    """One part of one seed; a part that names an operating condition is its trade-off."""

    part: str
    seed: int


def jobs(seeds: Sequence[int]) -> list[Job]:
    """Return all jobs, the long ones first so that no process is left alone with one at the end."""
    parts = [*(str(conditions) for conditions in tradeoff.CONDITIONS), "diagnosis", "table", "windup"]
    parts += [part for part in PARTS if part not in parts]
    return [Job(part, seed) for part in parts for seed in seeds] + [Job(part, seeds[0]) for part in ONCE]


def work(job: Job) -> dict[str, float]:
    """Do one job; return what it measured."""
    if job.part == "physics":
        return physics()
    if job.part == "tracking":
        return tracking.measure(job.seed)
    if job.part == "table":
        return table.evaluated(job.seed)
    if job.part == "diagnosis":
        return table.diagnosed(job.seed)
    if job.part == "windup":
        return windup.measure(job.seed)
    if job.part == "tolerance":
        return tolerance.measure(job.seed)
    conditions = next(each for each in tradeoff.CONDITIONS if str(each) == job.part)
    flat = tradeoff.curves(conditions, job.seed)
    for other in tradeoff.ESTIMATORS[1:]:
        for column in tradeoff.COLUMNS[1:]:
            flat[f"equal_rise.{column}.{other}|{conditions}"] = tradeoff.ratio(flat, conditions, column, "akf", other)
    if conditions == tradeoff.CONDITIONS[0]:
        at_base = {key: value for key, value in flat.items() if key.startswith("equal_rise.")}
        flat |= {key.split("|")[0]: value for key, value in at_base.items()}
    return flat


def physics() -> dict[str, float]:
    """Return what needs no noise: sensitivities, stability, causes of the bias."""
    plant = rig().plant
    if not isinstance(plant, EHA):
        raise TypeError("the reference rig is an electrohydraulic actuator")
    h, g = sensitivity.of_H(plant, FREQUENCIES), sensitivity.of_G(plant, FREQUENCIES)
    found = {"stability.largest": max(float(poles[-1]) for poles in table.stability().values())}
    differences = []
    for i, j in itertools.combinations(range(len(plant.parameters)), 2):
        angles, same = sensitivity.angle(h[i], h[j]), sensitivity.angle(g[i], g[j])
        differences.append(float(np.abs(angles - same).max()))
        for f, value in zip(FREQUENCIES, angles, strict=True):
            found[f"sensitivity.{plant.parameters[i]}-{plant.parameters[j]}.{f:g}"] = float(value)
    found["sensitivity.angle_difference"] = round(max(differences), 9)
    for name, values in (("H", h), ("G", g)):
        size = np.linalg.norm(values, axis=0)
        found[f"sensitivity.growth_{name}"] = float(size[-1] / size[0])
    return found | tracking.bias_causes()


def gather(results: Sequence[tuple[Job, dict[str, float]]]) -> dict[str, list[float]]:
    """Return name -> one value per seed."""
    metrics: dict[str, list[float]] = {}
    for _, found in sorted(results, key=lambda result: result[0].seed):
        for name, value in found.items():
            metrics.setdefault(name, []).append(value)
    return metrics
