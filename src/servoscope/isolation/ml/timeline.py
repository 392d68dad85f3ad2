"""Several changes in one window: which plant held when, and what explains each stretch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.fit.predictor import Predictor
from servoscope.isolation.ml.hypothesis import HypothesisFit, fit_hypothesis
from servoscope.isolation.ml.onset import onset_posterior
from servoscope.isolation.ml.plant_sequence import SequenceCost, likeliest_sequence
from servoscope.isolation.ml.result import RefitResult
from servoscope.isolation.ml.search import fit_stretch
from servoscope.isolation.ml.start_values import SizeGrid
from servoscope.isolation.ml.window import ChangeProfile, RefitWindow
from servoscope.models.plants import Fault

SWITCH_PRICE = 60.0  # price of a switch in -2 log likelihood: its time is free
SIZE_PRICE = 15.0  # and of each fault of the plant that it leads to: its size is free
MAX_ROUNDS = 4  # of sizes and sequences in turns, at most
MIN_STRETCH_SAMPLES = 25  # samples of a stretch that is fitted,
WINDOW_DIVISOR = 20  # and share of the window, as 1 over so much; shorter ones that follow each other are fitted as one
MAX_STRETCHES = 12  # stretches, beyond which a sequence explains nothing
MAX_WHITE_VARIANCE = 1.15  # mean square of the innovations up to which nothing but noise is left
LEVEL = 0.3  # standard deviation of the logarithm of a parameter while it differs from healthy, when a change is dated
MAX_BRIDGE = 2.2  # sup of a Brownian bridge that is passed in one of ten thousand cases
STRIDES = 16, 1, 16, 1  # samples by which a change is moved,
MAX_MOVES = 16  # and at most so many times
MIN_ROUND_GAIN = 1.0  # that a round of sizes and sequences gained, for another one
FROM_START = ChangeProfile(0)


@dataclass(frozen=True, eq=False)
class ChangedPlant:
    """A plant that may hold for a while: faults and the logarithms of their ratios; without faults it is healthy."""

    faults: tuple[Fault, ...]
    x: FloatArray


HEALTHY = ChangedPlant((), np.zeros(0))


@dataclass(frozen=True, eq=False)
class PlantSequence:
    """Plants that hold one after the other."""

    starts: tuple[int, ...]  # first samples
    plants: tuple[ChangedPlant, ...]
    likelihood: float  # -2 log likelihood but for a constant

    @property
    def cost(self) -> float:
        """The same with the prices of the plants."""
        return self.likelihood + sum(_price(plant) for i, plant in enumerate(self.plants) if i or plant.faults)


@dataclass(frozen=True, eq=False)
class TimelineStretch:
    """A stretch of a window between two changes."""

    begin: tuple[int, int, int]  # first sample: lower end of the 95 % interval, most likely, upper end
    refit: RefitResult | None  # what explains it; None where it is healthy


def is_constant(single: RefitResult) -> bool:
    """Return whether the sizes of the best explanation stay what they are: else there are further changes.

    The scores of the sizes, summed up over time, are a Brownian bridge as long as they do (Nyblom, 1989). A sum of
    squares that grows unevenly shows it too.
    """
    best, N = single.best.fitted, single.window.samples
    e, J = best.residual[:N] / np.sqrt(single.noise_variance), best.jacobian[:N, -len(best.x) :]
    since = best.profile.onset
    scores = [*(J * e[:, None])[since:].T, (e**2 - 1.0)]
    return max(map(bridge_height, scores)) <= MAX_BRIDGE


def bridge_height(score: FloatArray) -> float:
    """Return the height of the bridge that the sums of a score make, in its own standard deviations."""
    path, growth = np.cumsum(score), np.cumsum(score**2)
    return float(np.abs(path - path[-1] * growth / growth[-1]).max() / np.sqrt(growth[-1]))


def find_timeline(
    window: RefitWindow, faults: Sequence[Fault], healthy: int, single: HypothesisFit, progress: Callable[[], None]
) -> tuple[TimelineStretch, ...]:
    """Return the stretches of a window; empty where a single change explains it as well, or nothing does.

    `healthy`: samples at the beginning that are healthy, from which the healthy parameters are told; `single`: the best
    single change, in the same window.
    """
    return _TimelineSearch(window, faults, healthy, progress).run(single)


class _TimelineSearch:
    def __init__(
        self, window: RefitWindow, faults: Sequence[Fault], healthy: int, progress: Callable[[], None]
    ) -> None:
        self.window = window if healthy < MIN_STRETCH_SAMPLES else _learn_from_past(window, healthy)
        self.faults, self.progress = faults, progress
        self.known = np.zeros(self.window.nuisance_count)
        self.grids = [SizeGrid.from_window(self.window, fault, self.known) for fault in faults]
        self.shortest = max(MIN_STRETCH_SAMPLES, window.samples // WINDOW_DIVISOR)

    def run(self, single: HypothesisFit) -> tuple[TimelineStretch, ...]:
        change = ChangedPlant(single.faults, single.x)
        grids = zip(self.faults, self.grids, strict=True)
        plants = [ChangedPlant((fault,), np.array([x])) for fault, grid in grids for x in grid.sizes]
        best = self._sequence([HEALTHY, change, *plants])
        for _ in range(MAX_ROUNDS):
            known = {id(plant): plant for plant in best.plants if plant.faults}
            fitted = list(self._fit_stretches(best))
            sequence = self._sequence([HEALTHY, *known.values(), *(plant for _, plants in fitted for plant in plants)])
            plant_sequence = min(
                sequence, self._place([(k, plants[0]) for k, plants in fitted]), key=lambda candidate: candidate.cost
            )
            if plant_sequence.cost > best.cost - MIN_ROUND_GAIN:
                break
            best = plant_sequence
        if (
            best.cost > self._cost_of(single) + _price(change)
            or best.likelihood > MAX_WHITE_VARIANCE * self.window.samples
        ):
            return ()
        best = self._drop_needless(best)
        if not 2 < len(best.plants) + bool(best.plants[0].faults) <= MAX_STRETCHES:
            return ()
        return tuple(self._explain([*best.starts, self.window.samples], best.plants))

    def _cost_of(self, single: HypothesisFit) -> float:
        """Return the cost of a single change."""
        return float((self.window.residual(np.append(self.known, single.x), single.names, single.profile) ** 2).sum())

    def _sequence(self, plants: Sequence[ChangedPlant]) -> PlantSequence:
        """Return the likeliest sequence of some plants, without stretches too short to say anything."""
        self.progress()
        path = likeliest_sequence(self.window, [*map(self._predictor, plants)], np.array([*map(_price, plants)]))
        starts = [*np.flatnonzero(np.diff(path, prepend=-1)).tolist(), self.window.samples]
        return self._place(
            [(k, plants[path[k]]) for k, end in pairwise(starts) if end - k >= MIN_STRETCH_SAMPLES or not k]
        )

    def _predictor(self, plant: ChangedPlant) -> Predictor:
        return self.window.predictor(self.known, [fault.parameter for fault in plant.faults], plant.x, FROM_START)

    def _place(self, stretches: Sequence[tuple[int, ChangedPlant]]) -> PlantSequence:
        """Return a sequence whose changes are where they are likeliest; neighbours that are the same become one."""
        kept = [(k, plant) for i, (k, plant) in enumerate(stretches) if not i or plant is not stretches[i - 1][1]]
        starts, plants = [k for k, _ in kept], [plant for _, plant in kept]
        cost = SequenceCost(self.window, self.window.healthy, [*map(self._predictor, plants)])
        bounds = [*starts, self.window.samples]

        def moved(i: int, by: int) -> float:
            inside = bounds[i - 1] < bounds[i] + by < bounds[i + 1]
            return cost([*bounds[:i], bounds[i] + by, *bounds[i + 1 : -1]]) if inside else np.inf

        for stride in STRIDES:
            for i in range(1, len(starts)):
                steps = stride * np.arange(-MAX_MOVES, MAX_MOVES + 1)
                bounds[i] += int(steps[np.argmin([moved(i, int(by)) for by in steps])])
        return PlantSequence(tuple(bounds[:-1]), tuple(plants), cost(bounds[:-1]))

    def _drop_needless(self, sequence: PlantSequence) -> PlantSequence:
        """Return a sequence in which every stretch is worth its price: else it is that of a neighbour, or healthy."""
        ends = [*sequence.starts[1:], self.window.samples]
        for i, (plant, begin, end) in enumerate(zip(sequence.plants, sequence.starts, ends, strict=True)):
            short = bool(i) and end - begin < MIN_STRETCH_SAMPLES
            if not plant.faults and not short:
                continue
            others = [HEALTHY, *sequence.plants[max(i - 1, 0) : i], *sequence.plants[i + 1 : i + 2]]
            without = min(
                (
                    self._place(
                        [*zip(sequence.starts, [*sequence.plants[:i], other, *sequence.plants[i + 1 :]], strict=True)]
                    )
                    for other in others
                    if other is not plant
                ),
                key=lambda candidate: candidate.cost,
            )
            if short or without.cost <= sequence.cost:
                return self._drop_needless(without)
        return sequence

    def _fit_stretches(self, sequence: PlantSequence) -> Iterator[tuple[int, list[ChangedPlant]]]:
        """Yield the first sample of each stretch and the plants that may explain it, the likeliest first.

        Pairs are among them where no fault alone explains it. The ends are left out: they may belong to others.
        """
        starts = [*sequence.starts, self.window.samples]
        long = [(begin, end) for begin, end in pairwise(starts) if end - begin >= self.shortest]
        bounds = sorted({0, self.window.samples, *(k for both in long for k in both)})
        for begin, end in pairwise(bounds):
            guard = MIN_STRETCH_SAMPLES if end - begin > 4 * MIN_STRETCH_SAMPLES else 0
            part = self.window.cut(begin + guard * (begin > 0), end - guard * (end < self.window.samples))
            healthy = fit_hypothesis(part, [], FROM_START, self.known, [np.zeros(0)], free=False)
            fitted = [
                fit_hypothesis(part, [fault], FROM_START, self.known, grid.local_minima(part, FROM_START), free=False)
                for fault, grid in zip(self.faults, self.grids, strict=True)
            ]
            if min(fit.cost for fit in fitted) > part.samples + SWITCH_PRICE:
                fitted += list(self._fit_pairs(part, fitted))
            ranked = sorted([healthy, *fitted], key=lambda fit: fit.cost + SIZE_PRICE * len(fit.x))
            yield begin, [ChangedPlant(fit.faults, fit.x) if fit.faults else HEALTHY for fit in ranked]

    def _fit_pairs(self, part: RefitWindow, singles: Sequence[HypothesisFit]) -> Iterator[HypothesisFit]:
        for fit, other in combinations(singles, 2):
            self.progress()
            starts = [np.append(fit.x, 0.0), np.append(0.0, other.x)]
            yield fit_hypothesis(part, [*fit.faults, *other.faults], FROM_START, self.known, starts, free=False)

    def _explain(self, bounds: Sequence[int], plants: Sequence[ChangedPlant]) -> Iterator[TimelineStretch]:
        begins = [(0, 0, 0)]
        for i in range(1, len(plants)):
            begins.append(self._date(bounds[i - 1], bounds[i], bounds[i + 1], plants[i - 1], plants[i]))
        ends = [begin[0] for begin in begins[1:]] + [self.window.samples]
        for begin, end, (first, last), plant in zip(begins, ends, pairwise(bounds), plants, strict=True):
            if not plant.faults:
                yield TimelineStretch(begin, None)
                continue
            # what may belong to the neighbours is left out, unless nothing would remain
            first, last = (begin[2], end) if end - begin[2] >= MIN_STRETCH_SAMPLES else (first, last)
            yield TimelineStretch(begin, fit_stretch(self.window.cut(first, last), self.faults, self.progress))

    def _date(
        self, first: int, change: int, end: int, before: ChangedPlant, after: ChangedPlant
    ) -> tuple[int, int, int]:
        """Return the 95 % interval of a change, and its most likely sample: the change of a plant that was changed."""
        window, names = self.window, self.window.names
        sizes = [dict(zip(plant.faults, plant.x.tolist(), strict=True)) for plant in (before, after)]
        faults = list({**sizes[0], **sizes[1]})
        steps = np.array([sizes[1].get(fault, 0.0) - sizes[0].get(fault, 0.0) for fault in faults])
        ratios = {fault.parameter: float(np.exp(x)) for fault, x in sizes[0].items()}
        covariance = np.linalg.inv(window.prior.T @ window.prior)
        covariance += np.diag([LEVEL**2 * (name in ratios) for name in names])
        prior: FloatArray = np.linalg.inv(np.linalg.cholesky(covariance)).astype(np.float64)
        plant = window.plant.scaled(window.plant.expand_rays(ratios))
        near = replace(window, plant=plant, prior=prior).cut(first, end)
        wide = [replace(fault, ratio_range=(1e-3, 1e3)) for fault in faults]
        fitted = fit_hypothesis(near, wide, ChangeProfile(change - first), self.known, [steps], free=True)
        estimate = onset_posterior(near, fitted, near.samples - 1, fitted.cost / near.samples, drifts=False)
        low, likely, high = (first + k for k in (estimate.low, estimate.profile.onset, estimate.high))
        return low, likely, high


def _price(plant: ChangedPlant) -> float:
    return SWITCH_PRICE + SIZE_PRICE * len(plant.x)


def _learn_from_past(window: RefitWindow, healthy: int) -> RefitWindow:
    """Return a window whose healthy plant is that of its own beginning, known as well as that tells."""
    past, m = window.cut(0, healthy), window.nuisance_count
    if not m:
        return window
    fitted = fit_hypothesis(past, [], ChangeProfile(healthy), np.zeros(m), [np.zeros(0)], free=True)
    plant = window.plant.scaled(dict(zip(window.names, np.exp(fitted.d).tolist(), strict=True)))
    prior: FloatArray = np.linalg.cholesky(fitted.jacobian.T @ fitted.jacobian).T.astype(np.float64)
    return replace(window, plant=plant, prior=prior)
