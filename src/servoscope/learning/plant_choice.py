"""Which plant explains u: polynomials in s, motor axes and cylinders, judged by rows that they were not fitted to."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.errors import NotEnoughError
from servoscope.learning.inspection import model_order, signals
from servoscope.models.loop import Loop, MonitorSettings
from servoscope.models.plants import cylinder, parse_plant
from servoscope.models.plants.axis import TERMS
from servoscope.signals import Recording

MIN_FOLDS = 6  # of which each is left out once: a recording, or a piece of one
MIN_ROWS_PER_COLUMN = 10  # in motion, of all recordings
ROWS_PER_PERIOD = 40.0  # of the cutoff, beyond which neighbouring rows repeat each other
BLOCK_S = 1.0  # of which the squared residuals are counted as one
MIN_GAIN = 0.03  # share of what is left of u that one more coefficient has to take away
MIN_SHARE = 2e-5  # and of u
MIN_TURNED_SHARE = 0.98  # of u, explained by a machine whose u counts the other way; level loops explain 0.95
# share of u that each of these has to explain: they imitate what a sign that comes late leaves of friction
IMITATORS = {"stiffness": 0.005, "stribeck": 0.005, "order 3": 0.005}
SPEED_SHARE = 0.9  # share of u that the speed alone explains, where u sets a speed
MIN_SINE_RANGE_RAD = 0.5  # half of the range of y [rad], from which a sine differs from a straight line
STRIBECK_SHARE = 0.2  # of the rms speed, at which Stribeck friction may have fallen to a half
MIN_ANGLE_RAD = 0.02  # off 0, from which it is said where a weight hangs
MIN_ANGLE_STDS = 3.0
AXIS_POWERS = "stiffness", "viscous_friction", "inertia"
AXIS_TERMS = "stiffness", "viscous_by_direction", "coulomb", "stribeck", "offset"
CONTACT_SHARES = np.linspace(0.2, 0.9, 8)  # of the range of y, at which a process force may begin
SWING_TERMS = "gravity", "load_friction", "cogging"  # a cogging of period 2 pi tells where the weight hangs


@dataclass(frozen=True, eq=False)
class PlantCandidate:
    """A plant, and what it explains of u on rows that it was not fitted to."""

    settings: Mapping[str, object]  # the table ``[plant]``
    explained: float  # share of the variance of u, constant forces aside
    squares: FloatArray  # of the residual over the variance of u, by block
    coefficients: int
    plausible: bool  # whether inertia and frictions are positive, as far as the plant has them
    reversed: bool  # whether all of these are negative: u counts the other way
    rival: str | None = None  # another kind of plant that explains as much, where u moves y at a speed of its own

    @property
    def worth(self) -> float:
        """What it explains, less what its terms may explain by imitating friction."""
        return self.explained - sum(share for word, share in IMITATORS.items() if word in self.words)

    @property
    def words(self) -> str:
        """Return the terms of an axis or a cylinder, or what the polynomial is made of."""
        s = self.settings
        if "terms" in s:
            terms = s["terms"]
            assert isinstance(terms, list)
            return f"{s['kind']}: {', '.join(terms)}"
        parts = [f"order {s['order']}", *["stiffness"] * bool(s["stiffness"]), *["coulomb"] * (s["friction"] != "none")]
        return f"polynomial: {', '.join(parts)}"


@dataclass(frozen=True, eq=False)
class _Fold:
    """Rows of one recording, the mean of each column taken off: a constant force is its own."""

    eta: FloatArray  # (N,)
    columns: Mapping[str, FloatArray]
    blocks: npt.NDArray[np.int_]  # first row of each block

    def matrix(self, names: Sequence[str]) -> FloatArray:
        return np.column_stack([self.columns[name] for name in names])


def choose_plant(
    recordings: Sequence[Recording],
    cutoff: float,
    is_speed: bool,
    rest_speed: float,
    *,
    kind: str | None = None,
    has_valve: bool = False,
    may_be_speed: bool = False,
) -> tuple[PlantCandidate, ...]:
    """Return plants, the supported one first, the others by what they explain of u.

    `kind`: of no other kind; `has_valve`: at a tie it is a cylinder, by what its u is called; `may_be_speed`: nothing
    says that y is a position, and axes whose output is a speed are compared, too.

    Each is fitted by least squares to all folds but one and judged by that one (Stone, 1974). Of those that are worse
    than the best by no more than a standard error (Breiman, Friedman, Olshen and Stone, 1984), or by no more than what
    their missing coefficients have to be worth, that of fewest coefficients is supported.

    Raises NotEnoughError where the recordings hardly move.
    """
    half = 0.5 * max(float(np.ptp(recording.y)) for recording in recordings)
    swings = half > MIN_SINE_RANGE_RAD and not is_speed
    rate = recordings[0].sample_rate
    speed = max(_rms_speed(recording, is_speed) for recording in recordings)
    stribeck = float(f"{STRIBECK_SHARE * speed:.2g}")
    used = [_rows_in_motion(recording, cutoff, is_speed, rest_speed) for recording in recordings]

    def folds(loop: Loop) -> list[_Fold]:
        return [
            fold
            for recording, rows in zip(recordings, used, strict=True)
            for fold in _cut(model_order.form_regressors(recording, loop), rows, cutoff, len(recordings))
        ]

    axis = {"kind": "axis", "y": "speed" if is_speed else "position", "stribeck_speed": stribeck}
    hanging_at = 0.0
    of_axis = folds(_loop(rate, cutoff, _rich_axis(axis, swings, hanging_at)))
    if swings:
        hanging_at = _hanging_angle(of_axis)
        if hanging_at:
            of_axis = folds(_loop(rate, cutoff, _rich_axis(axis, swings, hanging_at)))
    generic = model_order.generic_loop(rate, cutoff)
    powers = generic.plant.names[: len(generic.plant.powers)]
    # what an axis can have is compared in the filters of an axis, so that equal plants are equal to the last bit
    plants = [(*plant, of_axis) for plant in _axes(axis, swings, hanging_at)]
    plants += [(*plant, of_axis) for plant in _polynomials(AXIS_POWERS[is_speed:])]
    of_generic = folds(generic)
    of_higher_order = [plant for plant in _polynomials(powers) if plant[0]["order"] > 2 - is_speed]
    plants += [(*plant, of_generic) for plant in of_higher_order]
    candidates = [candidate for plant in plants if (candidate := _judge(*plant)) is not None]
    if may_be_speed:
        candidates += _judge_speeds(axis, lambda plant: folds(_loop(rate, cutoff, plant)))
    if not is_speed:
        low, high = (pick([pick(recording.y) for recording in recordings]) for pick in (np.min, np.max))
        most = max((candidate.explained for candidate in candidates), default=0.0)
        contacts = [float(f"{low + share * (high - low):.3g}") for share in CONTACT_SHARES]
        wanted = has_valve or kind == "cylinder"
        candidates += _judge_cylinders(lambda plant: folds(_loop(rate, cutoff, plant)), most, contacts, wanted)
    candidates = [candidate for candidate in candidates if kind in (None, candidate.settings["kind"])]
    supported = _choose(candidates, swings, has_valve)
    others = sorted(candidates, key=lambda candidate: -candidate.explained)
    rival = None if is_speed or kind is not None else _rival(supported, of_axis)
    return replace(supported, rival=rival), *(candidate for candidate in others if candidate is not supported)


def _judge_speeds(
    axis: Mapping[str, object], folds: Callable[[Mapping[str, object]], list[_Fold]]
) -> list[PlantCandidate]:
    """Return axes whose output is a speed; without dry friction each is a polynomial of order 1 with stiffness."""
    axis = {**axis, "y": "speed"}
    made = folds(_rich_axis(axis, False, 0.0))
    plants = [plant for plant in _axes(axis, False, 0.0) if "coulomb" in plant[0]["terms"]]
    return [candidate for plant in plants if (candidate := _judge(*plant, made)) is not None]


def _choose(candidates: Sequence[PlantCandidate], swings: bool, has_valve: bool) -> PlantCandidate:
    """Return the plant that is proposed. Raises NotEnoughError where none of them is plausible."""
    plausible = [candidate for candidate in candidates if candidate.plausible]
    if not plausible:
        raise NotEnoughError("it moves too little to compare plants: record a longer motion, or more excitation")
    supported = _support(plausible, swings)
    if has_valve:
        cylinders = [other for other in plausible if other.settings["kind"] == "cylinder"]
        if as_good := [other for other in cylinders if _is_as_good(other, supported)]:
            supported = _support(as_good, swings)
    if "terms" not in supported.settings:  # perhaps because u counts the other way
        turned = [other for other in candidates if other.reversed and other.explained >= MIN_TURNED_SHARE]
        supported = _support([*plausible, *turned], swings)
    return supported


def _rival(supported: PlantCandidate, of_axis: Sequence[_Fold]) -> str | None:
    """Return the kind that a log of this plant can be of as well: a valve and a motor both set a speed."""
    kinds = {"axis": "cylinder", "cylinder": "axis"}
    by_speed = _judge({"kind": "axis"}, ("viscous_friction",), of_axis)
    sets_speed = by_speed is not None and by_speed.plausible and by_speed.explained >= SPEED_SHARE
    return kinds.get(str(supported.settings["kind"])) if sets_speed else None


def _support(candidates: Sequence[PlantCandidate], swings: bool) -> PlantCandidate:
    """Return the simplest of the plants that are as good as the best."""
    best = max(candidates, key=lambda candidate: candidate.worth)
    as_good = (candidate for candidate in candidates if _is_as_good(candidate, best))
    return min(as_good, key=lambda candidate: (*_simplicity(candidate, swings), -candidate.worth))


def _is_as_good(candidate: PlantCandidate, best: PlantCandidate) -> bool:
    tolerance = 0.0
    if len(candidate.squares) == len(best.squares):
        difference = candidate.squares - best.squares
        tolerance = float(np.sqrt(len(difference)) * difference.std())
    excess = best.worth - candidate.worth
    saved = best.coefficients - candidate.coefficients
    return excess <= max(tolerance, ((1.0 + MIN_GAIN) ** saved - 1.0) * (1.0 - best.explained), MIN_SHARE * saved)


def _simplicity(candidate: PlantCandidate, swings: bool) -> tuple[int, bool, bool]:
    """Return what is compared of plants that explain alike: what swings hangs on a weight more often than on a spring.

    Faults of an axis have names and its refit; what a spring holds without friction is a linear system of order 2.
    """
    settings = candidate.settings
    terms, polynomial = settings.get("terms", []), "terms" not in settings
    assert isinstance(terms, list)
    spring = "stiffness" in terms or settings.get("stiffness") is True
    rubs = "coulomb" in terms or settings.get("friction") == "coulomb"
    return candidate.coefficients, swings and spring, polynomial == (rubs or not spring)


def _rich_axis(axis: Mapping[str, object], swings: bool, hanging_at: float) -> dict[str, object]:
    terms = [term for term in AXIS_TERMS if term != "stiffness" or axis["y"] == "position"]
    swing = {"period": 2.0 * np.pi, "hanging_at": hanging_at} if swings else {}
    return {**axis, **swing, "terms": [*terms, *(SWING_TERMS if swings else ())]}


def _loop(rate: float, cutoff: float, plant: Mapping[str, object]) -> Loop:
    sign = {"sign_cutoff": min(model_order.FAST_SIGN, rate / 4.0)}
    monitor = MonitorSettings(cutoff=cutoff, evaluation_rate=min(10.0, rate), frequencies=(rate / 10.0,))
    return Loop(name="compared", sample_rate=rate, plant=parse_plant({**plant, **sign}), monitor=monitor)


def _judge_cylinders(
    folds: Callable[[Mapping[str, object]], list[_Fold]], explained: float, contacts: Sequence[float], wanted: bool
) -> list[PlantCandidate]:
    """Return cylinders on which a spring acts; with a process force too, if that explains more than the others do.

    Without a load that takes its part of the pressure, a cylinder is as good as an axis, and judged if it is `wanted`.
    """
    judged: list[PlantCandidate] = []
    for contact in (None, *contacts):
        friction_settings = {} if contact is None else {"contact": contact}
        loads = ("spring",) if contact is None else ("spring", "process")
        made = folds({"kind": "cylinder", "terms": [*loads, "overlap", "offset"], **friction_settings})
        unloaded: list[list[str]] = [[], ["overlap"]] if wanted and contact is None else []
        for chosen in (*unloaded, list(loads), [*loads, "overlap"]):
            names = ("acceleration", *cylinder.BY_DIRECTION, *(cylinder.TERMS[term].coefficient for term in chosen))
            candidate = _judge({"kind": "cylinder", "terms": [*chosen, "offset"], **friction_settings}, names, made)
            judged += [] if candidate is None else [candidate]
        if max((candidate.explained for candidate in judged), default=0.0) <= explained:
            break
    return judged


def _axes(
    axis: Mapping[str, object], swings: bool, hanging_at: float
) -> Iterator[tuple[dict[str, Any], tuple[str, ...]]]:
    """Yield axes with the names of their columns."""
    viscous: tuple[tuple[str, ...], ...] = ("viscous",), ("viscous_by_direction",)
    dry: tuple[tuple[str, ...], ...] = (), ("coulomb",), ("coulomb", "stribeck")
    swing = (("gravity",), ("gravity", "load_friction")) if swings else ()
    position: tuple[tuple[str, ...], ...] = ((),) if axis["y"] == "speed" else ((), ("stiffness",), *swing)
    for terms in product(viscous, dry, position):
        chosen = [term for group in terms for term in group]
        settings: dict[str, Any] = {"kind": "axis"} | ({"y": "speed"} if axis["y"] == "speed" else {})
        settings["terms"] = [*chosen, "offset"]
        if "stribeck" in chosen:
            settings["stribeck_speed"] = axis["stribeck_speed"]
        if "gravity" in chosen and hanging_at:
            settings["hanging_at"] = hanging_at
        names = [column.coefficient for term in chosen for column in TERMS[term]]
        yield settings, ("inertia", *names)


def _polynomials(names: Sequence[str]) -> Iterator[tuple[dict[str, Any], tuple[str, ...]]]:
    """Yield polynomials in s with the names of their columns; `names`: those of the powers."""
    for order, stiffness, friction in product(range(1, len(names)), (False, True), ("none", "coulomb")):
        settings = {"kind": "polynomial", "order": order, "friction": friction, "stiffness": stiffness, "offset": True}
        rub = ["coulomb_friction"] * (friction == "coulomb")
        yield settings, (*names[0 if stiffness else 1 : order + 1], *rub)


def _judge(settings: dict[str, object], names: tuple[str, ...], folds: Sequence[_Fold]) -> PlantCandidate | None:
    """Fit a plant to all folds but one, predict that one; None where there are too few rows."""
    made = [fold.matrix(names) for fold in folds]
    if sum(map(len, made)) < MIN_ROWS_PER_COLUMN * len(names):
        return None
    products = [(X.T @ X, X.T @ fold.eta) for X, fold in zip(made, folds, strict=True)]
    A, c = (np.sum(parts, axis=0) for parts in zip(*products, strict=True))
    size = np.sqrt(np.diag(A))
    if not size.all():
        return None

    def solve(A: FloatArray, c: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.lstsq(A / np.outer(size, size), c / size, rcond=1e-12)[0] / size)

    whole = sum(float(fold.eta @ fold.eta) for fold in folds)
    squares = []
    for X, fold, (a, b) in zip(made, folds, products, strict=True):
        left = fold.eta - X @ solve(A - a, c - b)
        squares.append(np.add.reduceat(left**2, fold.blocks) / whole)
    together = np.concatenate(squares)
    theta = dict(zip(names, solve(A, c), strict=True))
    every = [
        *(column for columns in TERMS.values() for column in columns),
        cylinder.ACCELERATION,
        *cylinder.TERMS.values(),
    ]
    signed = {column.coefficient for column in every if column.signed}
    positive = {value > 0.0 for name, value in theta.items() if name not in signed}
    has_terms = "terms" in settings
    plausible, reverse = not has_terms or positive == {True}, has_terms and positive == {False}
    return PlantCandidate(settings, 1.0 - float(together.sum()), together, len(names), plausible, reverse)


def _cut(g: model_order.Regressors, used: BoolArray, cutoff: float, recordings: int) -> Iterator[_Fold]:
    """Yield the folds of a recording: itself where there are many, else pieces of it."""
    every = max(1, int(g.loop.sample_rate / (ROWS_PER_PERIOD * cutoff)))
    rows = np.flatnonzero(g.ok & used)[::every]
    pieces = 1 if recordings >= MIN_FOLDS else -(-MIN_FOLDS // recordings)
    block = round(BLOCK_S * g.loop.sample_rate / every)
    for part in np.array_split(rows, pieces):
        columns = dict(zip(g.bank.names, (g.phi[part] - g.phi[part].mean(axis=0)).T, strict=True))
        if "viscous_friction_forward" in columns:  # one coefficient for both directions
            columns["viscous_friction"] = columns["viscous_friction_forward"] + columns["viscous_friction_backward"]
        yield _Fold(g.eta[part] - g.eta[part].mean(), columns, np.arange(0, len(part), max(1, min(block, len(part)))))


def _hanging_angle(folds: Sequence[_Fold]) -> float:
    """Return where a weight hangs [rad], 0 where that is as likely."""
    names = "inertia", "viscous_friction", "coulomb_friction", "cogging_cos", "gravity"

    def angle(some: Sequence[_Fold]) -> float:
        X, e = np.vstack([fold.matrix(names) for fold in some]), np.concatenate([fold.eta for fold in some])
        cosine, sine = np.linalg.lstsq(X, e, rcond=None)[0][-2:]
        return float(np.arctan2(-cosine, sine))

    whole = angle(folds)
    without = [angle([*folds[:k], *folds[k + 1 :]]) for k in range(len(folds))]
    off = (np.array(without) - whole + np.pi) % (2.0 * np.pi) - np.pi
    std = float(np.sqrt((len(folds) - 1) * np.mean(off**2)))  # the jackknife's (Tukey, 1958)
    return round(whole, 3) if abs(whole) > max(MIN_ANGLE_RAD, MIN_ANGLE_STDS * std) else 0.0


def _rms_speed(recording: Recording, is_speed: bool) -> float:
    if is_speed:
        return float(np.sqrt(np.mean(recording.y**2)))
    steps = np.diff(recording.y)[~recording.restart[1:]] * recording.sample_rate
    return float(np.sqrt(np.mean(steps**2)))


def _rows_in_motion(recording: Recording, cutoff: float, is_speed: bool, rest_speed: float) -> BoolArray:
    """Return where the output neither rests nor the filters remember a rest, shape (N,)."""
    g = model_order.form_regressors(recording, model_order.generic_loop(recording.sample_rate, cutoff))
    at_rest, _ = signals.detect_rest(recording, g.phi[:, 1 - is_speed], rest_speed / 3.0)
    return g.ok & model_order.motion_mask(g, at_rest)
