"""Which terms of a motor axis its recordings support: structures judged by recordings that they were not fitted to."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import LoopError, NotEnoughError
from servoscope.estimation.axis_filter import AxisSignals, axis_stride
from servoscope.isolation.ml.axis_window import axis_signals
from servoscope.learning.axis_fit import (
    AxisRegression,
    check_motion,
    combine_fits,
    fit_axis_noise,
    fit_recording,
    rest_speed,
)
from servoscope.models.loop import Loop
from servoscope.models.plants import Plant
from servoscope.models.plants.axis import AxisPlant
from servoscope.models.plants.base import CoefficientPlant
from servoscope.signals import Recording

MIN_SINE_RANGE_RAD = 0.5  # half of the range of y [rad], from which a sine differs from a straight line
SLOW_SHARES = 0.1, 0.3  # of the rms speed, at which Stribeck friction may have fallen to a half
BLOCK_S = 1.0  # of which the squared innovations are counted as one
NUISANCES_PER_RECORDING = 2  # nuisances of each recording: force and drift


@dataclass(frozen=True, eq=False)
class AxisStructure:
    """Terms, how well they predict recordings that they were not fitted to, and their coefficients."""

    plant: AxisPlant
    excess: float  # of the sum of squared innovations of recordings left out, beyond the best structure's
    excess_std: float  # standard error of that
    # coefficients over the inertia, and their standard deviations by leaving out one recording after another
    ratios: dict[str, float]
    ratios_std: dict[str, float]
    inertia: float | None  # [unit of ``input_gain u``]; None where u moves nothing

    @property
    def as_good_as_the_best(self) -> bool:
        """Whether no more than one standard error is lost (Breiman, Friedman, Olshen and Stone, 1984)."""
        return self.excess <= self.excess_std


def explore_structures(loop: Loop, recordings: Sequence[Recording]) -> tuple[AxisStructure, ...]:
    """Return structures, the one that the data support first, the others by what they predict worse.

    Each is fitted to all recordings but one, and predicts the one that is left out, whose constant force and its drift
    are its own. Of those that predict as well as the best one, to within one standard error, that of fewest
    coefficients is supported, and its coefficients are what `learn` would find. Structures with a negative inertia or
    friction are left out. A fit to one recording alone does not order structures.

    Raises NotEnoughError with fewer than two recordings or with one that hardly moves, LoopError where the plant is no
    axis.
    """
    if len(recordings) < 2:
        raise NotEnoughError("structures are compared between recordings: give two or more")
    if not isinstance(loop.plant, CoefficientPlant):
        raise LoopError(f'{loop.name}: structures are those of a motor axis, set kind = "axis" in [plant]')
    stride = axis_stride(loop.sample_rate)
    signals = [axis_signals(loop, one, stride) for one in recordings]
    slow = rest_speed(signals)
    speed = float(np.sqrt(np.mean(np.concatenate([one.speed for one in signals]) ** 2)))
    half = 0.5 * max(float(np.ptp(one.y)) for one in signals)
    plants = list(_candidates(loop.plant, speed, half))
    richest = max(plants, key=lambda plant: len(plant.columns))
    check_motion(recordings, signals, slow, 1 + len(richest.columns))
    # what many terms take up of a short recording is no smaller noise
    usual = "viscous", "coulomb", *(("gravity",) if _may_swing(loop.plant, half) else ())
    ordinary = next(plant for plant in plants if plant.terms == usual)
    noise = fit_axis_noise([AxisRegression.of(ordinary, one) for one in signals], slow)
    block = max(1, round(BLOCK_S * signals[0].sample_rate))
    problems = [[AxisRegression.of(plant, one).regress(noise, slow)[:2] for one in signals] for plant in plants]
    # a recording whose innovations are louder than the others' counts less
    loudness = [float(np.mean(_left(X, e, np.zeros(0)) ** 2)) for X, e in problems[plants.index(richest)]]
    blocks, fits = [], []
    for each in problems:
        normal = [_normal(X, e, level) for (X, e), level in zip(each, loudness, strict=True)]
        without = np.array([_solve(normal[:k] + normal[k + 1 :]) for k in range(len(normal))])
        left = [_left(X, e, theta) ** 2 / v for (X, e), theta, v in zip(each, without, loudness, strict=True)]
        blocks.append(np.concatenate([np.add.reduceat(one, np.arange(0, len(one), block)) for one in left]))
        fits.append((_solve(normal), without))
    physical = [k for k, (theta, without) in enumerate(fits) if _is_plausible(plants[k], theta, _scatter(without))]
    if not physical:
        raise NotEnoughError("no structure has a positive inertia and positive frictions: check signs and units")
    best = min(physical, key=lambda k: float(blocks[k].sum()))
    found = []
    for plant, squares, (theta, without) in ((plants[k], blocks[k], fits[k]) for k in physical):
        more = squares - blocks[best]
        std = float(np.sqrt(len(more)) * more.std(ddof=1)) if len(more) > 1 else 0.0
        jackknife = _scatter(without)
        names = [column.coefficient for column in plant.columns]
        found.append(
            AxisStructure(
                plant,
                float(more.sum()),
                std,
                dict(zip(names, theta[1:].tolist(), strict=True)),
                dict(zip(names, jackknife[1:].tolist(), strict=True)),
                plant.input_gain / float(theta[0]) if _is_seen(theta, jackknife) else None,
            )
        )
    ordered = sorted(found, key=lambda one: one.excess)
    # what swings far hangs on a weight more often than on a spring, whose force would go on growing
    supported = min(
        (one for one in ordered if one.as_good_as_the_best),
        key=lambda one: (
            len(one.plant.columns),
            _may_swing(loop.plant, half) and "stiffness" in one.plant.terms,
            one.excess,
        ),
    )
    return _fit_as_learned(supported, signals, slow), *(one for one in ordered if one is not supported)


def _fit_as_learned(structure: AxisStructure, signals: Sequence[AxisSignals], slow: float) -> AxisStructure:
    """Return the structure with the coefficients that its own noise and the scatter between recordings lead to."""
    if not all(one.u.any() for one in signals):
        return structure  # a motor that is off throughout tells nothing of its force
    plant = structure.plant
    problems = [AxisRegression.of(plant, one) for one in signals]
    noise = fit_axis_noise(problems, slow)
    fits, n = [fit_recording(one, noise, slow) for one in problems], 1 + len(plant.columns)
    theta = combine_fits(fits, n)[0]
    jackknife = _scatter(np.array([combine_fits(fits[:k] + fits[k + 1 :], n)[0] for k in range(len(fits))]))
    if not (_is_plausible(plant, theta, jackknife) and _is_seen(theta, jackknife)):
        return structure
    names = [column.coefficient for column in plant.columns]
    return replace(
        structure,
        ratios=dict(zip(names, theta[1:].tolist(), strict=True)),
        ratios_std=dict(zip(names, jackknife[1:].tolist(), strict=True)),
        inertia=plant.input_gain / float(theta[0]),
    )


def _candidates(declared: Plant, speed: float, half: float) -> Iterator[AxisPlant]:
    """Yield axes without the term ``offset``, which is every recording's own."""
    viscous: tuple[tuple[str, ...], ...] = (), ("viscous",), ("viscous_by_direction",)
    dry: list[tuple[tuple[str, ...], dict[str, Any]]] = [((), {}), (("coulomb",), {})]
    dry += [(("coulomb", "stribeck"), {"stribeck_speed": float(f"{share * speed:.2g}")}) for share in SLOW_SHARES]
    swings = (("gravity",), ("gravity", "load_friction")) if _may_swing(declared, half) else ()
    position: tuple[tuple[str, ...], ...] = ((),) if declared.derivative else ((), ("stiffness",), *swings)
    known: dict[str, Any] = {"input_gain": declared.input_gain}
    if isinstance(declared, AxisPlant):
        known |= {"y": declared.y, "payload_arm": declared.payload_arm, "hanging_at": declared.hanging_at}
    for rub, (stick, keys), hold in product(viscous, dry, position):
        yield AxisPlant.model_validate({"terms": (*rub, *stick, *hold), **known, **keys})


def _may_swing(declared: Plant, half: float) -> bool:
    """Return whether a weight that turns with y would show that its force is a sine."""
    return half > MIN_SINE_RANGE_RAD and not declared.derivative


def _scatter(without: FloatArray) -> FloatArray:
    """Return the jackknife's standard deviations from the estimates that leave out one recording (Tukey, 1958)."""
    n = len(without)
    return np.asarray(np.sqrt((n - 1) / n * ((without - without.mean(axis=0)) ** 2).sum(axis=0)))


def _is_seen(theta: FloatArray, std: FloatArray) -> bool:
    """Return whether u moves the axis at all: it may be switched off throughout."""
    return bool(abs(theta[0]) > 2.0 * std[0])


def _is_plausible(plant: AxisPlant, theta: FloatArray, std: FloatArray) -> bool:
    """Return whether no coefficient has a sign that it cannot have."""
    signs = [value > 0.0 for column, value in zip(plant.columns, theta[1:], strict=True) if not column.signed]
    return all(signs) and (not _is_seen(theta, std) or bool(theta[0] * plant.input_gain > 0.0))


def _normal(X: FloatArray, e: FloatArray, level: float) -> tuple[FloatArray, FloatArray]:
    """Return the normal equations of one recording, whose own force and drift are left free."""
    Q = _own_directions(X)
    X, e = X[:, :-NUISANCES_PER_RECORDING] - Q @ (Q.T @ X[:, :-NUISANCES_PER_RECORDING]), e - Q @ (Q.T @ e)
    return X.T @ X / level, X.T @ e / level


def _solve(normal: Sequence[tuple[FloatArray, FloatArray]]) -> FloatArray:
    A, c = sum(one for one, _ in normal), sum(one for _, one in normal)
    size = np.sqrt(np.diag(A))
    size = np.where(size > 0.0, size, 1.0)  # u, where the motor was off throughout
    return np.asarray(np.linalg.lstsq(A / np.outer(size, size), c / size, rcond=None)[0] / size)


def _left(X: FloatArray, e: FloatArray, theta: FloatArray) -> FloatArray:
    """Return the innovations that coefficients leave, shape (N,); an empty `theta` is found by least squares."""
    Q = _own_directions(X)
    known, e = X[:, :-NUISANCES_PER_RECORDING] - Q @ (Q.T @ X[:, :-NUISANCES_PER_RECORDING]), e - Q @ (Q.T @ e)
    if not theta.size:
        theta = _solve([(known.T @ known, known.T @ e)])
    return np.asarray(e - known @ theta)


def _own_directions(X: FloatArray) -> FloatArray:
    return np.linalg.qr(X[:, -NUISANCES_PER_RECORDING:])[0]
