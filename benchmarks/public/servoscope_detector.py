"""servoscope as one of the detectors of a comparison, and the changes that are injected into measured recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import servoscope as ss
from public.simple_detectors import MARGIN, Scores, detectors, halves, judge
from servoscope.baseline.threshold import NARROW_PRIOR, score_std
from servoscope.diagnosis.diagnose import diagnose_with_trace

ROOT = Path(__file__).resolve().parents[2]
OURS = "servoscope"
COMMON = "false, common limit", "found, common limit"  # 1.5 times the largest score of a healthy one left out
DETECTORS = (OURS, "rms of u", "T^2 of features", "inverse + CUSUM")


@dataclass
class Count:
    """What a detector made of healthy and of changed recordings."""

    false: int = 0
    healthy: int = 0
    found: int = 0
    changed: int = 0
    false_common: int = 0
    found_common: int = 0
    worst: float = 0.0  # largest score of a healthy recording, as a multiple of the limit
    least: float = np.inf  # smallest score of a changed one

    def add(self, scores: Scores, healthy: int) -> None:
        """Count scores; those of the healthy recordings stand first."""
        ratios = [score / scores.limit for score in scores.largest]
        self.false += sum(ratio > 1.0 for ratio in ratios[:healthy])
        self.found += sum(ratio > 1.0 for ratio in ratios[healthy:])
        self.healthy += healthy
        self.changed += len(ratios) - healthy
        common = scores.limit if scores.common is None else scores.common
        self.false_common += sum(score > common for score in scores.largest[:healthy])
        self.found_common += sum(score > common for score in scores.largest[healthy:])
        self.worst = max([self.worst, *ratios[:healthy]])
        self.least = min([self.least, *ratios[healthy:]])

    @property
    def cells(self) -> tuple[str, str, str, str, str, str]:
        """False alarms and changes found, by the own limit and by the common one, and both extreme scores."""
        least = "" if np.isinf(self.least) else f"{self.least:.2f}"
        counts = (self.false, self.healthy), (self.found, self.changed)
        common = (self.false_common, self.healthy), (self.found_common, self.changed)
        rates = [f"{some} of {total}" for some, total in (*counts, *common)]
        return (rates[0], rates[1], rates[2], rates[3], f"{self.worst:.2f}", least)


COLUMNS = ("detector", "false", "found", *COMMON, "largest healthy score / limit", "smallest changed score / limit")


def servoscope_scores(loop: ss.Loop, healthy: Sequence[ss.Recording], judged: Sequence[ss.Recording]) -> Scores:
    """Return the largest statistic of each recording as a multiple of its limit; the limit is 1, and that of all, too.

    Coefficients and features have scores of different spread: recordings are ranked by how far a score is from its
    limit in standard deviations of its logarithm over the healthy recordings, each learned without it.
    """
    largest, order, names = _statistics(loop, healthy, judged)
    parts = list(healthy) if len(healthy) > 1 else halves(healthy[0])
    left_out = [_statistics(loop, [*parts[:i], *parts[i + 1 :]], [part])[0][0] for i, part in enumerate(parts)]
    return Scores(1.0, largest, order, MARGIN * max(left_out), names)


def _statistics(
    loop: ss.Loop, healthy: Sequence[ss.Recording], judged: Sequence[ss.Recording]
) -> tuple[tuple[float, ...], tuple[float, ...], tuple[str, ...]]:
    """Return the largest statistic of each recording, what ranks it, and the causes that are named."""
    baseline = ss.learn(loop, healthy)
    features = baseline.features
    stds = (
        {"features": score_std(features.left_out, NARROW_PRIOR), "t2": score_std(baseline.scatter.left_out)}
        if features
        else {}
    )
    largest, order, names = [], [], []
    for recording in judged:
        diagnosis, trace = diagnose_with_trace(baseline, recording)
        names.append(" + ".join(fault.name for fault in diagnosis.faults))
        ready = trace.ready
        ratios = {one.name: float((one.value / one.limit)[ready].max(initial=0.0)) for one in trace.statistics}
        largest.append(max(ratios.values()))
        order.append(max(ratio ** (1.0 / stds.get(name, 1.0)) for name, ratio in ratios.items()))
    return tuple(largest), tuple(order), tuple(names)


def all_scores(
    loop: ss.Loop, healthy: Sequence[ss.Recording], judged: Sequence[ss.Recording], window_s: float
) -> dict[str, Scores]:
    """Return the scores of servoscope and of the simple detectors, by name."""
    cutoff = loop.monitor.cutoff or 0.1 * loop.sample_rate
    scores = {OURS: servoscope_scores(loop, healthy, judged)}
    return scores | {one.name: judge(one, healthy, judged) for one in detectors(window_s, cutoff)}


def with_gain(recording: ss.Recording, gain: float, share: float = 0.0) -> ss.Recording:
    """Return a recording whose u is multiplied from a share of its samples on."""
    u = recording.u.copy()
    u[int(share * recording.samples) :] *= gain
    return replace(recording, u=u)


def with_coefficient(
    recording: ss.Recording, loop: ss.Loop, coefficient: float, order: int, share: float = 0.0, cutoff_hz: float = 40.0
) -> ss.Recording:
    """Return a recording whose u holds the force of a coefficient that is larger by `coefficient` [force per unit].

    `order`: 1 adds viscous friction, 2 inertia. The derivative of y passes a second-order filter without phase at
    `cutoff_hz`: smoother, and inertia comes out too small.
    """
    from scipy.signal import butter, sosfiltfilt

    sections = butter(2, cutoff_hz, fs=recording.sample_rate, output="sos")
    derivative = sosfiltfilt(sections, recording.y)
    for _ in range(order):
        derivative = np.gradient(derivative) * recording.sample_rate
    u, begin = recording.u.copy(), int(share * recording.samples)
    u[begin:] += coefficient / loop.plant.input_gain * derivative[begin:]
    return replace(recording, u=u)


def with_model_error(loop: ss.Loop, model_error: float) -> ss.Loop:
    """Return a loop with another model error."""
    return loop.model_copy(update={"monitor": loop.monitor.model_copy(update={"model_error": model_error})})
