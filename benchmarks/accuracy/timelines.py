"""Several changes in one recording: whether every interval is named, and the change times are held."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

import servoscope as ss
from accuracy.draws import PARAMETERS, SECONDS, clear, faults, large, radius, stable
from accuracy.rig import baseline, record
from accuracy.scenario import Numbers, Row, Scenario, Table
from accuracy.told import percent
from servoscope.simulation import FaultEvent

KINDS = ("profile", "multisine", "trapezoid")
COURSES = {
    "steps": "two steps of one fault",
    "intermittent": "a fault that comes and goes, twice",
    "healed": "a fault that heals",
    "next": "one fault after another: the first heals, or stays beside the second",
}
RUNS = 5  # per baseline
UNITS = 10
APART = 6.0, 14.0  # s between two changes
BEGIN = 10.0, 16.0  # s
LEAST = 3.0  # radii of a fault, and of a further step
COVERED = 0.92, 0.98

Course = list[tuple[float, dict[str, float]]]
"""When the plant changed, and its ratios from then on; none where it is healthy."""


def job(seed: int, course: str, runs: int = RUNS) -> Numbers:
    """Diagnose recordings of one course after one baseline."""
    kind, rng = KINDS[seed % len(KINDS)], np.random.default_rng([seed, list(COURSES).index(course)])
    learned, said = baseline(kind, SECONDS, seed), []
    for i in range(runs):
        truth = drawn(rng, kind, course)
        said.append(judged(learned, record(kind, SECONDS, seed, 1 + i, events(truth)), truth) | {"kind": kind})
    return {"runs": said}


def drawn(rng: np.random.Generator, kind: str, course: str) -> Course:
    """Draw a course under which the loop stays stable."""
    while True:
        parameter, other = (PARAMETERS[i] for i in rng.permutation(len(PARAMETERS))[:2])
        first, second = ({name: visible(rng, kind, name)} for name in (parameter, other))
        more = {parameter: float(first[parameter] ** rng.uniform(1.4, 2.0))}
        states = {
            "steps": (first, more),
            "intermittent": (first, {}, first, {}),
            "healed": (first, {}),
            "next": (first, second if rng.integers(2) else first | second),
        }[course]
        times = np.cumsum([rng.uniform(*BEGIN), *rng.uniform(*APART, len(states) - 1)])
        found = [(round(float(t), 2), state) for t, state in zip(times, states, strict=True)]
        low, high = faults()[parameter].ratio_range
        inside = low < more[parameter] < high
        if stable(events(found)) and inside and worth(kind, parameter, more[parameter] / first[parameter]):
            return found


def visible(rng: np.random.Generator, kind: str, parameter: str) -> float:
    """Draw a ratio that is seen and told from others."""
    while True:
        ratio = large(rng, parameter)[parameter]
        if worth(kind, parameter, ratio) and clear(kind, parameter, ratio):
            return ratio


def worth(kind: str, parameter: str, ratio: float) -> bool:
    """Return whether a change is large enough to be asked for in a few seconds."""
    return abs(float(np.log(ratio))) >= LEAST * radius(kind, parameter, ratio > 1.0)


def events(course: Course) -> tuple[FaultEvent, ...]:
    """Return a course as the simulation wants it."""
    found, before = [], dict[str, float]()
    for t, ratios in course:
        found += [
            FaultEvent(name, ratios.get(name, 1.0), t)
            for name in sorted({*before, *ratios})
            if ratios.get(name, 1.0) != before.get(name, 1.0)
        ]
        before = ratios
    return tuple(found)


def judged(learned: ss.Baseline, recording: ss.Recording, truth: Course) -> Numbers:
    """Compare what is said with the truth."""
    names = {fault.name: fault.parameter for fault in faults().values()}
    told = ss.diagnose(learned, recording)
    changes, spans, wrong = [], list[tuple[float, float, set[str]]](), False
    for one in told.intervals:
        said = {names[fault.name] for fault in one.faults}
        end = np.inf if one.end_s is None else one.end_s
        spans.append((one.onset_s[1], end, said))
        middle = 0.5 * (one.onset_s[1] + min(end, recording.duration_s))
        there = next((set(ratios) for t, ratios in reversed(truth) if t <= middle), set())
        wrong |= bool(said) and said != there
        changes += [one.onset_s] + ([one.end_interval_s] if one.end_interval_s else [])
    true = [
        (t, end, set(ratios))
        for (t, ratios), end in zip(truth, [*(t for t, _ in truth[1:]), np.inf], strict=True)
        if ratios
    ]
    named = len(spans) == len(true) and all(a[2] == b[2] for a, b in zip(spans, true, strict=True))
    dates = sorted({tuple(round(t, 3) for t in change) for change in changes})
    return {
        "truth": [[t, ratios] for t, ratios in truth],
        "said": [[a, None if np.isinf(b) else b, sorted(c)] for a, b, c in spans],
        "named": named,
        "wrong": bool(wrong),
        "over": (told.intervals[-1].end_s is not None) == (not truth[-1][1]) if told.intervals else False,
        "changes": [
            [*min(dates, key=lambda date: abs(date[1] - t)), t] for t, _ in truth if named and dates
        ],
    }  # fmt: skip


def rows(words: str, found: Sequence[Numbers]) -> list[Row]:
    """Show what was named, what was wrong, and coverage and error of the times."""
    runs = [run for unit in found for run in unit["runs"]]
    low, likely, high, true = np.array([change for run in runs for change in run["changes"]] or np.zeros((0, 4))).T
    # a time is told to the hundredth of a second here, as a sample is
    inside = int(((low <= true + 0.005) & (true - 0.005 <= high)).sum())
    return [
        (
            words,
            f"{len(runs)}",
            percent(sum(run["named"] for run in runs), len(runs), 0.9, 1.0),
            f"{sum(run['wrong'] for run in runs)}",
            percent(sum(run["over"] for run in runs), len(runs), 0.9, 1.0),
            percent(inside, len(true), *COVERED) if len(true) else "-",
            f"{np.median(np.abs(likely - true)):.2f}, {np.quantile(np.abs(likely - true), 0.9):.2f}"
            if len(true)
            else "-",
        )
    ]


TABLES = (
    Table(
        "timelines",
        (
            *("course", "runs", "every interval named (90)", "runs with a wrong name"),
            *("whether it is over (90)", "change times in the interval (92 to 98)", "their error: median, 90 % [s]"),
        ),
        tuple(Scenario(f"timelines/{key}", words, UNITS, job, (key,), rows) for key, words in COURSES.items()),
    ),
)
