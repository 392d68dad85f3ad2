"""How long until a fault is seen, by its size, and how long the best detector of all would take."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from accuracy.innovations import information
from accuracy.rig import FAULT_AT, HOURS_PER_YEAR, alarm_times, baseline, loop, record, until_first
from accuracy.scenario import Numbers, Row, Scenario, Table
from servoscope.core.arrays import FloatArray
from servoscope.research.paper.conditions import FAULT_NAMES
from servoscope.scoring import Detections, detections, needed_information, shortest_delay
from servoscope.simulation import FaultEvent

KIND = "multisine"
LEARNED = 600.0  # s
WITHIN = 600.0  # s; a later detection is a miss
SIZES: dict[str, tuple[float, ...]] = {
    "p_s": (0.998, 0.995, 0.99, 0.98, 0.95, 0.9, 0.8, 0.6),
    "C_ie": (1.005, 1.01, 1.02, 1.05, 1.1, 1.2, 1.4),
    "b_p": (1.1, 1.2, 1.5, 2.0, 3.0, 5.0, 10.0, 20.0, 40.0),
    "beta": (0.9, 0.8, 0.7, 0.5, 0.3, 0.1, 0.01, 0.005),
}
RAMPS = {"C_ie": 1.1, "p_s": 0.95}


def job(seed: int, parameter: str, ratios: tuple[float, ...], ramp_s: float) -> Numbers:
    """Return, by ratio, when an alarm was raised [s], up to the first one after the onset."""
    learned = baseline(KIND, LEARNED, seed)
    found = {}
    for i, ratio in enumerate(ratios):
        fault = FaultEvent(parameter, ratio, FAULT_AT, ramp_s)
        times = alarm_times(learned, record(KIND, FAULT_AT + WITHIN, seed, 1 + i, (fault,)))
        found[f"{ratio:g}"] = until_first(times)
    return found


def bounds(fault: FaultEvent) -> tuple[float, float]:
    """Return the delay of the best detector there is, and Lorden's first-order bound [s]; inf beyond ten minutes."""
    rate = loop().sample_rate
    arl0 = 3600.0 * rate * HOURS_PER_YEAR  # samples; one false alarm a year
    gained = information(fault, KIND, FAULT_AT + WITHIN)
    needed = needed_information(arl0, float(gained.mean()))
    return shortest_delay(needed, gained) / rate, shortest_delay(float(np.log(arl0)), gained) / rate


def scored(found: Sequence[Numbers]) -> dict[str, Detections]:
    """Return delays and misses by ratio."""
    return {ratio: detections([each[ratio] for each in found], FAULT_AT, within=WITHIN) for ratio in found[0]}


def rows(words: str, found: Sequence[Numbers], parameter: str, ramp_s: float) -> list[Row]:
    """Show delays and bounds, one row per size."""
    made = []
    for ratio, each in scored(found).items():
        best, lorden = bounds(FaultEvent(parameter, float(ratio), FAULT_AT, ramp_s))
        grown = f" (x{float(ratio) ** (each.median / ramp_s):.3g})" if ramp_s and np.isfinite(each.median) else ""
        median, late = _seconds(each.median), _seconds(each.quantile(0.9))
        counted = f"{len(found)}", f"{each.missed.value:.0%}", f"{int((each.false_alarms > 0).sum())}"
        made.append((f"{words} x{ratio}", *counted, median + grown, late, _seconds(best), _seconds(lorden)))
    return made


def draw(found: Mapping[str, Sequence[Numbers]], path: Path) -> None:
    """Draw delay over size with the best possible delay below; `found` by parameter."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    axes = figure.add_subplot(xscale="log", yscale="log", xlabel="size, |log(ratio)|", ylabel="delay [s]")
    for colour, (parameter, units) in zip(("C0", "C1", "C2", "C3"), found.items(), strict=False):
        delays = scored(units)
        size = _size(delays)
        middle, late = (np.array([each.quantile(q) for each in delays.values()]) for q in (0.5, 0.9))
        best = [bounds(FaultEvent(parameter, float(ratio), FAULT_AT))[0] for ratio in delays]
        axes.plot(size, middle, "o-", color=colour, label=f"{FAULT_NAMES[parameter]} ({parameter})")
        seen = np.isfinite(late)
        axes.vlines(size[seen], middle[seen], late[seen], color=colour, linewidth=1.0)
        axes.plot(size, best, "--", color=colour, linewidth=1.0)
    axes.plot([], [], "--", color="0.4", linewidth=1.0, label="best possible")
    axes.grid(True, which="both", alpha=0.2)
    axes.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


def _size(delays: Mapping[str, Detections]) -> FloatArray:
    return np.abs(np.log([float(ratio) for ratio in delays]))


def _seconds(value: float) -> str:
    return f"{value:.3g} s" if np.isfinite(value) else "> 10 min"


def _scenario(parameter: str, ratios: tuple[float, ...], ramp_s: float) -> Scenario:
    words = f"{parameter}, ramp over 10 min to" if ramp_s else parameter
    show = partial(rows, parameter=parameter, ramp_s=ramp_s)
    id_ = f"delay/{'ramp-' if ramp_s else ''}{FAULT_NAMES[parameter]}"
    return Scenario(id_, words, 20, job, (parameter, ratios, ramp_s), show)


STEPS = tuple(_scenario(parameter, ratios, 0.0) for parameter, ratios in SIZES.items())
TABLES = (
    Table(
        "delay",
        ("fault", "runs", "missed", "early", "median", "90 %", "best possible", "Lorden, first order"),
        (*STEPS, *(_scenario(parameter, (ratio,), 600.0) for parameter, ratio in RAMPS.items())),
    ),
)


def figure(results: Mapping[str, Sequence[Numbers]], path: Path) -> None:
    """Draw the steps whose results are there, by scenario id."""
    found = {scenario.arguments[0]: results[scenario.id] for scenario in STEPS if scenario.id in results}
    if found:
        draw(found, path)
