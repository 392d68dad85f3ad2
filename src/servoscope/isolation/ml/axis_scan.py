"""Whether a motor axis changed within a recording: the likelihood of every onset of every fault against none."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from servoscope.baseline.axis_model import AxisModel
from servoscope.baseline.baseline import Baseline
from servoscope.isolation.ml.axis_vibration import BANDS, MIN_AMPLITUDE_RATIO, AxisVibration, find_vibration
from servoscope.isolation.ml.axis_window import LONG_RUN_S, AxisWindow
from servoscope.isolation.ml.goodness_of_fit import MISFIT_BY_CHANCE
from servoscope.isolation.ml.hypothesis import HypothesisFit, fit_hypothesis
from servoscope.isolation.ml.onset import ChangeCosts
from servoscope.isolation.ml.window import ChangeProfile
from servoscope.models.loop import Loop
from servoscope.models.plants import Fault
from servoscope.models.plants.axis import AxisPlant
from servoscope.signals import Recording

FALSE_ALARMS = 1e-4  # share of healthy recordings that are called changed
EDGE_S = 2.0 * LONG_RUN_S  # of motion before a change and with it: scores hang together for half of that
MIN_EDGE_SHARE, MAX_EDGE_SHARE = 0.01, 0.05  # of the motion of a stretch, at least and at most for that
MAX_ONSETS = 400  # that are tried
MAX_SAMPLES = 40_000  # samples of a stretch
DETECTION_SAMPLES = 4  # of the window, within which the time of a detection is found
HEALTHY_MARGIN = 1.5  # times as far as the furthest, a further healthy recording may well come


@dataclass(frozen=True)
class AxisChange:
    """A change within a recording, by sample of the recording."""

    onset: int  # the most likely one
    detected: int  # when what had been measured by then was enough to tell it
    vibration: AxisVibration | None = None  # where not a coefficient changed; its onsets are samples of the recording
    excess: float = 1.0  # of the likelihood ratio over its limit
    repaired: bool = False  # whether the axis was not what the baseline calls healthy before, and is so since

    @property
    def onset_interval(self) -> tuple[int, int, int]:
        """Lower end, most likely and upper end of the onset; of a coefficient all are one, until the refit."""
        return (self.onset,) * 3 if self.vibration is None else self.vibration.onset


def find_axis_change(baseline: Baseline, recording: Recording) -> AxisChange | None:
    """Return the first change of an axis within a recording, None where there is none.

    A stretch is compared with itself, so scatter between recordings hides nothing; offset and drift are its own.
    """
    model = baseline.axis
    assert model is not None
    faults = model.visible_faults(baseline.plant.faults)
    limit = max(scan_limit(len(faults)), model.change_limit)
    enough = max(scan_limit(BANDS), model.change_limit, model.vibration_limit)
    for window in _stretches(baseline.loop, model, recording):
        fit = _likeliest_change(window, faults)
        change = None if fit is None else _named_change(window, fit, limit, enough)
        if change is not None:
            return change
    return None


def _named_change(window: AxisWindow, change: _ChangeFit, limit: float, enough: float) -> AxisChange | None:
    """Return the likeliest change, of a coefficient above `limit` or of the vibration above `enough`; None: neither."""
    # the larger likelihood ratio has the name: a rattling load moves coefficients a little, and a new mass rings
    vibration = find_vibration(window, change.healthy.residual, max(change.gain, enough))
    if vibration is None and change.gain <= limit:
        return None
    onset = change.changed.profile.onset
    told = vibration.detected if vibration else max(change.detection(window, limit), onset)
    ends = vibration.onset if vibration else (onset, onset, onset)
    low, at, high = (window.first_sample + window.stride * k for k in ends)
    within = vibration and replace(vibration, onset=(low, at, high))
    repaired = vibration is None and _is_repaired(window, onset)
    excess = change.gain / limit if vibration is None else vibration.statistic / enough
    return AxisChange(at, window.first_sample + window.stride * told, within, excess, repaired)


def _is_repaired(window: AxisWindow, onset: int) -> bool:
    """Return whether the axis is healthy since a change, as far as recordings scatter, and was further away before."""
    from scipy.special import chdtri

    m, never = window.nuisance_count, ChangeProfile(window.samples)
    before, after = (
        fit_hypothesis(window.cut(*part), [], never, np.zeros(m), [np.zeros(0)], free=True).d
        for part in ((0, onset), (onset, window.samples))
    )
    known = slice(len(window.model.parameters))  # offset and drift are each recording's own
    off_before, off_after = (float(((window.prior[known, known] @ d[known]) ** 2).sum()) for d in (before, after))
    most, least = (float(chdtri(max(dof, 1), MISFIT_BY_CHANCE)) for dof in (known.stop, 1))
    return off_after < min(most, off_before - least)


def largest_changes(loop: Loop, model: AxisModel, recording: Recording) -> tuple[float, float]:
    """Return how much speaks for a change within a healthy recording: of a coefficient, and of its vibration.

    The first is twice the log-likelihood ratio of the likeliest change, the second the squared t statistic of the
    loudest band; 0 at rest, and where no band is nearly as loud as a fault.
    """
    assert isinstance(loop.plant, AxisPlant)
    faults = model.visible_faults(loop.plant.faults)
    gains, shaken = [0.0], [0.0]
    for window in _stretches(loop, model, recording):
        fit = _likeliest_change(window, faults)
        if fit is not None:
            gains.append(fit.gain)
            vibration = find_vibration(
                window, fit.healthy.residual, scan_limit(BANDS) / HEALTHY_MARGIN, MIN_AMPLITUDE_RATIO / HEALTHY_MARGIN
            )
            shaken.append(0.0 if vibration is None else vibration.statistic)
    return max(gains), max(shaken)


def scan_limit(faults: int, false_alarms: float = FALSE_ALARMS) -> float:
    """Return what the largest likelihood ratio of all onsets exceeds in a share of healthy stretches.

    ``P(sup > x) = sqrt(x/(2 pi)) exp(-x/2) (2 log((1 - t)/t) (1 - 1/x) + 2/x)`` for one parameter, onsets from t to
    1 - t (James, James and Siegmund, 1987), times the number of faults.
    """
    x = np.linspace(5.0, 60.0, 2000)
    range_ = 2.0 * np.log((1.0 - MIN_EDGE_SHARE) / MIN_EDGE_SHARE)
    probability = faults * np.sqrt(x / (2.0 * np.pi)) * np.exp(-x / 2.0) * (range_ * (1.0 - 1.0 / x) + 2.0 / x)
    return float(x[np.argmax(probability <= false_alarms)])


@dataclass(frozen=True)
class _ChangeFit:
    """The likeliest change of a stretch, beside none; the squares of both are in units of `variance`."""

    healthy: HypothesisFit
    changed: HypothesisFit
    variance: float

    @property
    def gain(self) -> float:
        """Twice the logarithm of their likelihood ratio."""
        return (self.healthy.cost - self.changed.cost) / self.variance

    def detection(self, window: AxisWindow, enough: float) -> int:
        """Return the sample at which what had been measured by then was enough: up to it, the axis is fitted anew.

        The fit to the whole stretch would not do: where a change comes early, healthy parameters stand in for it.
        """
        since, N = self.changed.profile.onset, window.samples
        low, high = since, N - 1  # not enough, enough
        while high - low > DETECTION_SAMPLES:
            middle = (low + high) // 2
            past, at = window.cut(0, middle + 1), ChangeProfile(since)
            healthy = fit_hypothesis(past, [], ChangeProfile(N), self.healthy.d, [np.zeros(0)], free=True)
            changed = fit_hypothesis(past, self.changed.faults, at, self.changed.d, [self.changed.x], free=True)
            reached = healthy.cost - changed.cost >= enough * self.variance
            low, high = (low, middle) if reached else (middle, high)
        return high


def _stretches(loop: Loop, model: AxisModel, recording: Recording) -> Iterator[AxisWindow]:
    most = MAX_SAMPLES * model.stride
    for first in range(0, max(recording.samples - most // 2, 1), most // 2):
        rows = recording.rows(slice(first, min(first + most, recording.samples)))
        yield AxisWindow.of_healthy(loop, model, rows, first)


def _likeliest_change(window: AxisWindow, faults: tuple[Fault, ...]) -> _ChangeFit | None:
    N, m = window.samples, window.nuisance_count
    never = ChangeProfile(N)
    healthy = fit_hypothesis(window, [], never, np.zeros(m), [np.zeros(0)], free=True)
    moving = np.cumsum(window.counted)
    share = moving / max(moving[-1], 1)
    edge = float(np.clip(EDGE_S * window.sample_rate / max(moving[-1], 1), MIN_EDGE_SHARE, MAX_EDGE_SHARE))
    inside = np.flatnonzero((share >= edge) & (share <= 1.0 - edge) & window.counted)
    if len(inside) < MAX_ONSETS // 10 or not faults:
        return None
    onsets = inside[:: max(1, len(inside) // MAX_ONSETS)]
    best: tuple[float, Fault, int, float] | None = None
    for fault in faults:
        start = replace(healthy, faults=(fault,), x=np.zeros(1))
        costs, sizes = ChangeCosts(window, start, 1.0).costs(onsets, np.zeros_like(onsets))
        at = int(np.argmin(costs))
        if best is None or costs[at] < best[0]:
            best = float(costs[at]), fault, int(onsets[at]), float(sizes[at, 0])
    assert best is not None
    _, fault, onset, size = best
    begin = np.clip([size], *(0.9 * np.log(fault.ratio_range)))
    changed = fit_hypothesis(window, [fault], ChangeProfile(onset), healthy.d, [begin], free=True)
    variance = window.inflation(changed.jacobian, changed.residual, 1) * changed.cost / window.used
    return _ChangeFit(healthy, changed, variance)
