"""The signatures of one recording's possible faults: simulated with its loop, from physics alone, or by coefficient."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.expectation import Expectation
from servoscope.baseline.learned_fault import SEVERITY, LearnedFault
from servoscope.baseline.plant_fit import fault_directions
from servoscope.core.arrays import FloatArray
from servoscope.estimation.filter_bank import nominal_theta
from servoscope.isolation.signature import Signature, coefficient_signature, parameter_signature
from servoscope.models.plants import Fault, FaultRay, Plant
from servoscope.signals import Recording

Shift = Callable[[str, float], FloatArray]  # parameter of a fault and its ratio -> change of theta_hat, shape (n,)

SEVERITY_RANGE = (0.05, 10.0)  # of the labelled severity that is searched
MAX_CACHED_SHIFTS = 10_000  # points of signatures, of this process
_shift_cache: dict[tuple[object, ...], FloatArray] = {}


def fault_signatures(
    baseline: Baseline, recording: Recording, expectation: Expectation | None, onset: int, settled: bool = False
) -> list[Signature]:
    """Return one signature per fault of the loop's plant, and one per fault learned from labelled recordings.

    The recording is what the estimate still remembers; `settled`: the estimate has taken up the whole change.
    """
    needed = not settled and (expectation is None or bool(baseline.learned))
    taken_up = _change_uptake(baseline, recording, onset) if needed else np.eye(len(baseline.theta))
    known = _plant_signatures(baseline, expectation, onset, taken_up)
    return known + [learned_signature(fault, taken_up) for fault in baseline.learned]


def learned_signature(fault: LearnedFault, taken_up: FloatArray) -> Signature:
    """Return the ray along which theta_hat moves as the share of the labelled severity grows.

    The scatter of the direction grows with the share. Along the ray the misfit of a deviation that points elsewhere
    then tends to `distinct`, however large it is.

    `taken_up`: share of a change that theta_hat has taken up by now, I - Psi, shape (n, n).
    """
    moved = taken_up @ np.array(fault.deviation)
    C = taken_up @ np.array(fault.covariance) @ taken_up.T
    words = Fault(fault.name, SEVERITY, SEVERITY_RANGE, fault.name)
    ray = parameter_signature(words, lambda share: share * moved)
    return replace(ray, scatter=lambda x: float(np.exp(2.0 * x)) * C)


def _plant_signatures(
    baseline: Baseline, expectation: Expectation | None, onset: int, learned: FloatArray
) -> list[Signature]:
    faults, plant = baseline.loop.plant.all_faults, baseline.plant
    if expectation is not None:
        shift = _simulated_shifts(baseline, expectation, onset)
        std = baseline.healthy.std
        return [parameter_signature(f, partial(shift, f.parameter), std.get(f.parameter, 0.0)) for f in faults]
    if plant.has_physics and not plant.parameters_are_coefficients:
        shift = _nominal_shifts(baseline, learned)
        return [parameter_signature(f, partial(shift, f.parameter)) for f in faults]
    theta = np.array(baseline.theta)
    healthy = dict(zip(baseline.names, baseline.theta, strict=True))
    powers = {fault.parameter: plant.exponents(fault.parameter, healthy) for fault in plant.faults}
    single = power_signatures(plant, powers, baseline.names, theta, learned)
    directions = fault_directions(
        baseline.loop, plant, theta, [*dict.fromkeys(name for ray in plant.rays for name in ray.exponents)]
    )
    return single + [
        _ray_signature(ray, learned, directions, _healthy_std(baseline, ray.full[0][0])) for ray in plant.rays
    ]


def power_signatures(
    plant: Plant,
    exponents: Mapping[str, Mapping[str, float]],
    names: Sequence[str],
    theta: FloatArray,
    taken_up: FloatArray,
) -> list[Signature]:
    """Return the curves of faults that move coefficients theta (n,) by powers of their ratio; of those that move any.

    `exponents`: by parameter, the powers by coefficient; `taken_up`: see `learned_signature`.
    """
    signatures = []
    for fault in plant.faults:
        powers = np.array([exponents[fault.parameter].get(name, 0.0) for name in names])
        if not (powers * theta).any():
            continue
        if {*powers.tolist()} <= {0.0, 1.0}:
            signature = coefficient_signature(fault, taken_up @ (powers * theta))
        else:
            signature = parameter_signature(fault, partial(_power_shift, theta, powers, taken_up))
        angle, error = (known.get(fault.parameter, 0.0) for known in (plant.ray_angles, plant.size_errors))
        signatures.append(replace(signature, angle=angle, healthy_std=error))
    return signatures


def _healthy_std(baseline: Baseline, name: str) -> float:
    """Return the relative standard deviation of a healthy coefficient, of which a batch estimate's size is a ratio."""
    if baseline.recursion.instrument is None or name not in baseline.names:
        return 0.0
    at = baseline.names.index(name)
    return float(np.sqrt(baseline.covariance[at][at])) / abs(baseline.theta[at])


def _ray_signature(
    ray: FaultRay, learned: FloatArray, directions: Mapping[str, FloatArray], healthy_std: float
) -> Signature:
    """Return the curve of a ray through coefficients that are known by their values of today alone."""
    moved = {name: learned @ directions[name] for name in ray.exponents}

    def shift(ratio: float) -> FloatArray:
        parts = [(ratio**exponent - 1.0) * moved[name] for name, exponent in ray.exponents.items()]
        return np.asarray(np.sum(parts, axis=0))

    return parameter_signature(ray.fault, shift, healthy_std)


def _power_shift(theta: FloatArray, powers: FloatArray, taken_up: FloatArray, ratio: float) -> FloatArray:
    """Return how coefficients move with powers of a parameter's ratio."""
    return np.asarray(taken_up @ (theta * (ratio**powers - 1.0)))


def _simulated_shifts(baseline: Baseline, expectation: Expectation, onset: int) -> Shift:
    """Simulate each fault as a step at the onset, and cache what the recursion estimates at the end."""
    plant, start = baseline.plant, np.array(baseline.healthy.theta)
    healthy = expectation.mean_path(start, plant)[-1]
    common = (expectation.hash, plant.model_dump_json(), plant.rays, start.tobytes(), onset)

    def shift(parameter: str, ratio: float) -> FloatArray:
        key = (*common, parameter, ratio)
        if key not in _shift_cache:
            faulty = plant.with_ratios({parameter: ratio})
            moved: FloatArray = expectation.mean_path(start, plant, faulty, onset)[-1] - healthy
            if len(_shift_cache) >= MAX_CACHED_SHIFTS:
                _shift_cache.clear()
            _shift_cache[key] = moved
        return _shift_cache[key]

    return shift


def _nominal_shifts(baseline: Baseline, learned: FloatArray) -> Shift:
    """Take the coefficients of the changed plant, as far as the recursion has taken them up."""
    loop, plant = baseline.loop, baseline.plant
    healthy = nominal_theta(loop, plant)

    def shift(parameter: str, ratio: float) -> FloatArray:
        return np.asarray(learned @ (nominal_theta(loop, plant.with_ratios({parameter: ratio})) - healthy))

    return shift


def _change_uptake(baseline: Baseline, recording: Recording, onset: int) -> FloatArray:
    """Return I - Psi from the onset to the end: the share of a change that theta_hat has taken up by then."""
    Psi = baseline.pipeline().estimate(baseline.tuning, recording.rows(slice(onset, None))).Psi
    n = len(baseline.theta)
    return np.eye(n) - Psi[-1] if len(Psi) else np.eye(n)
