"""Healthy recordings to the model of their features: windows, limit, and what so many recordings can guarantee."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from operator import itemgetter

import numpy as np

from servoscope.baseline.feature_model import (
    MIN_WIDENING,
    WIDENING_SHARE,
    FeatureModel,
    GroupStatistic,
    fit_groups,
    span_scores,
    spans_in_a_row,
)
from servoscope.baseline.feature_spans import SpanFeatures
from servoscope.baseline.threshold import NARROW_PRIOR, WIDE_PRIOR, robust_limit, score_limit
from servoscope.core import outofcore
from servoscope.core.arrays import FloatArray, to_tuples
from servoscope.core.messages import Message, message
from servoscope.estimation.reference_period import reference_period
from servoscope.estimation.window_features import SPEED_TIME, FeatureLayout, Window, WindowFeatures
from servoscope.evidence.examination import Examination
from servoscope.evidence.kind import EvidenceKind, Finding
from servoscope.models.loop import Loop
from servoscope.signals import Recording

MIN_RECORDINGS = 4  # recordings whose scatter is believed; fewer have no features
BANDS = 7
MIN_PAST_MEMORIES = 3.0  # in each of two parts of a recording that are compared: in less, one event is half of it
PAST_BUDGET = 0.1  # of the budget of false alarms, which the comparison with the own past adds
MIN_PERIODS_PER_WINDOW = 4.0  # periods of the lowest band in a window
MAX_FREQUENCY_SHARE = 0.45  # of the sample rate: the highest frequency
MAX_OUTLIER_SHARE = 0.25  # of the recordings that are outliers; more are another load, or another machine
MAX_WINDOWS = 2000  # of a recording that are learned from
MAX_PERIOD_SEARCH_SAMPLES = 1_000_000  # of a recording, in which a period is looked for
MIN_WINDOW_SAMPLES = 64  # samples of a window
MAX_SPAN_WINDOWS = 24  # windows
EDGES = (1.0 / 32.0, 1.0 / 16.0, 1.0 / 8.0)  # of a period: octaves after a motion began, where friction builds up
LEVELS = 3  # lengths of windows where motion does not repeat
REST_SHARE = 0.05  # of the largest speed, below which the reference rests
SILENT_BAND_SHARE = 1e-9  # share of a signal's power below which a band is silent
REPEATS = 0.02  # of the variance: the reference repeats where its difference after a period stays below


def are_expected(loop: Loop, recordings: Sequence[Recording]) -> bool:
    """Return whether recordings have features to learn: then these take their part of the budget of false alarms.

    Features move with a warm-up that is not logged too, and nothing says how.
    """
    enough = len(recordings) >= MIN_RECORDINGS + len(loop.columns.covariates)
    return bool(loop.monitor.feature_false_alarms) and enough and not loop.monitor.hidden_warm_up


def _judge(exam: Examination) -> Iterator[Finding]:
    """Yield a change of the features beside healthy coefficients, and spans that no healthy recording is like."""
    evidence = exam.features
    if evidence is not None and evidence.unfamiliar:
        count, spans = evidence.unfamiliar, evidence.unfamiliar + len(evidence.spans)
        text = message("warning.unfamiliar", count=count, spans=spans)
        yield Finding.throughout(exam, "doubt", "features", text)
    if evidence is not None and evidence.changed is not None and exam.features_changed_s is not None:
        text, since = evidence.headline(evidence.changed, exam.baseline.point), exam.features_changed_s
        yield Finding("change", "features", text, since, float(exam.recording.t[-1]))


def learn_features(loop: Loop, recordings: Sequence[Recording]) -> tuple[FeatureModel | None, list[Message]]:
    """Learn the features of healthy recordings; None where there are too few recordings, or too short ones."""
    if not are_expected(loop, recordings):
        return None, []
    share = loop.monitor.feature_false_alarms
    layout = choose_layout(loop, recordings)
    runner = WindowFeatures(layout)
    windows = [_windows(runner, recording) for recording in recordings]
    if not all(windows):
        return None, [message("learning.features_short", window_s=layout.window / layout.sample_rate)]
    names = tuple(loop.columns.covariates)
    conditions = np.array([[np.nanmean(recording.channels[name]) for name in names] for recording in recordings])
    past = layout.span_s >= 2.0 * MIN_PAST_MEMORIES * loop.monitor.memory
    spans = [
        [span._replace(covariates=own) for span in _spans(window, layout, past)]
        for window, own in zip(windows, conditions, strict=True)
    ]
    low, high = _motion_range(spans)
    conditions_of = to_tuples(conditions) if names else ()
    left_out, past_left_out = [], []
    for i, own_spans in enumerate(spans):
        groups = fit_groups(
            windows[:i] + windows[i + 1 :],
            spans[:i] + spans[i + 1 :],
            layout,
            conditions_of[:i] + conditions_of[i + 1 :],
        )
        statistics = [GroupStatistic.of(group) for group in groups]
        now, later = np.array([span_scores(statistics, span) for span in own_spans]).max(axis=0).tolist()
        left_out.append(now)
        past_left_out += [later] if any(statistic.group.past for statistic in statistics) else []
    compares_past = len(past_left_out) == len(spans)
    prior = WIDE_PRIOR if names else NARROW_PRIOR
    groups = fit_groups(windows, spans, layout, conditions_of)
    model = FeatureModel(
        layout=layout,
        groups=tuple(group for group in groups if compares_past or not group.past),
        motion_low=tuple(low),
        motion_high=tuple(high),
        left_out=tuple(left_out),
        limit=score_limit(left_out, share, prior),
        false_alarms=share,
        in_a_row=spans_in_a_row(layout, share, loop.monitor.false_alarms_per_year),
        covariates=names,
        past_limit=score_limit(past_left_out, PAST_BUDGET * share, prior) if compares_past else 0.0,
    )
    return model, _describe_outlier(recordings, left_out, robust_limit(left_out, share, prior))


def _describe_outlier(recordings: Sequence[Recording], left_out: Sequence[float], limit: float) -> list[Message]:
    """Return that a healthy recording is unlike the others; none where several are: those are another population."""
    above = [
        (recording.name, score / limit) for recording, score in zip(recordings, left_out, strict=True) if score > limit
    ]
    if not 0 < len(above) <= MAX_OUTLIER_SHARE * len(recordings):
        return []
    name, times = max(above, key=itemgetter(1))
    return [message("learning.features_outlier", recording=name, times=times)]


def _windows(runner: WindowFeatures, recording: Recording) -> list[Window]:
    """Return the windows of a recording, of a long one those of its beginning: more say nothing new of its mean."""
    state, windows = runner.start(), list[Window]()
    for rows in outofcore.iter_chunks(0, recording.samples):
        part = recording.rows(rows)
        windows += runner.run(state, part.r, part.u, part.y, part.restart)
        outofcore.release(*recording.columns)
        if len(windows) >= MAX_WINDOWS:
            break
    return windows


def _spans(windows: Sequence[Window], layout: FeatureLayout, past: bool) -> list[SpanFeatures]:
    """Return the spans of a recording; the last one if it is at least half as long as the others.

    `past`: with their later windows less their earlier ones.
    """
    numbers = sorted({window.span for window in windows})
    members = [[window for window in windows if window.span == number] for number in numbers]
    features = [SpanFeatures.of(member, layout, past=past) for member in members]
    return [span for span in features if 2.0 * span.counts[0] >= layout.span] or features[:1]


def _motion_range(spans: Sequence[Sequence[SpanFeatures]]) -> tuple[FloatArray, FloatArray]:
    seen = np.array([span.motion for span_features in spans for span in span_features])
    seen = np.where(np.isfinite(seen), seen, np.nanmean(np.where(np.isfinite(seen), seen, 0.0), axis=0))
    low, high = seen.min(axis=0), seen.max(axis=0)
    wider = WIDENING_SHARE * (high - low) + MIN_WIDENING
    return low - wider, high + wider


def choose_layout(loop: Loop, recordings: Sequence[Recording]) -> FeatureLayout:
    """Choose windows: whole periods where the reference repeats, otherwise half the memory, the memory and twice it."""
    rate, memory = loop.sample_rate, loop.monitor.memory
    period = _period(recordings)
    if period:
        window, levels = period * max(1, round(memory * rate / period)), 1
        edges = tuple(share * period / rate for share in EDGES)
    else:
        window, levels, edges = max(round(memory * rate / 2.0), MIN_WINDOW_SAMPLES), LEVELS, ()
    counts = [recording.samples // window for recording in recordings]
    whole = float(np.median(counts))
    first = 1 if whole >= 3.0 else 0  # start-up is unlike what follows, where anything follows
    speed = np.concatenate([np.abs(_speed(recording)) for recording in recordings])
    powers = [
        float(np.mean([np.var(x) for x in values]))
        for values in zip(*((r.u, r.r - r.y) for r in recordings), strict=True)
    ]
    top = MAX_FREQUENCY_SHARE * rate
    return FeatureLayout(
        sample_rate=rate,
        window=window,
        levels=levels,
        span=int(np.clip(whole - first, 1, MAX_SPAN_WINDOWS)),
        settling=first * window,
        rest_speed=REST_SHARE * float(speed.max()),
        edges_s=edges,
        bands_hz=tuple(np.geomspace(min(MIN_PERIODS_PER_WINDOW * rate / window, top / 2.0), top, BANDS + 1).tolist()),
        floors=(
            SILENT_BAND_SHARE * powers[0] + np.finfo(float).tiny,
            SILENT_BAND_SHARE * powers[1] + np.finfo(float).tiny,
        ),
    )


def _speed(recording: Recording) -> FloatArray:
    """Return the speed of the reference, but for jumps at restarts."""
    steps = np.diff(recording.r) * recording.sample_rate
    steps = np.where(recording.restart[1:], 0.0, steps)
    size = max(1, round(SPEED_TIME * recording.sample_rate))
    return np.convolve(steps, np.full(size, 1.0 / size), mode="same")


def _period(recordings: Sequence[Recording]) -> int:
    """Return the period of the reference that all recordings share [samples]; 0 where there is none."""
    periods = {_period_of(recording) for recording in recordings}
    return periods.pop() if len(periods) == 1 else 0


def _period_of(recording: Recording) -> int:
    """Return after how many samples the reference repeats, from segment to segment or within one."""
    cuts = np.append(np.flatnonzero(recording.restart), recording.samples)
    if not recording.restart[0]:
        cuts = np.insert(cuts, 0, 0)
    lengths = np.diff(cuts)
    r = recording.r
    if len(lengths) > 1 and len(set(lengths.tolist())) == 1:
        segments = r.reshape(len(lengths), -1)
        if float(segments.var(axis=0).mean()) <= REPEATS * float(r.var()):
            return int(lengths[0])
    if len(lengths) > 1:
        return 0
    return reference_period(recording.rows(slice(0, MAX_PERIOD_SEARCH_SAMPLES)), 0.5 * REPEATS) or 0


FEATURES = EvidenceKind("features", lambda healthy, _: learn_features(healthy.loop, healthy.recordings), _judge)
