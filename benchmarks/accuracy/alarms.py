"""Do false alarms keep to the budget? Healthy hours after short and long baselines, and what the budget costs."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

import servoscope as ss
from accuracy.innovations import innovations
from accuracy.rig import FAULT_AT, HOURS_PER_YEAR, alarm_times, baseline, loop, record, until_first
from accuracy.scenario import Numbers, Row, Scenario, Table
from servoscope.core.arrays import FloatArray
from servoscope.scoring import (
    DUMMIES,
    Detections,
    Detector,
    alarm_rate,
    cusum,
    detections,
    events,
    siegmund,
    two_sided,
)
from servoscope.simulation import FaultEvent

BUDGETS = (1.0, 0.1)  # false alarms per hour
HOURS = 2  # per baseline
MINUTES = (1, 3, 10)  # of the baselines
LEAKAGE = FaultEvent("C_ie", 1.2, FAULT_AT)
AFTER = 120.0  # s that a leakage is watched


@functools.cache
def decision_interval(per_hour: float) -> float:
    """Return the h of a two-sided CUSUM with k = 0.5 that keeps a budget of false alarms."""
    from scipy.optimize import brentq

    samples = 3600.0 * loop().sample_rate / per_hour
    return float(brentq(lambda h: two_sided(lambda s: siegmund(s, h=h), 0.0) / samples - 1.0, 1.0, 50.0))


def detectors() -> dict[str, Detector]:
    """Return the dummies by name, and the CUSUMs that know the budgets."""
    fitted = {f"CUSUM {budget:g}": functools.partial(cusum, h=decision_interval(budget)) for budget in BUDGETS}
    return {**DUMMIES, **fitted}


def raised(seed: int, kind: str, minutes: int, recordings: Iterable[ss.Recording]) -> Iterator[dict[str, FloatArray]]:
    """Yield when each detector raises an alarm in a recording [s]; servoscope stands there under its budgets.

    The dummies watch the standardised innovations of the plant and the noise that were learned.
    """
    same = baseline(kind, 60.0 * minutes, seed, per_year=BUDGETS[0] * HOURS_PER_YEAR)
    learned = {f"{budget:g}": same.shared(round(BUDGETS[0] / budget)) for budget in BUDGETS}
    assert same.healthy.noise is not None, "the rig has a controller and physics"
    for recording in recordings:
        e = innovations(recording, same.plant, same.healthy.noise)
        found = {budget: alarm_times(each, recording) for budget, each in learned.items()}
        yield found | {name: recording.t[events(detector(e))] for name, detector in detectors().items()}


def count(seed: int, kind: str, minutes: int) -> Numbers:
    """Return the number of alarms of each detector in a few healthy hours after one baseline."""
    total: Counter[str] = Counter()
    for found in raised(seed, kind, minutes, (record(kind, 3600.0, seed, 1 + hour) for hour in range(HOURS))):
        total.update({name: len(times) for name, times in found.items()})
    return dict(total)


def detect(seed: int, kind: str, minutes: int) -> Numbers:
    """Return when each detector raised an alarm in a recording with a leakage [s]."""
    (found,) = raised(seed, kind, minutes, [record(kind, FAULT_AT + AFTER, seed, 1, (LEAKAGE,))])
    return {name: until_first(times) for name, times in found.items()}


def rates(words: str, found: Sequence[Numbers]) -> list[Row]:
    """Show alarms per hour against each budget."""
    hours = HOURS * len(found)
    rows = []
    for budget in BUDGETS:
        counts = np.array([each[f"{budget:g}"] for each in found])
        told = alarm_rate(int(counts.sum()), hours)
        mark = "" if told.low <= budget else "**"
        worst = f"{counts.max() / HOURS:g}, {np.mean(counts == 0):.0%}"
        others = [sum(each[name] for each in found) / hours for name in (f"CUSUM {budget:g}", *DUMMIES)]
        cells = (f"{mark}{told.value:.3g}{mark} ({told.low:.2g}, {told.high:.2g})", worst)
        rows.append((words, f"{budget:g}", f"{hours}", *cells, *(f"{rate:.3g}" for rate in others)))
    return rows


def delays(words: str, found: Sequence[Numbers]) -> list[Row]:
    """Show delays of a leakage under each budget."""
    rows = []
    for budget in BUDGETS:
        names = (f"{budget:g}", f"CUSUM {budget:g}", "CUSUM")
        scored = [detections([each[name] for each in found], FAULT_AT, within=AFTER) for name in names]
        rows.append((words, f"{budget:g}", f"{len(found)}", *(cell for each in scored for cell in _cells(each))))
    return rows


def _cells(scored: Detections) -> Row:
    early = f"{int((scored.false_alarms > 0).sum())}"
    return f"{scored.median:.2f}, {scored.quantile(0.9):.2f}", f"{scored.missed.value:.0%}, {early}"


def _scenarios(prefix: str, units: int, job: Callable[..., Numbers], rows: Callable[..., list[Row]]) -> list[Scenario]:
    return [
        Scenario(f"alarms/{prefix}{kind}-{60 * minutes}s", f"{kind}, {minutes} min", units, job, (kind, minutes), rows)
        for kind in ("multisine", "profile")
        for minutes in MINUTES
    ]


TABLES = (
    Table(
        "alarms",
        ("baseline", "budget", "hours", "alarms", "worst, none", "CUSUM for the budget", "always", "never", "CUSUM"),
        tuple(_scenarios("", 84, count, rates)),
    ),
    Table(
        "leakage",
        (
            *("baseline", "budget", "runs", "median, 90 % [s]", "missed, early"),
            *("CUSUM for the budget [s]", "missed, early", "CUSUM [s]", "missed, early"),
        ),
        tuple(_scenarios("leakage-", 20, detect, delays)),
    ),
)
