"""The refit's answer in the words of a diagnosis, and whether it agrees with the recursion's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servoscope import digits
from servoscope.detection import Onset
from servoscope.diagnosis import UNKNOWN, Candidate, FoundFault, Mimic, Refit, Warning
from servoscope.examination import Examination

if TYPE_CHECKING:  # its kernels are loaded after an alarm, not before
    from servoscope.refinement import Hypothesis, Refined

WORTH_LISTING = 1e-3  # probability from which a pair of faults is listed
APART = 3.0  # standard deviations between two sizes that are called different


def refit(x: Examination, since: Onset, announced: int, last: int, progress: Callable[[], None]) -> Refined | None:
    """Refit the seconds around an onset; None where the exact predictor does not explain even healthy recordings."""
    exact = x.baseline.exact
    if exact is None or exact.misfit > 1.0:
        return None
    from servoscope.refinement import MOST, refine

    begin = max(since.sample - MOST, 0)
    near = x.recording.rows(slice(begin, since.sample + MOST))
    found = refine(x.baseline, near, since.sample - begin, announced - begin, last - begin, progress)
    return replace(found, window=replace(found.window, first=found.window.first + begin))


def candidates_of(refined: Refined) -> tuple[Candidate, ...]:
    """Return every single fault, the pairs that are worth it, and ``unknown``, the most probable first."""
    least = min(each.fitted.J for each in refined.hypotheses)
    told = [
        _candidate(each, least, refined.louder)
        for each in refined.hypotheses
        if len(each.fitted.faults) == 1 or each.probability >= WORTH_LISTING
    ]
    told.append(Candidate(name=UNKNOWN, probability=refined.unknown))
    # where probabilities vanish, the closest comes first
    return tuple(sorted(told, key=lambda candidate: (-candidate.probability, candidate.misfit or 0.0)))


def onset_of(refined: Refined, x: Examination) -> Onset:
    """Return since when, in the recording's time."""
    t, first, since = x.recording.t, refined.window.first, refined.since
    last = len(t) - 1
    low, likely, high = (min(first + k, last) for k in (since.low, since.growth.since, since.high))
    # the first changed sample ends the interval in which the change came
    return Onset(float(t[max(low - 1, 0)]), float(t[likely]), float(t[high]), likely)


def said(refined: Refined, x: Examination, recursive: tuple[Candidate, ...]) -> Refit:
    """Return what a diagnosis keeps of a refit."""
    from servoscope.refinement import causes

    t, window = x.recording.t, refined.window
    over = refined.since.growth.over
    of_y, of_u = x.baseline.plant.units
    units = {"of y": of_y or "in units of y", "of u": of_u or "in units of u"}
    return Refit(
        from_s=float(t[window.first]),
        to_s=float(t[window.first + window.samples - 1]),
        over_s=over / x.recording.sample_rate if over > refined.since.high - refined.since.low else 0.0,
        noise=float(np.sqrt(refined.louder)),
        misfit=refined.goodness.statistic,
        limit=refined.goodness.limit,
        recursive=recursive,
        mimics=tuple(
            Mimic(name=cause.name, words=cause.words, value=cause.value, unit=units.get(cause.unit, cause.unit))
            for cause in causes(refined)
        ),
    )


def disagreements(x: Examination, candidates: tuple[Candidate, ...], told: Refit, sure: float) -> list[Warning]:
    """Return a warning where the refit and the recursion contradict each other, both with probability `sure`."""
    one, other, t = candidates[0], told.recursive[0], x.recording.t
    message = ""
    if min(one.probability, other.probability) < sure or (len(one.faults) > 1 and other.name == UNKNOWN):
        return []  # the recursion knows no pairs
    if one.name != other.name:
        message = f"the refit says {one.name}, the recursion's last estimate {other.name}"
    else:
        for a, b in zip(one.faults, other.faults, strict=True):
            if apart(a, b) > APART:
                message = (
                    f"{a.parameter} is {digits.ratios(a.ratio, *a.interval)[0]} times its healthy value by the refit, "
                    f"{digits.ratios(b.ratio, *b.interval)[0]} by the recursion's last estimate"
                )
    if not message:
        return []
    why = "the refit weighs every second since the onset, the recursion the last ones: look whether the change went on"
    if len(one.faults) > 1:
        why = "the recursion compares single faults only"
    elif told.over_s > 0.0:
        why = f"the change grew over {told.over_s:.3g} s, which the recursion follows late"
    return [Warning(kind="disagreement", from_s=float(t[0]), to_s=float(t[-1]), count=1, message=f"{message}; {why}")]


def apart(a: FoundFault, b: FoundFault) -> float:
    """Return how many standard deviations the logarithms of two sizes are apart, as if they shared no data."""
    spread = float(np.hypot(*(np.log(fault.interval[1] / fault.interval[0]) / 3.92 for fault in (a, b))))
    return abs(float(np.log(a.ratio / b.ratio))) / max(spread, 1e-12)


def _candidate(each: Hypothesis, least: float, louder: float) -> Candidate:
    fitted = each.fitted
    ratios, intervals = np.exp(fitted.x), np.exp(np.array(each.evidence.intervals))
    faults = tuple(
        FoundFault(name=fault.name, parameter=fault.parameter, ratio=float(ratio), interval=(float(low), float(high)))
        for fault, ratio, (low, high) in zip(fitted.faults, ratios, intervals, strict=True)
    )
    covariance = tuple(tuple(row) for row in (louder * fitted.covariance).tolist()) if len(faults) > 1 else None
    return Candidate(
        name=each.name,
        probability=each.probability,
        faults=faults,
        misfit=max(fitted.J - least, 0.0) / louder,
        covariance=covariance,
    )
