"""The refit of the seconds around an onset: every fault and every pair, when, how large, how probable, what is left."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.core.arrays import FloatArray
from servoscope.isolation.ml.axis_window import AxisWindow
from servoscope.isolation.ml.goodness_of_fit import GoodnessOfFit, misspecification_columns, score_test
from servoscope.isolation.ml.hypothesis import (
    MAX_EXCESS_SQUARES,
    HypothesisEvidence,
    HypothesisFit,
    SizePrior,
    fit_hypothesis,
    integrate_evidence,
    refit_contenders_jointly,
    refit_jointly,
)
from servoscope.isolation.ml.onset import OnsetEstimate, onset_posterior
from servoscope.isolation.ml.result import Hypothesis, RefitResult
from servoscope.isolation.ml.start_values import SearchStart, begin_searches, fit_further_parameters, pair_start_values
from servoscope.isolation.ml.window import ChangeProfile, ChangeWindow, RefitWindow
from servoscope.models.plants import Fault
from servoscope.signals import Recording

BEFORE_S = 60.0  # of healthy motion before the onset,
AFTER_S = 240.0  # of motion with the change,
MIN_BEFORE_SAMPLES, MIN_AFTER_SAMPLES = 600, 2400  # or so many samples of a loop slower than 10 Hz
MAX_WINDOW_SAMPLES = 40_000  # samples in a window
PAIR_PRIOR = 0.02  # probability that two faults come at once, before anything is known
OUTSIDE_PRIOR = 0.01  # and that it is a parameter outside the list of faults
MAX_LOOKS = 4  # for the onset, each with the sizes that fit the one before
ONSET_MISFIT_VARIANCES = 100.0  # variances by which a fit at another onset is worse if that onset is none
MIN_LOOK_GAIN = 1.0  # of the sum of squares that a look gained, for another one
MAX_PAIR_MISFIT = 10.0  # of what noise leaves unexplained at most, from which a pair is not followed to its onset
WIDE_RATIO_RANGE = (0.02, 500.0)  # of a fault whose best size lies at an end of its own range
MAX_WIDER_SEARCHES = 3  # each with more faults of that range: one, then a pair
MIN_SECOND_SHARE = 0.02  # of the first cause's logarithm, up to which a second one is no cause
MIN_PAIR_GAIN = 10.8  # of the sum of squares over the noise: a second cause that is none gains it once in a thousand
MAX_SHARP_ONSET_SAMPLES = 20  # samples of an onset's interval, up to which the step is loud


def onset_window(baseline: Baseline, recording: Recording, onset: int, last: int) -> ChangeWindow:
    """Return the stretch around an onset, to the sample `last` at most."""
    rate, most = recording.sample_rate, MAX_WINDOW_SAMPLES
    if baseline.axis is not None:
        most *= baseline.axis.stride
    first = max(onset - min(max(round(BEFORE_S * rate), MIN_BEFORE_SAMPLES), most // 4), 0)
    end = min(last + 1, onset + max(round(AFTER_S * rate), MIN_AFTER_SAMPLES), first + most)
    if baseline.axis is not None:
        return AxisWindow.from_recording(baseline, recording, first, end)
    return RefitWindow.from_recording(baseline, recording, first, end)


def fit_hypotheses(
    baseline: Baseline,
    recording: Recording,
    onset: int,
    announced: int,
    last: int,
    progress: Callable[[], None] = lambda: None,
) -> RefitResult:
    """Fit every fault and every pair of faults to the seconds around an onset.

    Maximum likelihood on the innovations of the exact sampled plant (Ljung, 1999, chapter 7), so that sizes scatter as
    little as the Cramer-Rao bound allows; the healthy parameters are free as far as the baseline does not know them.
    The search for the onset starts at the sample `onset` and ends at that of the alarm, `announced`.
    """
    faults = baseline.plant.all_faults
    if baseline.axis is not None:
        faults = baseline.axis.visible_faults(faults)
    return _search(onset_window(baseline, recording, onset, last), faults, onset, announced, progress)


def fit_stretch(window: ChangeWindow, faults: Sequence[Fault], progress: Callable[[], None]) -> RefitResult:
    """Fit every fault and every pair to a window in which the plant differs from healthy from the first sample on."""
    return _search(window, faults, window.first_sample, window.first_sample, progress)


def _search(
    window: ChangeWindow, faults: Sequence[Fault], onset: int, announced: int, progress: Callable[[], None]
) -> RefitResult:
    """Search, with wider ranges while the best size lies at the end of one: a pair stands in for a severe fault there.

    What lies at the end of the widest range has no name, nor has what may be healthy.
    """
    for _ in range(MAX_WIDER_SEARCHES):
        result = _HypothesisSearch(window, faults, onset, announced, progress).run()
        ends = [fault for fault in result.best.fitted.faults_at_ends if fault.ratio_range != WIDE_RATIO_RANGE]
        if not ends:
            break
        faults = [replace(fault, ratio_range=WIDE_RATIO_RANGE) if fault in ends else fault for fault in faults]
    named = [h if h.has_name else replace(h, probability=0.0) for h in result.hypotheses]
    unknown = result.unknown_probability + sum(h.probability for h in result.hypotheses if not h.has_name)
    named.sort(key=lambda hypothesis: -hypothesis.probability)  # stable: where all vanish, the likeliest stays first
    return replace(result, hypotheses=tuple(named), unknown_probability=unknown)


class _HypothesisSearch:
    def __init__(
        self, window: ChangeWindow, faults: Sequence[Fault], onset: int, announced: int, progress: Callable[[], None]
    ) -> None:
        self.window, self.faults, self.progress = window, faults, progress
        # a ray is several parameters at once already: pairs are made of the plant's own faults
        self.rays = {ray.fault.name for ray in window.plant.rays}
        self.latest = min((announced - window.first_sample) // window.stride, window.samples - 1)
        self.initial_onset = max(min((onset - window.first_sample) // window.stride, self.latest), 0)
        self.profile = ChangeProfile(self.initial_onset)
        self.noise_variance, self.settled = 1.0, False

    def run(self) -> RefitResult:
        nothing = np.zeros(self.window.nuisance_count)
        if self.window.follows:  # held, they would pass for the change
            never = ChangeProfile(self.window.samples)
            nothing = fit_hypothesis(self.window, [], never, nothing, [np.zeros(0)], free=True).d
        estimate, singles = self._fit_singles(nothing)
        self.profile = estimate.profile
        pairs = [
            self._fit([*first.faults, *other.faults], nothing, [np.append(first.x, 0.0), np.append(0.0, other.x)])
            for first, other in combinations([f for f in singles if f.faults[0].name not in self.rays], 2)
        ]
        estimate, best = self._iterate_onset(estimate, [*singles, *pairs])
        everything = [best] if self._is_hopeless(best) else self._follow_onset([*singles, *pairs])
        if self._misfit(self._update_noise_variance(everything)) > 1.0:
            # no fault alone is near the truth, nor are the sizes that the pairs started from
            pairs = [self._refit_from_valleys(pair) for pair in pairs]
            estimate, _ = self._iterate_onset(estimate, [*singles, *pairs])
            everything = self._follow_onset([*singles, *pairs])
        best = self._update_noise_variance(everything)
        everything = [self._refit_own_onset(f, best) for f in everything]
        if estimate.high - estimate.low <= MAX_SHARP_ONSET_SAMPLES and not estimate.profile.duration:
            estimate, everything = self._sharpen_onset(estimate, everything)
        self.settled = True
        best = self._update_noise_variance(everything)
        if self.window.coloured:
            settled, onset = self._onset(best), estimate.profile.onset
            estimate = replace(
                settled, profile=estimate.profile, low=min(settled.low, onset), high=max(settled.high, onset)
            )
        return self._weigh(everything, estimate)

    def _sharpen_onset(
        self, estimate: OnsetEstimate, fitted: Sequence[HypothesisFit]
    ) -> tuple[OnsetEstimate, list[HypothesisFit]]:
        """Move the onset of a loud step sample by sample: its sizes do not follow linearly from one to the next."""
        best = self._update_noise_variance(fitted)
        for step in (4, 2, 1):
            for way in (-step, step):
                while 0 <= best.profile.onset + way <= self.latest:
                    moved = self._refit_jointly(self._refit_at(best, ChangeProfile(best.profile.onset + way)))
                    if best.cost - MIN_LOOK_GAIN * self.noise_variance < moved.cost:
                        break
                    best = moved
        profile = best.profile
        if profile == estimate.profile:
            return estimate, list(fitted)
        low, high = min(estimate.low, profile.onset), max(estimate.high, profile.onset)
        onset = replace(estimate, profile=profile, low=low, high=high)
        everything = self._refit_contenders([self._refit_at(f, profile) for f in fitted])
        return onset, [best if f.names == best.names else f for f in everything]

    def _refit_from_valleys(self, pair: HypothesisFit) -> HypothesisFit:
        """Fit a pair from where a grid over all its sizes is lowest, and from where it is unless it has ended there."""
        starts = pair_start_values(self.window, pair.faults, self.profile)
        if pair.profile != self.profile:
            return self._fit(pair.faults, np.zeros_like(pair.d), [pair.x, *starts])
        return min(pair, self._fit(pair.faults, np.zeros_like(pair.d), starts), key=lambda fitted: fitted.cost)

    def _iterate_onset(
        self, onset: OnsetEstimate, fitted: Sequence[HypothesisFit]
    ) -> tuple[OnsetEstimate, HypothesisFit]:
        """Find the onset and the sizes of the best hypothesis in turns if it is a pair."""
        best = self._update_noise_variance(fitted)
        for _ in range(MAX_LOOKS if len(best.faults) > 1 else 0):
            onset = self._onset(best)
            after = self._refit_at(best, onset.profile)
            gained, best = best.cost - after.cost, after
            # a pair that is far off at its own onset is not the truth, whatever further looks gain
            if gained < MIN_LOOK_GAIN * self.noise_variance or self._misfit(best) > MAX_PAIR_MISFIT:
                break
        self.profile = onset.profile
        return onset, best

    def _follow_onset(self, fitted: Sequence[HypothesisFit]) -> list[HypothesisFit]:
        """Let all hypotheses follow to the onset that was found."""
        everything = self._refit_contenders([self._refit_at(f, self.profile) for f in fitted])
        self._update_noise_variance(everything)
        return everything

    def _is_hopeless(self, fitted: HypothesisFit) -> bool:
        """Whether a hypothesis is far off, the healthy parameters following too."""
        return self._misfit(fitted) > MAX_PAIR_MISFIT and self._misfit(self._refit_jointly(fitted)) > MAX_PAIR_MISFIT

    def _misfit(self, fitted: HypothesisFit) -> float:
        """Return what a hypothesis leaves unexplained, in units of what noise leaves at most."""
        good = self._goodness(fitted)
        return good.statistic / good.limit

    def _fit_singles(self, d: FloatArray) -> tuple[OnsetEstimate, list[HypothesisFit]]:
        """Find the onset and the sizes of single faults in turns; drifts are tried once the steps have settled.

        The recursion's onset may be far off where a fault moves its coefficients along a curve, as oil does; the alarm
        is never far behind. Sizes that fit a wrong onset may be stuck: a grid over all sizes is searched each time.
        """
        searches = begin_searches(self.window, self.faults, d)
        onsets = {self.initial_onset, self.latest} | ({0} if self.window.follows else set())
        # a grid that holds the healthy parameters costs the same at every onset where a size of none is its lowest
        at_onsets = [self._fit_each_fault(ChangeProfile(onset), searches) for onset in sorted(onsets)]
        singles = min(at_onsets, key=lambda fitted: min(f.cost for f in fitted))
        self.profile = singles[0].profile
        for drifts in (False, True):
            for _ in range(MAX_LOOKS):
                best = self._update_noise_variance(singles)
                estimate = self._onset(best, drifts)
                if estimate.profile == self.profile:
                    break
                singles = self._fit_each_fault(estimate.profile, searches, singles)
                gained = best.cost - self._update_noise_variance(singles).cost
                if gained < MIN_LOOK_GAIN * self.noise_variance:
                    break
        return estimate, singles

    def _fit_each_fault(
        self, profile: ChangeProfile, searches: Sequence[SearchStart], known: Sequence[HypothesisFit] = ()
    ) -> list[HypothesisFit]:
        """Fit every fault alone, from the local minima of its grids, and from where it was found before."""
        self.profile, singles = profile, []
        for i, fault in enumerate(self.faults):
            begun = [self._fit([fault], d, grids[i].local_minima(self.window, profile)) for d, grids in searches]
            begun += [self._refit_at(before, profile) for before in known[i : i + 1]]
            singles.append(min(begun, key=lambda fitted: fitted.cost))
        return singles

    def _fit(self, faults: Sequence[Fault], d: FloatArray, starts: Sequence[FloatArray]) -> HypothesisFit:
        self.progress()
        return fit_hypothesis(self.window, faults, self.profile, d, starts, free=self.window.follows)

    def _refit_contenders(self, fitted: Sequence[HypothesisFit]) -> list[HypothesisFit]:
        """Let the healthy parameters follow: a second fault must not outrun the first in the place of their error."""
        self.progress()
        followed = refit_contenders_jointly(self.window, fitted, self.noise_variance)
        best = self._update_noise_variance(followed)
        return [
            self._refit_jointly(f) if self._is_contender(f, best) and not f.has_free_nuisances else f for f in followed
        ]

    def _refit_jointly(self, fitted: HypothesisFit) -> HypothesisFit:
        self.progress()
        return refit_jointly(self.window, fitted)

    def _refit_at(self, fitted: HypothesisFit, profile: ChangeProfile) -> HypothesisFit:
        if fitted.profile == profile:
            return fitted
        return fit_hypothesis(self.window, fitted.faults, profile, fitted.d, [fitted.x], free=self.window.follows)

    def _refit_own_onset(self, fitted: HypothesisFit, best: HypothesisFit) -> HypothesisFit:
        """Let another single fault that is within reach have its own onset."""
        if fitted is best or len(fitted.names) > 1 or not self._is_contender(fitted, best):
            return fitted
        profile = self._onset(fitted).profile
        return fitted if profile == fitted.profile else self._refit_jointly(self._refit_at(fitted, profile))

    def _is_contender(self, fitted: HypothesisFit, best: HypothesisFit) -> bool:
        return MAX_EXCESS_SQUARES * self.noise_variance >= fitted.cost - best.cost

    def _best(self, fitted: Sequence[HypothesisFit]) -> HypothesisFit:
        """Return the closest hypothesis; a second fault must be worth its freedom."""
        return min(
            fitted, key=lambda f: f.cost + 2.0 * np.log(1.0 / PAIR_PRIOR) * (len(f.names) - 1) * self.noise_variance
        )

    def _update_noise_variance(self, fitted: Sequence[HypothesisFit]) -> HypothesisFit:
        """Return the closest hypothesis, and take the variance of the noise from it."""
        best = self._best(fitted)
        self.noise_variance = self._variance(best)
        return best

    def _variance(self, fitted: HypothesisFit) -> float:
        """Return the variance of the innovations, as large as the scatter of their scores says."""
        variance = fitted.cost / self.window.used
        if not self.settled:  # far from the truth scores hang together because the explanation is wrong
            return variance
        return variance * self.window.inflation(fitted.jacobian, fitted.residual, len(fitted.x))

    def _onset(self, fitted: HypothesisFit, drifts: bool = True) -> OnsetEstimate:
        estimate = onset_posterior(self.window, fitted, self.latest, self.noise_variance, drifts)
        begin = fitted.profile.onset
        if not self.window.follows or abs(estimate.profile.onset - begin) <= MAX_SHARP_ONSET_SAMPLES:
            return estimate
        # a size that is large, and healthy parameters that follow, are not linear so far from where they were fitted
        most = fitted.cost + ONSET_MISFIT_VARIANCES * self.noise_variance
        is_worse = self._refit_at(fitted, estimate.profile).cost > most
        return OnsetEstimate(fitted.profile, begin, begin, estimate.size_std) if is_worse else estimate

    def _weigh(self, fitted: Sequence[HypothesisFit], onset: OnsetEstimate) -> RefitResult:
        window, n = self.window, len(self.faults)
        scales = {fault: SizePrior.from_window(window, fault, onset.profile) for fault in self.faults}
        own = sum(fault.name not in self.rays for fault in self.faults)
        several = PAIR_PRIOR if own > 1 else 0.0
        prior = {1: (1.0 - several - OUTSIDE_PRIOR) / n, 2: several / max(own * (own - 1) / 2, 1)}
        best = self._update_noise_variance(fitted)
        # tempered, more of them are within reach than were when they were fitted
        fitted = [
            self._refit_jointly(f) if self._is_contender(f, best) and not f.has_free_nuisances else f for f in fitted
        ]
        best = self._best(fitted)
        top = self._evidence(best, scales)
        told = [
            self._evidence(f, scales)
            if self._is_contender(f, best)
            else HypothesisEvidence(
                top.log - 0.5 * (f.cost - best.cost) / self.noise_variance, f.intervals(self.noise_variance)
            )
            for f in fitted
        ]
        logs = np.array([e.log + np.log(prior[len(f.names)]) for e, f in zip(told, fitted, strict=True)])
        likeliest = int(np.argmax(logs))
        good = self._goodness(fitted[likeliest])
        self._prefer_singles(fitted, logs)
        # unknown: what nothing explains, or what a parameter outside the list explains better
        others = fit_further_parameters(window, fitted[likeliest].profile, fitted[likeliest], self.noise_variance)
        rivals = [
            self._evidence(f, {}).log - np.log(len(others) / OUTSIDE_PRIOR)
            for f in others
            if f.has_free_nuisances and self._is_contender(f, best)
        ]
        nothing = logs.max() + 0.5 * (good.statistic - good.limit)
        logs = np.append(logs, np.logaddexp.reduce([nothing, *rivals]))
        probability = np.exp(logs - logs.max())
        probability /= probability.sum()
        told = [e.widen(f, onset.size_std, self.window.size_error) for e, f in zip(told, fitted, strict=True)]
        # by their logarithms: under a change that is unknown all probabilities may vanish
        order = np.argsort(-logs[:-1], kind="stable")
        hypotheses = tuple(Hypothesis(fitted[i], told[i], float(probability[i])) for i in order)
        return RefitResult(
            window,
            hypotheses,
            tuple(others),
            float(probability[-1]),
            good,
            onset,
            self.noise_variance,
            self.initial_onset,
            self.latest,
        )

    def _prefer_singles(self, fitted: Sequence[HypothesisFit], logs: FloatArray) -> None:
        """Let a single fault take the place of a pair that does the same, as soon as the pair might be preferred."""
        singles = sorted((i for i, f in enumerate(fitted) if len(f.faults) == 1), key=lambda i: -logs[i])
        likely = logs[singles[0]] + np.log(PAIR_PRIOR)
        for i, pair in enumerate(fitted):
            if len(pair.faults) > 1 and logs[i] > likely:
                alone = next((k for k in singles if self._is_alike(fitted[k], pair)), None)
                if alone is not None:
                    logs[alone], logs[i] = np.logaddexp(logs[alone], logs[i]), -np.inf

    def _is_alike(self, single: HypothesisFit, pair: HypothesisFit) -> bool:
        """Return whether a single fault differs from a pair by no more than noise, or than the model is trusted to."""
        gain = single.cost - pair.cost - MIN_PAIR_GAIN * self.noise_variance
        if gain <= 0.0:
            return True
        moved = self.window.plant.expand_rays({single.names[0]: np.e})
        direction = np.log([moved.get(name, 1.0) for name in pair.names])
        if not direction.any():  # other parameters: what both do to the innovations
            return gain <= self._model_error(single) ** 2
        size = direction @ pair.x / (direction @ direction)
        trusted = max(MIN_SECOND_SHARE * abs(size), self.window.size_error)
        return bool(np.abs(pair.x - size * direction).max() <= trusted)

    def _evidence(self, fitted: HypothesisFit, scales: Mapping[Fault, SizePrior]) -> HypothesisEvidence:
        sizes = [
            scales.get(fault) or SizePrior.from_window(self.window, fault, fitted.profile) for fault in fitted.faults
        ]
        return integrate_evidence(self.window, fitted, sizes, self.noise_variance)

    def _goodness(self, fitted: HypothesisFit) -> GoodnessOfFit:
        window, profile = self.window, fitted.profile
        predictor = window.predictor(fitted.d, fitted.names, fitted.x, profile)
        healthy = window.predictor(fitted.d, (), np.zeros(0), profile)
        where = np.arange(window.samples) >= profile.onset
        Z, J = misspecification_columns(window, predictor, profile, where), fitted.jacobian
        if window.coloured:  # what the terms left out before the change is no sign of another one
            always = misspecification_columns(window, healthy, profile, np.ones_like(where))
            J = np.hstack([J, np.vstack([always, np.zeros((len(J) - len(always), always.shape[1]))])])
        shift = self._model_error(fitted)
        return score_test(Z, J, fitted.residual, self.noise_variance, shift, window.coloured)

    def _model_error(self, fitted: HypothesisFit) -> float:
        """Return what the model may be off by: a share of what the change does to the innovations, as their norm."""
        window, profile = self.window, fitted.profile
        e = window.innovations(window.predictor(fitted.d, (), np.zeros(0), profile), profile)
        return window.systematic * float(np.linalg.norm(e - fitted.residual[: window.samples]))
