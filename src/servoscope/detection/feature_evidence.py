"""What a recording shows besides its coefficients, against healthy recordings: how unlike them it is, and where."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from servoscope.baseline.feature_model import FeatureModel, FeatureName, GroupStatistic
from servoscope.core import outofcore
from servoscope.core.arrays import FloatArray, IntArray
from servoscope.core.messages import Message, message
from servoscope.detection.feature_monitor import FeatureMonitor, SpanScore, hold, smallest_in_a_row
from servoscope.signals import Recording

MAX_FEATURES_NAMED = 3  # features that are named
MIN_STD = 2.0  # standard deviations from which a feature is named, the most changed one apart


@dataclass(frozen=True, eq=False)
class FeatureEvidence:
    """The spans of one recording, scored.

    A recording of a few spans is one draw from the healthy population: all its spans together decide. In a longer one
    as many in a row must be above the limit as in a running monitor.
    """

    model: FeatureModel
    spans: tuple[SpanScore, ...]  # those whose motion healthy recordings show too
    unfamiliar: int  # the number of the others

    @classmethod
    def of(cls, model: FeatureModel, recording: Recording) -> FeatureEvidence:
        """Score the spans of a recording; the last one counts if it is at least half as long as the others."""
        monitor, spans = FeatureMonitor(model), list[SpanScore]()
        state = monitor.start()
        for rows in outofcore.iter_chunks(0, recording.samples):
            part = recording.rows(rows)
            spans += monitor.run(state, part.r, part.u, part.y, part.restart, part.channels)
        if (last := monitor.unfinished(state, recording.samples)) is not None:
            spans.append(last)
        known = tuple(span for span in spans if np.isfinite(span.ratio))
        return cls(model, known, len(spans) - len(known))

    @cached_property
    def values(self) -> FloatArray:
        """For each span, the smallest of the scores that must be above the limit together, shape (J,)."""
        ratios = np.array([span.ratio for span in self.spans])
        return smallest_in_a_row(ratios, min(self.model.in_a_row, max(len(self.spans), 1)))

    def at(self, samples: IntArray) -> FloatArray:
        """Return the value that holds at some samples; that of the last span holds at the last of them at least."""
        ends = np.array([span.end for span in self.spans], dtype=np.int64) - 1
        if len(samples):
            ends = np.minimum(ends, samples[-1])
        return hold(self.values, ends, samples)

    @property
    def changed(self) -> SpanScore | None:
        """The span with which the recording was found to have changed; None where it has not."""
        above = np.flatnonzero(self.values > 1.0)
        return self.spans[int(above[0])] if above.size else None

    def headline(self, span: SpanScore, point: str = "") -> Message:
        """Return the verdict in one sentence, of a recording whose coefficients are healthy."""
        at = message("diagnosis.point", name=point) if point else None
        return message("diagnosis.changed", point=at, change=self._changes(span)[0])

    def reasons(self, span: SpanScore, alone: bool) -> tuple[Message, ...]:
        """Say what differs in a span and, if no coefficient has changed, what usually does that."""
        hints = self._hints(span) if alone else ()
        return message("diagnosis.features", changes=self._changes(span)), *hints

    def _hints(self, span: SpanScore) -> tuple[Message, ...]:
        """Say what usually does that: by the signals whose bands have grown, or by means that have moved alone."""
        ratios = zip(self.model.statistics, self.model.ratios(span.features), strict=True)
        moved = [
            (name, off)
            for statistic, ratio in ratios
            if ratio > 1.0
            for name, _, _, off in self._compare(statistic, span)
            if abs(off) >= MIN_STD
        ]
        grown = {name.signal for name, off in moved if name.band_hz is not None and off > 0.0}
        kind = {("u",): "u", ("e", "u"): "both"}.get(tuple(sorted(grown)))
        if moved and all(name.band_hz is None for name, _ in moved):
            kind = "mean"
        return () if kind is None else (message(f"diagnosis.hint_{kind}"),)

    def _changes(self, span: SpanScore) -> tuple[Message, ...]:
        """Say which features differ, the most changed first: of which signal, in which motion and band."""
        statistic = self.model.statistics[int(np.argmax(self.model.ratios(span.features)))]
        first, *others = sorted(self._compare(statistic, span), key=lambda row: -abs(row[3]))[:MAX_FEATURES_NAMED]
        return tuple(_describe(*row[:3]) for row in (first, *(row for row in others if abs(row[3]) >= MIN_STD)))

    def _compare(self, statistic: GroupStatistic, span: SpanScore) -> list[tuple[FeatureName, float, float, float]]:
        """Return the features of a group: name, value, what is healthy, by how many standard deviations they differ."""
        (values, _), covariates = statistic.group.pick(span.features), span.features.covariates
        off, healthy = np.nan_to_num(statistic.deviations(values, covariates)), statistic.expected(covariates)
        if statistic.group.past:  # described by the later windows against the earlier ones
            later = span.features.values[statistic.group.level, list(statistic.group.kept)]
            values, healthy = later, later - values + healthy
        names = [FeatureName.of(self.model.layout, feature) for feature in statistic.group.kept]
        return list(zip(names, values.tolist(), healthy.tolist(), off.tolist(), strict=True))


def _describe(name: FeatureName, value: float, healthy: float) -> Message:
    signal, motion = message(f"diagnosis.feature_{name.signal}"), message(f"diagnosis.motion_{name.motion}")
    if name.band_hz is not None:
        low, high = name.band_hz
        values = {"signal": signal, "motion": motion, "low_hz": low, "high_hz": high}
        return message("diagnosis.feature_band", ratio=float(np.exp(value - healthy)), **values)
    from_s, to_s = name.since_s if name.since_s is not None else (0.0, np.inf)
    if from_s == 0.0 and np.isinf(to_s):
        when = None
    elif np.isinf(to_s):
        when = message("diagnosis.since_motion_late", from_s=from_s)
    else:
        when = message("diagnosis.since_motion", from_s=from_s, to_s=to_s)
    return message("diagnosis.feature_level", signal=signal, motion=motion, when=when, value=value, healthy=healthy)
