"""Signals that are not what the loop file says: whether each is told in its own words, and none gets a fault's name."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

import servoscope as ss
from accuracy import smooth
from accuracy.rig import loop as rig_loop
from accuracy.scenario import Numbers, Row, Scenario, Table
from servoscope.core.errors import ServoscopeError
from servoscope.simulation import reference, simulate

LOOPS = {
    "rig": "reference rig, multisine",
    "axis-2": "motor axis, order 2, moves",
    "axis-2-friction": "motor axis with Coulomb friction, moves",
}
SECONDS = 60.0
STUCK_S = 20.0
Recording = ss.Recording


def stuck(name: str, recording: Recording) -> Recording:
    """Return a recording one of whose signals stays as it is from 20 s on."""
    x = getattr(recording, name).copy()
    at = int(np.searchsorted(recording.t, STUCK_S))
    x[at:] = x[at]
    return replace(recording, **{name: x})


def wrapped(recording: Recording) -> Recording:
    """Return a recording whose counter of y wraps at 0.6 of its range."""
    size = 0.6 * np.ptp(recording.y)
    return replace(recording, y=(recording.y + size / 2.0) % size - size / 2.0)


# what is done to a healthy recording, and words of the headline that must follow
DEFECTS: dict[str, tuple[Callable[[Recording], Recording], str]] = {
    "y in mm": (lambda x: replace(x, y=1e3 * x.y), "y is in another unit: times 0.001 it fits"),
    "y in degrees": (lambda x: replace(x, y=x.y * 180.0 / np.pi), "y is in another unit: times 0.0174533 it fits"),
    "r and y in mm": (lambda x: replace(x, r=1e3 * x.r, y=1e3 * x.y), "r and y are in another unit: times 0.001"),
    "u in mA": (lambda x: replace(x, u=1e3 * x.u), "u is in another unit: times 0.001 it fits"),
    "r and y exchanged": (lambda x: replace(x, r=x.y, y=x.r), "r and y are exchanged"),
    "u and y exchanged": (lambda x: replace(x, u=x.y, y=x.u), "u and y are exchanged"),
    "r and u exchanged": (lambda x: replace(x, r=x.u, u=x.r), "r and u are exchanged"),
    "u of the other sign": (lambda x: replace(x, u=-x.u), "u is of the opposite sign"),
    "y stuck": (lambda x: stuck("y", x), "from 20.0 s on y stays exactly the same"),
    "u stuck": (lambda x: stuck("u", x), "from 20.0 s on u stays exactly the same"),
    "a counter that wraps": (wrapped, "a counter wraps or was reset"),
}


def loop(name: str) -> ss.Loop:
    """Return the loop of the reference rig, or of a motor axis."""
    return rig_loop() if name == "rig" else smooth.machine(name)


def healthy(name: str, seed: int) -> Recording:
    """Return a healthy recording of one of the loops."""
    made = loop(name)
    if name == "rig":
        r = reference("multisine", SECONDS, made.sample_rate)
    else:
        r = smooth.motion("moves", SECONDS, made.sample_rate, seed)
    return simulate(made, r, seed=seed)[0]


@functools.cache
def baseline(name: str) -> ss.Baseline:
    """Return the baseline of one of the loops, from one recording."""
    return ss.learn(loop(name), [healthy(name, 1)])


def job(seed: int, name: str) -> Numbers:
    """Judge one healthy recording as it is, and with each defect."""
    recording, runs = healthy(name, 1000 + seed), {}
    for defect, (spoil, words) in {"none": (lambda x: x, "Healthy"), **DEFECTS}.items():
        try:
            diagnosis = ss.diagnose(baseline(name), spoil(recording))
        except ServoscopeError:
            runs[defect] = "error"
            continue
        told = words in str(diagnosis.headline)
        runs[defect] = "told" if told else "named" if diagnosis.faults else diagnosis.verdict
    return {"runs": runs}


def rows(words: str, found: Sequence[Numbers]) -> list[Row]:
    """Show how many of the defects were told, and what was said of the others."""
    shown = []
    for defect in ("none", *DEFECTS):
        ends = [unit["runs"][defect] for unit in found]
        others = {end: ends.count(end) for end in sorted(set(ends) - {"told"})}
        told = f"{ends.count('told')} of {len(ends)}"
        shown.append(
            (words if defect == "none" else "", defect, told, ", ".join(f"{k} {n}" for k, n in others.items()))
        )
    return shown


SCENARIOS = tuple(Scenario(f"signals/{name}", words, 40, job, (name,), rows) for name, words in LOOPS.items())
TABLES = (Table("signals", ("loop", "defect", "told", "otherwise"), SCENARIOS),)
