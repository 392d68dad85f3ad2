"""Which fault, and how sure: random single faults, small and large, against what was true."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from accuracy.draws import KINDS, PARAMETERS, SECONDS, clear, designed, large, radius, small
from accuracy.rig import FAULT_AT, baseline, record
from accuracy.scenario import Numbers, Row, Scenario, Table
from accuracy.told import is_named, is_right, percent, seen, told
from servoscope.design import DirectionStudy
from servoscope.isolation.candidate import UNKNOWN
from servoscope.scoring import Reliability, reliability, share
from servoscope.simulation import FaultEvent

RUNS = 20  # per baseline, half of them with small faults
UNITS = {"profile": 33, "multisine": 34, "trapezoid": 33}
EDGES = (0.0, 0.7, 1.0, 1.4, 2.0, 4.0, np.inf)  # radii between which small faults are counted together
MIDDLING = 0.6, 0.95  # accuracy between which the reliability matters
BINS = 5  # few cases are left there
LEAST = 1e-6  # probability that the log score takes for none
ERROR = 0.05
DRAWS = 1000
TIMES = 2.0  # the linear bound, that an isolability radius may be


def job(seed: int, kind: str, runs: int = RUNS) -> Numbers:
    """Diagnose faults of all kinds after one baseline."""
    learned, rng = baseline(kind, SECONDS, seed), np.random.default_rng(seed)
    said = []
    for i in range(runs):
        parameter = PARAMETERS[int(rng.integers(len(PARAMETERS)))]
        ratio = small(rng, kind, parameter) if i % 2 else large(rng, parameter)[parameter]
        fault = FaultEvent(parameter, ratio, FAULT_AT)
        run = told(learned, record(kind, SECONDS, seed, 1 + i, (fault,)), [fault])
        size = abs(float(np.log(ratio))) / radius(kind, parameter, ratio > 1.0)
        place = {"radii": float(f"{size:.4g}"), "small": bool(i % 2), "clear": clear(kind, parameter, ratio)}
        said.append(run | place)
    return {"runs": said, "design": radii(kind)}


def radii(kind: str) -> Numbers:
    """Return what the study says of each fault and direction: detectable and isolable ratio, radius over bound."""
    return {
        f"{name} {'up' if up else 'down'}": [side.detectable, side.first_isolable, times_bound(side)]
        for name, fault in designed(kind).faults.items()
        for up, side in ((True, fault.up), (False, fault.down))
    }


def times_bound(side: DirectionStudy) -> float | None:
    """Return the smallest ratio that is named rightly against the linear bound, as logarithms; None without either."""
    if side.first_isolable is None or side.bound in (None, 1.0):
        return None
    return float(np.log(side.first_isolable) / np.log(side.bound))


def isolability(words: str, found: Sequence[Numbers]) -> list[Row]:
    """Show the radii that the study computes, and how many of the runs outside and inside were right."""
    rows = []
    runs = seen(found)
    for fault, (detectable, isolable, times) in found[0]["design"].items():
        own = [run for run in runs if _label(run) == fault]
        outside, inside = ([run for run in own if run["clear"] is wanted] for wanted in (True, False))
        mark = "" if times is not None and times <= TIMES else "**"
        rows.append(
            (
                *(words, fault, _ratio(detectable), _ratio(isolable)),
                f"{mark}{times:.2f}{mark}" if times is not None else "**none**",
                *(f"{sum(map(is_right, group))} of {len(group)}" for group in (outside, inside)),
            )
        )
    return rows


def _label(run: Numbers) -> str:
    ((name, ratio),) = run["truth"].items()
    return f"{name} {'up' if ratio > 1.0 else 'down'}"


def _ratio(value: float | None) -> str:
    return "nowhere" if value is None else f"{value:.4g}"


def scores(words: str, found: Sequence[Numbers]) -> list[Row]:
    """Show what was right, and how right the probabilities are."""
    everything, runs = [run for unit in found for run in unit["runs"]], seen(found)
    if not runs:
        return [(words, f"{len(everything)}", "0", *[""] * 7)]
    outside = [run for run in runs if run["clear"]]
    inside = [run for run in runs if not run["clear"]]
    named = [run for run in runs if run["named"]]
    truths = Counter(next(iter(run["truth"])) for run in runs)
    dummy = truths.most_common(1)[0][1]
    unsure = middling(runs)
    curve = curve_of(unsure)
    return [
        (
            words,
            f"{len(everything)}",
            f"{len(runs)}",
            percent(sum(map(is_right, outside)), len(outside), low=0.99),
            percent(sum(map(is_right, inside)), len(inside)),
            percent(sum(is_named(run) for run in named), len(named), low=0.95),
            f"{_log_score(runs):.3f}",
            percent(sum(run["first"] == UNKNOWN for run in runs), len(runs), high=0.02),
            f"{len(unsure)}" if unsure else "0",
            _calibration(curve, unsure),
            f"{100 * dummy / len(runs):.1f}, {-np.log(dummy / len(runs)):.2f}",
        )
    ]


def by_size(words: str, found: Sequence[Numbers]) -> list[Row]:
    """Show detections and names over the size, in radii; what is in the ranges of Table 2 last."""
    everything = [run for unit in found for run in unit["runs"]]
    detected = {id(run) for run in seen(found)}
    rows = []
    for low, high in (*pairwise(EDGES), (None, None)):
        if low is None or high is None:
            runs, name = [run for run in everything if not run["small"]], "Table 2"
        else:
            runs = [run for run in everything if run["small"] and low <= run["radii"] < high]
            name = f"{low:g} to {high:g}" if np.isfinite(high) else f"over {low:g}"
        there = [run for run in runs if id(run) in detected]
        rows.append((words, name, f"{len(runs)}", *_shares(runs, there)))
    return rows


def _shares(runs: Sequence[Numbers], there: Sequence[Numbers]) -> Row:
    covered = sum(run["onset"][0] <= FAULT_AT <= run["onset"][2] for run in there)
    good = [run for run in there if is_right(run)]
    inside = sum(_holds(run) for run in good)
    return (
        percent(len(there), len(runs)),
        percent(sum(is_right(run) for run in there), len(there)),
        percent(sum(is_named(run) for run in there), len(there)),
        percent(covered, len(there), low=0.9, high=0.99),
        percent(inside, len(good), low=0.93, high=0.97),
    )


def _holds(run: Numbers) -> bool:
    return all(low <= run["truth"][name] <= high for name, (_, low, high) in run["sizes"].items())


def _log_score(runs: Sequence[Numbers]) -> float:
    return float(-np.log(np.maximum([run["given"] for run in runs], LEAST)).mean())


def middling(runs: Sequence[Numbers]) -> list[Numbers]:
    """Return the runs of those faults, outside or inside the isolability radius, of which a middling share is right."""
    groups: dict[tuple[str, bool], list[Numbers]] = {}
    for run in runs:
        groups.setdefault((_label(run), run["clear"]), []).append(run)
    shares = {key: np.mean([is_right(run) for run in group]) for key, group in groups.items()}
    return [run for key, group in groups.items() if MIDDLING[0] <= shares[key] <= MIDDLING[1] for run in group]


def curve_of(runs: Sequence[Numbers], bins: int = BINS) -> Reliability:
    """Return what was claimed for the most probable candidate and what came true."""
    claimed = np.array([run["said"][run["first"]] for run in runs])
    return reliability(claimed, [is_right(run) for run in runs], bins)


def _calibration(found: Reliability, runs: Sequence[Numbers]) -> str:
    """Show the expected calibration error, and what chance alone would make of perfect probabilities."""
    if not runs:
        return ""
    claimed = np.array([run["said"][run["first"]] for run in runs])
    rng = np.random.default_rng(0)
    chance = [reliability(claimed, rng.random(len(runs)) < claimed, BINS).calibration_error for _ in range(DRAWS)]
    error = found.calibration_error
    mark = "" if error <= ERROR else "**"
    return f"{mark}{error:.3f}{mark} ({np.mean(chance):.3f}, {np.quantile(chance, 0.95):.3f})"


SCENARIOS = {kind: Scenario(f"isolation/{kind}", kind, UNITS[kind], job, (kind,), scores) for kind in KINDS}
TABLES = (
    Table(
        "isolation",
        (
            *("reference", "runs", "detected", "right outside the isolability radius", "right inside"),
            *("named is right", "log score"),
            *("called unknown", "of middling accuracy", "calibration error", "dummy: right, log score"),
        ),
        tuple(SCENARIOS.values()),
    ),
    Table(
        "isolability",
        (
            *("reference", "fault", "detectable ratio", "isolable ratio", "radius over linear bound (2)"),
            *("right outside", "right inside"),
        ),
        tuple(Scenario(s.id, s.words, s.units, s.job, s.arguments, isolability) for s in SCENARIOS.values()),
    ),
    Table(
        "isolation-by-size",
        ("reference", "radii", "runs", "detected", "first is right", "named", "onset in interval", "size in interval"),
        tuple(Scenario(s.id, s.words, s.units, s.job, s.arguments, by_size) for s in SCENARIOS.values()),
    ),
)


def figure(results: Mapping[str, Sequence[Numbers]], path: Path) -> None:
    """Draw reliability curves, by reference."""
    there = {kind: seen(results[s.id]) for kind, s in SCENARIOS.items() if s.id in results}
    if not there:
        return
    from matplotlib.figure import Figure

    labelled: set[str] = set()
    drawn = Figure(figsize=(6.4, 4.4), layout="constrained")
    axes = drawn.add_subplot(xlim=(0, 1.1), ylim=(-0.02, 1.06))
    axes.set(xlabel="probability of the first candidate", ylabel="share that is right, 95 % interval")
    axes.plot([0, 1], [0, 1], color="0.6", linewidth=1.0)
    for i, (kind, runs) in enumerate(there.items()):
        curve = curve_of(runs, BINS)
        for claimed, observed, count in zip(curve.claimed, curve.observed, curve.count, strict=True):
            if not count:
                continue
            found, at = share(round(observed * count), int(count)), claimed + 0.008 * (i - 1)
            axes.plot([at, at], [found.low, found.high], color=f"C{i}", linewidth=1.5)
            axes.plot(at, found.value, "o", color=f"C{i}", markersize=5, label=kind if kind not in labelled else None)
            axes.annotate(f"{count:.0f}", (at, found.value), (6, 4 - 10 * i), textcoords="offset points", color=f"C{i}")
            labelled.add(kind)
    axes.legend(loc="upper left")
    path.parent.mkdir(parents=True, exist_ok=True)
    drawn.savefig(path, dpi=150)
