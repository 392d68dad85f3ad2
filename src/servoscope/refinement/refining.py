"""The refit of the seconds around an onset: every fault and every pair, when, how large, how probable, what is left."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from servoscope.baseline import Baseline
from servoscope.plants import Fault, FloatArray
from servoscope.recording import Recording
from servoscope.refinement.goodness import Goodness, goodness, traces
from servoscope.refinement.hypotheses import IN_REACH, Evidence, Fitted, Scale, evidence, fit, free, freed
from servoscope.refinement.outside import outside
from servoscope.refinement.since import Since, since
from servoscope.refinement.starts import Ladder, valleys
from servoscope.refinement.window import Growth, Window

BEFORE_S = 60.0  # of healthy motion before the onset
AFTER_S = 240.0  # of motion with the change
MOST = 40_000  # samples in a window
PAIRS = 0.02  # probability that two faults come at once, before anything is known
OUTSIDE = 0.01  # and that it is a parameter outside the list of faults
LOOKS = 4  # for the onset, each with the sizes that fit the one before
WORTH_A_LOOK = 1.0  # of the sum of squares that a look gained, for another one
SHARP = 20  # samples of an onset's interval, up to which the step is loud


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One explanation: its fit, its evidence and its probability."""

    fitted: Fitted
    evidence: Evidence
    probability: float

    @property
    def name(self) -> str:
        """Names of its faults, joined by plus signs."""
        return " + ".join(fault.name for fault in self.fitted.faults)


@dataclass(frozen=True, eq=False)
class Refined:
    """What the refit says.

    Parameters
    ----------
    window
        What it looked at.
    hypotheses
        Most probable first.
    outside
        Parameters outside the list of faults, each as if it alone had changed.
    unknown
        Probability that it is none of the hypotheses.
    goodness
        Of the most probable one.
    since
        Onset, in samples of the window.
    louder
        Variance of the innovations under it, 1 for the baseline's noise.
    rough
        Sample of the window from which the search for the onset started.
    """

    window: Window
    hypotheses: tuple[Hypothesis, ...]
    outside: tuple[Fitted, ...]
    unknown: float
    goodness: Goodness
    since: Since
    louder: float
    rough: int

    @property
    def is_unknown(self) -> bool:
        """Whether none of the hypotheses is the most probable answer."""
        return self.unknown > self.best.probability

    @property
    def best(self) -> Hypothesis:
        """The most probable hypothesis."""
        return self.hypotheses[0]


def window_of(baseline: Baseline, recording: Recording, onset: int, last: int) -> Window:
    """Return the stretch around an onset, to the sample `last` at most."""
    rate = recording.sample_rate
    first = max(onset - min(round(BEFORE_S * rate), MOST // 4), 0)
    end = min(last + 1, onset + round(AFTER_S * rate), first + MOST)
    return Window.of(baseline, recording, first, end)


def refine(
    baseline: Baseline,
    recording: Recording,
    onset: int,
    announced: int,
    last: int,
    progress: Callable[[], None] = lambda: None,
) -> Refined:
    """Fit every fault and every pair of faults to the seconds around an onset.

    Maximum likelihood on the innovations of the exact sampled plant (Ljung, 1999, chapter 7), so that sizes scatter as
    little as the Cramer-Rao bound allows; the healthy parameters are free as far as the baseline does not know them.

    Parameters
    ----------
    baseline, recording
        What is compared with what.
    onset
        Sample from which the search for the onset starts.
    announced
        Sample of the alarm: the onset is not later.
    last
        Last sample that counts.
    progress
        Called now and then.
    """
    search = _Search(window_of(baseline, recording, onset, last), baseline.plant.faults, onset, announced, progress)
    return search.run()


class _Search:
    def __init__(
        self, window: Window, faults: Sequence[Fault], onset: int, announced: int, progress: Callable[[], None]
    ) -> None:
        self.window, self.faults, self.progress = window, faults, progress
        self.latest = min(announced - window.first, window.samples - 1)
        self.rough = max(min(onset - window.first, self.latest), 0)
        self.growth = Growth(self.rough)
        self.louder = 1.0

    def run(self) -> Refined:
        nothing = np.zeros(self.window.nuisances)
        found, singles = self._begun(nothing)
        self.growth = found.growth
        pairs = [
            self._fit([*one.faults, *other.faults], nothing, [np.append(one.x, 0.0), np.append(0.0, other.x)])
            for one, other in combinations(singles, 2)
        ]
        found, everything = self._settled(found, [*singles, *pairs])
        if not self._explains(self._heard(everything)):
            # no fault alone is near the truth, nor are the sizes that the pairs started from
            pairs = [self._fit(p.faults, nothing, [p.x, *valleys(self.window, p.faults, self.growth)]) for p in pairs]
            found, everything = self._settled(found, [*singles, *pairs])
        best = self._heard(everything)
        everything = [self._own(f, best) for f in everything]
        if found.high - found.low <= SHARP and not found.growth.over:
            found, everything = self._sharpened(found, everything)
        return self._weighed(everything, found)

    def _sharpened(self, found: Since, fitted: Sequence[Fitted]) -> tuple[Since, list[Fitted]]:
        """Move the onset of a loud step sample by sample: its sizes do not follow linearly from one to the next."""
        best = self._heard(fitted)
        for step in (4, 2, 1):
            for way in (-step, step):
                while 0 <= best.growth.since + way <= self.latest:
                    moved = self._free(self._again(best, Growth(best.growth.since + way)))
                    if best.J - WORTH_A_LOOK * self.louder < moved.J:
                        break
                    best = moved
        growth = best.growth
        if growth == found.growth:
            return found, list(fitted)
        onset = replace(found, growth=growth, low=min(found.low, growth.since), high=max(found.high, growth.since))
        everything = self._freed([self._again(f, growth) for f in fitted])
        return onset, [best if f.names == best.names else f for f in everything]

    def _settled(self, found: Since, fitted: Sequence[Fitted]) -> tuple[Since, list[Fitted]]:
        """Find the onset and the sizes of the best hypothesis in turns if it is a pair, then let the others follow."""
        best = self._heard(fitted)
        for _ in range(LOOKS if len(best.faults) > 1 else 0):
            found = self._since(best)
            after = self._again(best, found.growth)
            gained, best = best.J - after.J, after
            if gained < WORTH_A_LOOK * self.louder:
                break
        self.growth = found.growth
        everything = self._freed([self._again(f, found.growth) for f in fitted])
        self._heard(everything)
        return found, everything

    def _explains(self, fitted: Fitted) -> bool:
        good = self._goodness(fitted)
        return good.statistic <= good.limit

    def _begun(self, d: FloatArray) -> tuple[Since, list[Fitted]]:
        """Find the onset and the sizes of single faults in turns; drifts are tried once the steps have settled.

        The recursion's onset may be far off where a fault moves its coefficients along a curve, as oil does; the alarm
        is never far behind. Sizes that fit a wrong onset may be stuck: a ladder of sizes is looked at each time.
        """
        ladders = [Ladder.of(self.window, fault, d) for fault in self.faults]
        begin = min(
            sorted({self.rough, self.latest}),
            key=lambda k: min(float(ladder.costs(self.window, Growth(k)).min()) for ladder in ladders),
        )
        singles = self._singles(Growth(begin), d, ladders)
        for drifts in (False, True):
            for _ in range(LOOKS):
                best = self._heard(singles)
                found = self._since(best, drifts)
                if found.growth == self.growth:
                    break
                singles = self._singles(found.growth, d, ladders, singles)
                gained = best.J - self._heard(singles).J
                if gained < WORTH_A_LOOK * self.louder:
                    break
        return found, singles

    def _singles(
        self, growth: Growth, d: FloatArray, ladders: Sequence[Ladder], known: Sequence[Fitted] = ()
    ) -> list[Fitted]:
        """Fit every fault alone, from the valleys of its ladder and from a size that is known."""
        self.growth = growth
        starts = [ladder.valleys(self.window, growth) for ladder in ladders]
        for each, other in zip(starts, known, strict=False):
            each.append(other.x)
        return [self._fit([fault], d, each) for fault, each in zip(self.faults, starts, strict=True)]

    def _fit(self, faults: Sequence[Fault], d: FloatArray, starts: Sequence[FloatArray]) -> Fitted:
        self.progress()
        return fit(self.window, faults, self.growth, d, starts, free=False)

    def _freed(self, fitted: Sequence[Fitted]) -> list[Fitted]:
        """Let the healthy parameters follow: a second fault that stands in for their error must not outrun the first.

        Under a large fault they matter.
        """
        self.progress()
        followed = freed(self.window, fitted, self.louder)
        best = self._heard(followed)
        return [self._free(f) if self._within(f, best) and not f.is_free else f for f in followed]

    def _free(self, fitted: Fitted) -> Fitted:
        self.progress()
        return free(self.window, fitted)

    def _again(self, fitted: Fitted, growth: Growth) -> Fitted:
        if fitted.growth == growth:
            return fitted
        return fit(self.window, fitted.faults, growth, fitted.d, [fitted.x], free=False)

    def _own(self, fitted: Fitted, best: Fitted) -> Fitted:
        """Let another single fault that is within reach have its own onset."""
        if fitted is best or len(fitted.names) > 1 or not self._within(fitted, best):
            return fitted
        growth = self._since(fitted).growth
        return fitted if growth == fitted.growth else self._free(self._again(fitted, growth))

    def _within(self, fitted: Fitted, best: Fitted) -> bool:
        return IN_REACH * self.louder >= fitted.J - best.J

    def _best(self, fitted: Sequence[Fitted]) -> Fitted:
        """Return the closest hypothesis; a second fault must be worth its freedom."""
        return min(fitted, key=lambda f: f.J + 2.0 * np.log(1.0 / PAIRS) * (len(f.names) - 1) * self.louder)

    def _heard(self, fitted: Sequence[Fitted]) -> Fitted:
        """Return the closest hypothesis after hearing from it how loud the noise is."""
        best = self._best(fitted)
        self.louder = best.J / self.window.samples
        return best

    def _since(self, fitted: Fitted, drifts: bool = True) -> Since:
        return since(self.window, fitted, self.latest, self.louder, drifts)

    def _weighed(self, fitted: Sequence[Fitted], found: Since) -> Refined:
        window, n = self.window, len(self.faults)
        scales = {fault: Scale.of(window, fault, found.growth) for fault in self.faults}
        several = PAIRS if n > 1 else 0.0
        prior = {1: (1.0 - several - OUTSIDE) / n, 2: several / max(n * (n - 1) / 2, 1)}
        best = self._heard(fitted)
        top = self._evidence(best, scales)
        told = [
            self._evidence(f, scales)
            if self._within(f, best)
            else Evidence(top.log - 0.5 * (f.J - best.J) / self.louder, f.intervals(self.louder))
            for f in fitted
        ]
        logs = np.array([e.log + np.log(prior[len(f.names)]) for e, f in zip(told, fitted, strict=True)])
        likeliest = int(np.argmax(logs))
        good = self._goodness(fitted[likeliest])
        # unknown: what nothing explains, or what a parameter outside the list explains better
        others = outside(window, fitted[likeliest].growth, fitted[likeliest], self.louder)
        rivals = [self._evidence(f, {}).log - np.log(len(others) / OUTSIDE) for f in others if self._within(f, best)]
        nothing = logs[likeliest] + 0.5 * (good.statistic - good.limit)
        logs = np.append(logs, np.logaddexp.reduce([nothing, *rivals]))
        probability = np.exp(logs - logs.max())
        probability /= probability.sum()
        told = [e.wider(f, found.spread) for e, f in zip(told, fitted, strict=True)]
        # by their logarithms: under a change that is unknown all probabilities may vanish
        order = np.argsort(-logs[:-1], kind="stable")
        hypotheses = tuple(Hypothesis(fitted[i], told[i], float(probability[i])) for i in order)
        return Refined(window, hypotheses, tuple(others), float(probability[-1]), good, found, self.louder, self.rough)

    def _evidence(self, fitted: Fitted, scales: Mapping[Fault, Scale]) -> Evidence:
        each = [scales.get(fault) or Scale.of(self.window, fault, fitted.growth) for fault in fitted.faults]
        return evidence(self.window, fitted, each, self.louder)

    def _goodness(self, fitted: Fitted) -> Goodness:
        window, growth = self.window, fitted.growth
        predictor = window.predictor(fitted.d, fitted.names, fitted.x, growth)
        healthy = window.predictor(fitted.d, (), np.zeros(0), growth)
        where = np.arange(window.samples) >= growth.since
        e = fitted.residual[: window.samples]
        shift = float(np.linalg.norm(window.innovations(healthy, growth) - e))
        return goodness(traces(window, predictor, growth, where), fitted.jacobian, fitted.residual, self.louder, shift)
