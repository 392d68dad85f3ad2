"""One log to a verdict: equidistant samples, gates, features, posterior, sizes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, PrivateAttr

from servoscope.assessment import indices
from servoscope.assessment.causes import CAUSES, MIN_SURE_PROBABILITY, Cause
from servoscope.assessment.features import Analysis, analyse
from servoscope.assessment.indices import octave_around
from servoscope.assessment.models import thin
from servoscope.assessment.posterior import load_posterior
from servoscope.assessment.tags import find_loops
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import RecordingError
from servoscope.core.messages import Message, MessageText, message
from servoscope.core.short_repr import ShortRepr
from servoscope.signals.readers.frames import Source, open_source
from servoscope.signals.readers.recording_file import read_rows
from servoscope.signals.samples import Samples

Verdict = Literal[Cause, "cannot tell"]
VERDICTS: tuple[Verdict, ...] = (*CAUSES, "cannot tell")
MIN_ROWS = 100
MAX_ROWS = 200_000  # that are analysed; of a longer log, means of neighbours are
MAX_MISSING_SHARE = 0.3
MAX_FILLED_GAP = 3  # samples that are interpolated; at a longer gap the log is cut
MIN_PROBABILITY = 0.5  # of a verdict
MIN_REFERENCE_SHARE = 0.5  # of an oscillation, from which on the reference causes it
MIN_SAMPLES_PER_PERIOD = 6.0
MIN_REGULARITY = 1.0  # of an oscillation, after Thornhill et al.
MAX_HARRIS_ROWS = 5000
CONSTANT_SHARE = 0.98  # of the samples, from which on a signal counts as constant
OSCILLATING: tuple[Verdict, ...] = ("stiction", "backlash", "too tight", "oscillation from outside")


@dataclass(frozen=True, eq=False)
class AssessedSignals:
    """What figures are drawn from: the samples that were analysed, shape (N,)."""

    t: FloatArray
    r: FloatArray | None
    u: FloatArray
    y: FloatArray
    analysis: Analysis | None


class Assessment(ShortRepr, BaseModel):
    """What is most likely wrong with a loop, from one log.

    Parameters
    ----------
    verdict, probability
        The likeliest cause and its probability, or "cannot tell".
    probabilities
        Of each cause; empty where there was too little to judge.
    reason, advice
        Why, and what to do about it.
    performance
        Harris index, 0 to 1: variance under minimum variance control over the actual one. A number, not a verdict.
    period_s, regularity, oscillation_share
        Of the strongest oscillation: period [s], regularity r (above 1: regular), share of the error's variance.
    stiction_percent, backlash_percent
        Apparent size [% of travel], where that is the verdict.
    gain_margin
        Of the loop as the log shows it; at most 100.
    indices
        The textbook indices and log-likelihoods per sample of competing models, by name.

    Examples
    --------
    >>> ss.assess("friday.csv").verdict
    'good'
    """

    model_config = ConfigDict(frozen=True)

    recording: str
    verdict: Verdict
    probability: float
    probabilities: dict[str, float]
    reason: MessageText
    advice: MessageText
    samples: int
    sample_rate_hz: float
    performance: float | None = None
    period_s: float | None = None
    regularity: float | None = None
    oscillation_share: float | None = None
    stiction_percent: float | None = None
    backlash_percent: float | None = None
    gain_margin: float | None = None
    indices: dict[str, float] = {}
    _signals: AssessedSignals | None = PrivateAttr(default=None)

    def _shown_facts(self) -> Mapping[str, object]:
        return {"recording": self.recording, "verdict": self.verdict, "probability": f"{self.probability:.2f}"}

    @property
    def signals(self) -> AssessedSignals | None:
        """What figures are drawn from; None when the assessment was read back from JSON."""
        return self._signals

    @property
    def sure_cause(self) -> Cause | None:
        """The cause, where it is nearly certain."""
        sure = self.verdict != "cannot tell" and self.probability >= MIN_SURE_PROBABILITY
        return self.verdict if sure else None  # type: ignore[return-value]  # all other verdicts are causes

    @property
    def oscillates(self) -> bool:
        """Whether there is a regular oscillation."""
        return self.regularity is not None and self.regularity > MIN_REGULARITY


def assess(log: Samples | Source, *, name: str | None = None, travel: tuple[float, float] | None = None) -> Assessment:
    """Say from one log what is most likely wrong with a loop; no baseline and no plant model are needed.

    Parameters
    ----------
    log
        Samples, a recording, or what `read` reads: a path, a frame, arrays by name, with columns t, u, y and, if it is
        known, r.
    name
        What the log is called in results.
    travel
        Lowest and highest value of u, for sizes in % of travel. None: 0 to 100, or 0 to 1, where u lies within; else
        the range of u in the log.

    Returns
    -------
    Assessment
        ``model_dump(mode="json")`` of it is one JSON object.

    Raises RecordingError if the log cannot be read.

    Examples
    --------
    >>> assess("monday.csv").probabilities["stiction"] < 0.5
    True
    """
    if not isinstance(log, Samples):
        loops = find_loops(open_source(log).columns)
        if len(loops) > 1:
            raise RecordingError(
                f"{name or log}: holds {len(loops)} loops ({', '.join(loops)}), assess them one by one"
            )
        (columns,) = loops.values()
        ((label, log),) = read_rows(log, columns).items()
        name = name or label
    name = name or str(getattr(log, "name", "log"))
    t, r, u, y, missing = equidistant(log, name)
    rate = (t.size - 1) / max(float(t[-1] - t[0]), 1e-300)
    facts: dict[str, object] = {"recording": name, "samples": len(log), "sample_rate_hz": rate}
    if missing > MAX_MISSING_SHARE:
        return _cannot_tell(facts, message("assess.missing", share=missing))
    if t.size < MIN_ROWS:
        return _cannot_tell(facts, message("assess.short", samples=t.size, least=MIN_ROWS))
    signals = AssessedSignals(t, r, u, y, None)
    for x, cause in ((y, "frozen sensor"), (u, "manual")):
        if np.mean(np.abs(x - np.median(x)) <= 1e-9 * max(float(np.abs(x).max()), 1e-300)) >= CONSTANT_SHARE:
            return _conclude(facts, {c: float(c == cause) for c in CAUSES}, signals, travel)
    factor = -(-t.size // MAX_ROWS)
    if factor > 1:
        t, u, y = (thin(x, factor) for x in (t, u, y))
        r = None if r is None else thin(r, factor)
        signals = AssessedSignals(t, r, u, y, None)
    analysis = analyse(r, u, y)
    signals = AssessedSignals(t, r, u, y, analysis)
    probabilities = load_posterior().of(analysis.features, rate)
    if r is not None and _follows_reference(analysis, r):
        probabilities |= dict.fromkeys(("oscillation from outside", "too tight"), 0.0)
        total = sum(probabilities.values())
        probabilities = {cause: p / total for cause, p in probabilities.items()}
    return _conclude(facts, probabilities, signals, travel)


def _follows_reference(analysis: Analysis, r: FloatArray) -> bool:
    """Return whether the reference explains the error's oscillation, by r, r' and sign(r') in the same octave."""
    if analysis.oscillation is None:
        return False
    speed = np.gradient(thin(r, analysis.thinned))
    moves = np.stack([thin(r, analysis.thinned), speed, np.sign(speed)])
    rows = np.stack([octave_around(x, analysis.oscillation.period) for x in moves], axis=1)
    error = analysis.oscillation.band
    left = error - rows @ np.linalg.lstsq(rows, error, rcond=None)[0]
    return bool(left @ left < (1.0 - MIN_REFERENCE_SHARE) * (error @ error))


def equidistant(log: Samples, name: str) -> tuple[FloatArray, FloatArray | None, FloatArray, FloatArray, float]:
    """Return t, r, u and y of the longest stretch without a long gap on an even grid, and the share that is missing."""
    r = None if np.array_equal(log.r, log.u, equal_nan=True) or np.isnan(log.r).all() else log.r
    valid = np.isfinite(log.t) & np.isfinite(log.u) & np.isfinite(log.y)
    if r is not None:
        valid &= np.isfinite(r)
    if valid.sum() < 2:
        raise RecordingError(f"{name}: u and y hold no numbers in the same rows, choose other columns")
    t = log.t[valid]
    steps = np.diff(t)
    forward = steps[steps > 0.0]
    if not forward.size:
        raise RecordingError(f"{name}: the time does not advance, choose another time column")
    period = float(np.median(forward))
    runs = np.cumsum(log.restart)[valid]  # another mode, for example
    breaks = np.flatnonzero((steps > (MAX_FILLED_GAP + 1.5) * period) | (steps <= 0.0) | (np.diff(runs) > 0)) + 1
    edges = np.r_[0, breaks, t.size]
    longest = int(np.argmax(np.diff(edges)))
    rows = slice(edges[longest], edges[longest + 1])
    even = np.arange(t[rows][0], t[rows][-1] + 0.5 * period, period)
    u, y, of_r = (np.interp(even, t[rows], x[valid][rows]) if x is not None else None for x in (log.u, log.y, r))
    assert u is not None and y is not None
    return even, of_r, u, y, 1.0 - float(valid.mean())


def _cannot_tell(facts: Mapping[str, object], reason: Message) -> Assessment:
    advice = message("assess.advice_cannot_tell")
    return Assessment.model_validate(
        {**facts, "verdict": "cannot tell", "probability": 0.0, "probabilities": {}, "reason": reason, "advice": advice}
    )


def _conclude(
    facts: Mapping[str, object],
    probabilities: Mapping[Cause, float],
    signals: AssessedSignals,
    travel: tuple[float, float] | None,
) -> Assessment:
    best = max(probabilities, key=lambda cause: probabilities[cause])
    verdict: Verdict = best
    measured: dict[str, object] = dict(facts)
    a = signals.analysis
    regular, reason = False, None
    if a is not None:
        measured |= _measure(a, signals)
        period = a.oscillation.period * a.thinned if a.oscillation else np.inf
        regular = a.oscillation is not None and a.oscillation.regularity > MIN_REGULARITY
        if regular and period < MIN_SAMPLES_PER_PERIOD and best in OSCILLATING:
            verdict, reason = "cannot tell", message("assess.slow", samples=period, least=MIN_SAMPLES_PER_PERIOD)
        size = _travel_percent(signals.u, travel)
        if verdict == "stiction":
            measured["stiction_percent"] = size * max(a.evidence.stick.size, a.evidence.dead_band.size)
        if verdict == "backlash":
            measured["backlash_percent"] = size * a.evidence.dead_band.size
    if verdict != "cannot tell" and probabilities[best] < MIN_PROBABILITY:
        second = sorted(probabilities, key=lambda cause: probabilities[cause])[-2]
        verdict, reason = "cannot tell", message("assess.close", first=best, second=second)
    key = verdict.replace(" ", "_")
    if reason is None:
        cycle = {"period": measured.get("period_s"), "share": measured.get("oscillation_share")}
        words = message("assess.cycle", **cycle) if a is not None and regular else None
        values = {name: measured.get(name) for name in ("stiction_percent", "backlash_percent", "gain_margin")}
        reason = message(f"assess.reason_{key}", cycle=words, **values)
    result = Assessment.model_validate(
        {
            **measured,
            "verdict": verdict,
            "probability": probabilities[best],
            "probabilities": probabilities,
            "reason": reason,
            "advice": message(f"assess.advice_{key}"),
        }
    )
    result._signals = signals
    return result


def _measure(a: Analysis, signals: AssessedSignals) -> dict[str, object]:
    """Return oscillation, margin, Harris index and textbook indices."""
    e = (signals.r if signals.r is not None else signals.y.mean()) - signals.y
    f = a.features
    harris = indices.harris_index(e[-MAX_HARRIS_ROWS:], a.linear.delay * a.thinned + 1)
    measured: dict[str, object] = {
        "gain_margin": a.margins.gain,
        "performance": harris if np.isfinite(harris) else None,
        "indices": {
            "half-cycle shape of u": f["u triangle"],
            "half-cycle shape of y": f["y triangle"],
            "odd cross-correlation": f["odd"],
            "ellipse width over range of u": f["width"],
            "stick-slip above linear": a.evidence.gain(a.evidence.stick, 2) / a.evidence.samples,
            "dead band above linear": a.evidence.gain(a.evidence.dead_band, 1) / a.evidence.samples,
            "clip above linear": a.evidence.gain(a.evidence.clip, 1) / a.evidence.samples,
            "sinusoid above linear": a.evidence.gain(a.evidence.outside, 2) / a.evidence.samples,
        },
    }
    if a.oscillation is not None:
        step = float(signals.t[-1] - signals.t[0]) / (signals.t.size - 1)
        measured |= {
            "period_s": a.oscillation.period * a.thinned * step,
            "regularity": min(a.oscillation.regularity, 100.0),
            "oscillation_share": a.oscillation.share,
        }
    return measured


def _travel_percent(u: FloatArray, travel: tuple[float, float] | None) -> float:
    """Return what one unit of u is in % of travel."""
    if travel is None:
        low, high = float(u.min()), float(u.max())
        travel = next(
            (scale for scale in ((0.0, 1.0), (0.0, 100.0)) if scale[0] <= low and high <= scale[1]), (low, high)
        )
    return 100.0 / max(travel[1] - travel[0], 1e-300)
