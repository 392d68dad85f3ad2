"""Changes that are no fault of the list: whether they are called unknown, what is offered, what imitates a fault."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

import servoscope as ss
from accuracy.draws import KINDS, SECONDS
from accuracy.rig import FAULT_AT, SEEDS_PER_UNIT, baseline, loop
from accuracy.scenario import Numbers, Row, Scenario, Table
from accuracy.told import percent, seen, told
from servoscope.core.arrays import FloatArray
from servoscope.isolation.candidate import UNKNOWN
from servoscope.models.discretise import discretise
from servoscope.simulation import reference
from servoscope.simulation.measurement import NOISE_U_STD, NOISE_Y_STD, draw_noise, make_recording

RUNS = 10  # per baseline
UNITS = 5
NOTHING: Mapping[str, float] = {}
PLAY = 0.02  # of the stroke
CHANGES = {  # what it is, what `causes` calls it, whether no fault of the list can imitate it
    "delay": ("one more sample of delay", "delay", True),
    "area-larger": ("piston area x1.1", "A_p", True),
    "area-smaller": ("piston area x0.9", "A_p", True),
    "backlash": ("backlash of 2 % of the stroke", "backlash", True),
    "sensor": ("sensor gain x1.05", "sensor_gain", False),
    "spring": ("spring x0.8", "k_p", False),
}


def changed(what: str, kind: str, unit: int, index: int) -> ss.Recording:
    """Simulate a change from half-way on."""
    r, seed = reference(kind, SECONDS, loop().sample_rate), SEEDS_PER_UNIT * unit + index
    match what:
        case "delay":
            return by_hand(r, seed, later=1)
        case "area-larger":
            return by_hand(r, seed, ratios={"A_p": 1.1})
        case "area-smaller":
            return by_hand(r, seed, ratios={"A_p": 0.9})
        case "backlash":
            return by_hand(r, seed, play=PLAY * float(np.ptp(r)))
        case "sensor":
            return by_hand(r, seed, gain=1.05)
        case _:
            return by_hand(r, seed, ratios={"k_p": 0.8})


def by_hand(
    r: FloatArray,
    seed: int,
    ratios: Mapping[str, float] = NOTHING,
    later: int = 0,
    play: float = 0.0,
    gain: float = 1.0,
) -> ss.Recording:
    """Simulate the loop step by step, with what the package's own simulation does not know.

    Parameters
    ----------
    r
        Reference, shape (N,).
    seed
        Of the noise.
    ratios
        Of constants of the plant to their nominal values.
    later
        Samples by which u acts later.
    play
        Backlash between piston and sensor [m].
    gain
        Factor on y as measured.
    """
    made = loop()
    assert made.controller is not None, "the rig has a controller"
    plants = [discretise(p.state_space(), made.sample_rate) for p in (made.plant, made.plant.scaled(dict(ratios)))]
    n_u, n_y = draw_noise(len(r), NOISE_U_STD, NOISE_Y_STD, seed)
    x, u, y = np.zeros(len(plants[0].c)), np.zeros(len(r)), np.zeros(len(r))
    integral, position = 0.0, 0.0
    for k in range(len(r)):
        ill = k >= round(FAULT_AT * made.sample_rate)
        plant, half = plants[ill], play / 2.0 if ill else 0.0
        moved = float(plant.c @ x)
        position = min(max(position, moved - half), moved + half)
        y[k] = (gain if ill else 1.0) * position + n_y[k]
        integral += (r[k] - y[k]) / made.sample_rate
        u[k] = made.controller.k_p * (r[k] - y[k]) + made.controller.k_i * integral
        x = plant.A @ x + plant.b_now * (u[k - later if ill else k] + n_u[k])
    return make_recording(made, r, u, y)


def job(seed: int, what: str, kind: str, runs: int = RUNS) -> Numbers:
    """Diagnose one change some times after one baseline."""
    learned = baseline(kind, SECONDS, seed)
    return {"runs": [told(learned, changed(what, kind, seed, 1 + i), (), mimics=True) for i in range(runs)]}


def called(words: str, found: Sequence[Numbers], what: str) -> list[Row]:
    """Show what a change was called, and which causes were offered."""
    _, cause, foreign = CHANGES[what]
    runs = seen(found)
    unknown = sum(run["first"] == UNKNOWN for run in runs)
    names = Counter(run["first"] if run["named"] else "nothing" for run in runs if run["first"] != UNKNOWN)
    listed = Counter(name for run in runs for name in run["mimics"])
    first = sum(next(iter(run["mimics"]), "") == cause for run in runs)
    return [
        (
            words,
            f"{sum(len(unit['runs']) for unit in found)}",
            f"{len(runs)}",
            percent(unknown, len(runs), low=0.9 if foreign else 0.0),
            _counted(names),
            percent(sum(cause in run["mimics"] for run in runs), len(runs), low=0.9),
            f"{100 * first / max(len(runs), 1):.0f}",
            _counted(Counter({name: n for name, n in listed.items() if name != cause})),
        )
    ]


def _counted(names: Counter[str]) -> str:
    return "; ".join(f"{name} {count}" for name, count in names.most_common(3))


def _scenario(what: str, kind: str) -> Scenario:
    words, _, foreign = CHANGES[what]
    id_ = f"{'unknown' if foreign else 'mimics'}/{what}-{kind}"
    return Scenario(id_, f"{words}, {kind}", UNITS, job, (what, kind), partial(called, what=what))


TABLES = (
    Table(
        "unknown",
        (
            *("change, reference", "runs", "detected", "called unknown", "named"),
            *("true cause offered", "first [%]", "offered too"),
        ),
        tuple(_scenario(what, kind) for what in CHANGES for kind in KINDS),
    ),
)
