"""Whether a motor axis changed within a recording: its coefficients, by sums over blocks, or its vibration."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from servoscope.baseline.axis_model import AxisModel, AxisMoves, AxisSums
from servoscope.baseline.baseline import Baseline
from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.core.errors import NotEnoughError
from servoscope.core.verdict import Segment
from servoscope.isolation.ml.axis_vibration import (
    BANDS,
    FALSE_ALARMS,
    MIN_AMPLITUDE_RATIO,
    AxisVibration,
    find_vibration,
    scan_limit,
)
from servoscope.isolation.ml.axis_window import AxisWindow
from servoscope.isolation.ml.hypothesis import fit_hypothesis
from servoscope.isolation.ml.window import ChangeProfile
from servoscope.models.loop import Loop
from servoscope.signals import Recording
from servoscope.sums.axis import AxisEquations
from servoscope.sums.healthy import Healthy
from servoscope.sums.learning import learn
from servoscope.sums.verdict import detection_s, sums_evidence

MAX_SAMPLES = 40_000  # samples of a stretch that is searched for vibration
HEALTHY_MARGIN = 1.5  # times as far as the furthest, a further healthy recording may well come


@dataclass(frozen=True)
class AxisChange:
    """Changes within a recording, by sample of the recording."""

    onset_interval: tuple[int, int, int]  # of the first one: lower end, most likely and upper end
    detected: int  # when what had been measured by then was enough for it
    nats: float  # evidence, without what healthy recordings have in themselves
    spans: tuple[tuple[int, int], ...]  # begin and end of each time that is not healthy; an end beyond: it lasts
    segments: tuple[Segment, ...] = ()  # of the coefficients; none: a vibration
    vibration: AxisVibration | None = None  # its onsets are samples of the recording

    @property
    def may_be_single(self) -> bool:
        """Whether one change that lasts may be all: after a healthy time; several steps of one cause may be a drift."""
        first, *others = self.segments
        causes = {segment.explanations[0].causes for segment in others if segment.changed}
        return not first.changed and all(segment.changed for segment in others) and len(causes) == 1

    def holds(self, index: IntArray) -> BoolArray:
        """Return at which samples (K,) a change had been detected and was not yet repaired."""
        held = np.zeros(len(index), dtype=np.bool_)
        for begin, end in self.spans:
            # what is detected after the last evaluation is told by that one
            held |= (index >= min(begin, int(index[-1:].min(initial=end)))) & (index < end)
        return held


def learn_changes(loop: Loop, recordings: Sequence[Recording], moves: AxisMoves | None) -> AxisSums | None:
    """Return what tells changes within a recording; None where healthy recordings are too short."""
    equations = AxisEquations.of_healthy(loop, recordings, None if moves is None else moves.by_coefficient)
    try:
        healthy = learn(equations, [equations.sums(recording) for recording in recordings])
    except NotEnoughError:
        return None
    matrices = {name: tuple(map(tuple, getattr(healthy, name).tolist())) for name in ("within", "between")}
    return AxisSums(
        names=equations.names,
        theta=tuple(healthy.theta[:, 0].tolist()),
        unit=tuple(healthy.unit.tolist()),
        kappa=healthy.kappa,
        inflation=healthy.inflation,
        degrees=healthy.degrees,
        unexplained=healthy.unexplained,
        recordings=len(recordings),
        left_out=healthy.left_out,
        limit=healthy.limit,
        rest_speed=equations.rest_speed,
        **matrices,
    )


def healthy_sums(loop: Loop, model: AxisModel) -> Healthy | None:
    """Return the healthy axis as sums know it; None where the baseline does not."""
    if (known := model.changes) is None:
        return None
    factors = None if model.moves is None else model.moves.by_coefficient
    return Healthy(
        AxisEquations.of_loop(loop, known.rest_speed, factors),
        np.array(known.theta)[:, None],
        np.array(known.unit),
        known.kappa,
        np.array(known.within),
        np.array(known.between),
        known.inflation,
        known.degrees,
        known.unexplained,
        np.array([[1.0 / known.recordings]]),
        known.left_out,
        known.limit,
    )


def find_axis_change(baseline: Baseline, recording: Recording) -> AxisChange | None:
    """Return the changes of an axis within a recording, None where there is none.

    The recording is compared with itself, so scatter between recordings hides nothing; a constant force is its own.
    Where a vibration is the likelier change, it has the name: a rattling load moves coefficients a little, and a new
    mass rings.
    """
    assert baseline.axis is not None
    change = _coefficient_change(baseline, recording)
    vibration = _vibration_change(baseline, recording, 0.0 if change is None else 2.0 * change.nats)
    return vibration or change


def _coefficient_change(baseline: Baseline, recording: Recording) -> AxisChange | None:
    assert baseline.axis is not None
    if (healthy := healthy_sums(baseline.loop, baseline.axis)) is None:
        return None
    sums = healthy.equations.sums(recording)
    if len(sums.c) < len(healthy.unit):
        return None
    told = sums_evidence(healthy, sums)
    if not told.inside or told.nats <= healthy.limit:
        return None

    def sample(t: float) -> int:
        return min(int(np.searchsorted(recording.t, t)), recording.samples - 1)

    first, second = told.segments[:2]
    low, likely, high = map(sample, second.begin_s)
    detected = sample(detection_s(healthy, sums, told.segments))
    spans = []
    for segment in told.segments:
        begin = 0 if segment is first else detected if segment is second else sample(segment.begin_s[1])
        lasts = segment is told.segments[-1]
        spans += [(begin, recording.samples if lasts else sample(segment.end_s[1]))] if segment.changed else []
    return AxisChange((low, likely, high), detected, told.nats - healthy.excess, tuple(spans), told.segments)


def _vibration_change(baseline: Baseline, recording: Recording, rival: float) -> AxisChange | None:
    """Return the first vibration that is likelier than a rival change, by squared t statistic; None: none is."""
    model = baseline.axis
    assert model is not None
    enough = max(scan_limit(BANDS), model.vibration_limit)
    for window in _stretches(baseline.loop, model, recording):
        vibration = find_vibration(window, _healthy_residual(window), max(rival, enough))
        if vibration is not None:
            low, at, high = (window.first_sample + window.stride * k for k in vibration.onset)
            detected = window.first_sample + window.stride * vibration.detected
            nats = -float(np.log(FALSE_ALARMS)) * vibration.statistic / enough
            vibration = replace(vibration, onset=(low, at, high))
            return AxisChange((low, at, high), detected, nats, ((detected, recording.samples),), vibration=vibration)
    return None


def largest_vibration(loop: Loop, model: AxisModel, recording: Recording) -> float:
    """Return the squared t statistic of the loudest band of a healthy recording; 0 where none is nearly a fault."""
    limit, ratio = scan_limit(BANDS) / HEALTHY_MARGIN, MIN_AMPLITUDE_RATIO / HEALTHY_MARGIN
    shaken = (
        find_vibration(window, _healthy_residual(window), limit, ratio) for window in _stretches(loop, model, recording)
    )
    return max((vibration.statistic for vibration in shaken if vibration is not None), default=0.0)


def _healthy_residual(window: AxisWindow) -> FloatArray:
    m, never = window.nuisance_count, ChangeProfile(window.samples)
    return fit_hypothesis(window, [], never, np.zeros(m), [np.zeros(0)], free=True).residual


def _stretches(loop: Loop, model: AxisModel, recording: Recording) -> Iterator[AxisWindow]:
    most = MAX_SAMPLES * model.stride
    for first in range(0, max(recording.samples - most // 2, 1), most // 2):
        rows = recording.rows(slice(first, min(first + most, recording.samples)))
        yield AxisWindow.of_healthy(loop, model, rows, first)
