"""What a diagnosis said of a recording whose truth is known, as plain numbers."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

import numpy as np

import servoscope as ss
from accuracy.rig import FAULT_AT
from accuracy.scenario import Numbers, Row
from servoscope.diagnosis.diagnose import MIN_CERTAINTY
from servoscope.diagnosis.ml_refit import refit_candidates, refit_onset, refit_recording
from servoscope.diagnosis.recording_alarm import first_alarm
from servoscope.evidence.examination import Examination
from servoscope.isolation.candidate import UNKNOWN, Candidate
from servoscope.isolation.ml import find_other_causes
from servoscope.research.paper.conditions import FAULT_NAMES
from servoscope.scoring import share
from servoscope.simulation import FaultEvent

LISTED = 6  # candidates that are kept


def told(learned: ss.Baseline, recording: ss.Recording, truth: Sequence[FaultEvent], mimics: bool = False) -> Numbers:
    """Judge a recording as `diagnose` does, and keep what can be scored; `mimics` takes longer."""
    numbers: Numbers = {"truth": {FAULT_NAMES[event.parameter]: event.ratio for event in truth}}
    x = Examination.from_recording(learned, recording)
    alarm = first_alarm(x)
    if alarm is None:
        return numbers
    begin = time.process_time()
    refined = refit_recording(x, alarm.onset, alarm.sample, int(x.estimates.index[alarm.evaluation]), lambda: None)
    seconds = time.process_time() - begin
    assert refined is not None, "the exact predictor explains the rig's healthy recordings"
    candidates, onset = refit_candidates(refined), refit_onset(refined, x)
    best = candidates[0]
    right = next((c for c in candidates if {f.name for f in c.faults} == set(numbers["truth"])), None)
    numbers |= {
        "detected": round(float(recording.t[alarm.sample]), 3),
        "said": {each.name: round(each.probability, 6) for each in candidates[:LISTED]},
        "first": best.name,
        "named": best.name != UNKNOWN and best.probability >= MIN_CERTAINTY,
        "given": right.probability if right else 0.0,
        "sizes": {f.name: [_short(v) for v in (f.ratio, *f.interval)] for f in (right.faults if right else ())},
        "onset": [round(t, 3) for t in (onset.low_s, onset.likely_s, onset.high_s)],
        "misfit": [_short(v) for v in (refined.goodness.statistic, refined.goodness.limit, refined.noise_variance)],
        "seconds": round(seconds, 3),
    }
    if right is not None and right.covariance is not None:
        numbers["distance"] = _short(_distance(right, numbers["truth"]))
    if mimics:
        numbers["mimics"] = {cause.name: _short(cause.value) for cause in find_other_causes(refined)}
    return numbers


def seen(found: Sequence[Numbers]) -> list[Numbers]:
    """Return the runs of all units whose fault was detected, and not before it was there."""
    return [run for unit in found for run in unit["runs"] if run.get("detected", 0.0) >= FAULT_AT]


def is_right(run: Numbers) -> bool:
    """Return whether the most probable candidate is the truth."""
    return run["first"] != UNKNOWN and sorted(run["first"].split(" + ")) == sorted(run["truth"])


def is_named(run: Numbers) -> bool:
    """Return whether the truth was named, and not just the most probable."""
    return bool(run["named"]) and is_right(run)


def percent(inside: int, total: int, low: float = 0.0, high: float = 1.0) -> str:
    """Show a share with Wilson's interval, bold outside of a target."""
    if not total:
        return ""
    found = share(inside, total)
    mark = "" if low <= found.value <= high else "**"
    return f"{mark}{100 * found.value:.1f}{mark} ({100 * found.low:.1f}, {100 * found.high:.1f})"


def _distance(candidate: Candidate, truth: dict[str, float]) -> float:
    """Return the squared Mahalanobis distance of the logarithms of the ratios from the truth."""
    off = np.array([math.log(fault.ratio / truth[fault.name]) for fault in candidate.faults])
    return float(off @ np.linalg.solve(np.array(candidate.covariance), off))


def _short(value: float) -> float:
    return float(f"{value:.6g}")


def baseline_rows(words: str, found: Sequence[Numbers], target: float) -> list[Row]:
    """Show, over several baselines, what was detected and named, and how often the intervals hold."""
    total, runs = sum(unit["of"] for unit in found), seen(found)
    good = [run for run in runs if is_right(run)]
    missed = [_missed(run) for unit in found for run in unit["runs"] if run not in runs or not is_named(run)]
    held = sum(low <= run["truth"][name] <= high for run in good for name, (_, low, high) in run["sizes"].items())
    return [
        (
            words,
            f"{len(found)}, {total}",
            f"{sum(bool(unit['runs']) for unit in found)}",
            f"{sum(unit['sequential'] for unit in found)}",
            percent(len(runs), total),
            percent(sum(map(is_named, runs)), total, low=target),
            "; ".join(missed),
            percent(held, len(good), low=0.92, high=0.98),
        )
    ]


def _missed(run: Numbers) -> str:
    """Return what a fault that was not named was, and what was said instead."""
    truth = " + ".join(f"{name} x {ratio:.4g}" for name, ratio in run["truth"].items())
    if "first" not in run:
        return f"{truth}: no alarm"
    return f"{truth}: {run['first']} {100 * run['said'][run['first']]:.0f} %"
