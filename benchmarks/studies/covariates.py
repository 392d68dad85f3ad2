"""What logged covariates are worth: alarms in warm-ups and under loads, and the wear found there; a Markdown table.

python benchmarks studies/covariates [--count 100] [--live] [--json]

Oil that warms thins by 4 % per kelvin, which leakage and friction of a linear actuator follow: a minute from 30 to 38
degC on, by 5 to 30 K with a time constant of a minute. A motor axis carries a load that adds 10 % of its inertia per
unit; it creeps and sticks between its moves, and its loop file leaves these rests out, as `servoscope inspect` asks.
Worn recordings leak 10 % more, or have half as much friction again, from their middle on. Beside it, what is learned
from the same healthy recordings without the covariate: with a warm-up that the coefficients tell, with their
scatter, and from one state; of the latter two the monitor's alarms are counted. And three simple detectors that learned
from the same recordings. With --live the same recordings are followed as streams instead, by a monitor that sees no
later sample.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path

import numpy as np
from public.simple_detectors import detectors, judge
from tables import Table, parser, show

import servoscope as ss
from servoscope.core.blas import with_one_blas_thread
from servoscope.simulation import FaultEvent, reference, simulate
from servoscope.simulation.nonlinear_eha import Rig, simulate_rig
from servoscope.simulation.tutorial import AXIS

RIG = Path(str(files("servoscope"))) / "simulation" / "reference-rig.toml"
RISES = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0)  # K, of the healthy recordings
LOADS = (1.0, 3.0, 5.0)
WINDOW_S, CUTOFF_HZ = 10.0, 10.0  # of the simple detectors
SHORT_RESTS = {"update_when": "moving", "rest_speed": 0.004}  # what `servoscope inspect` asks for on the axis
NEAR = 0.03  # relative error of a size that counts as right
Draw = Callable[[np.random.Generator, bool], ss.Recording]


@dataclass(frozen=True)
class Scene:
    """One kind of machine: its loop, with the covariate, and what it is learned from and judged on."""

    name: str
    loop: ss.Loop
    healthy: Sequence[ss.Recording]
    same: Sequence[ss.Recording]  # healthy recordings of one state
    draw: Draw  # a recording, worn or not
    ratio: float  # of the wear
    warms: bool = True  # whether the covariate is a temperature that the machine's losses drive


def warm_up(loop: ss.Loop, seed: int, start: float, rise: float, worn: bool = False) -> ss.Recording:
    """Return a minute in which the oil warms."""
    rig = replace(Rig.ideal(), temperature=start, warming=rise, warming_time=60.0)
    faults = [FaultEvent.parse("C_ie=1.1@30")] if worn else []
    made, truth = simulate_rig(loop, reference("profile", 60.0, loop.sample_rate), rig, faults=faults, seed=seed)
    return replace(made, channels={"oil_temperature": truth.temperature})


def carry(loop: ss.Loop, seed: int, load: float, worn: bool = False) -> ss.Recording:
    """Return half a minute of an axis with a load."""
    nominal = loop.plant.coefficients  # type: ignore[attr-defined]
    plant = loop.plant.model_copy(
        update={"coefficients": {**nominal, "inertia": nominal["inertia"] * (1.0 + 0.1 * load)}}
    )
    faults = [FaultEvent.parse("viscous_friction=1.5@15")] if worn else []
    made, _ = simulate(
        loop.model_copy(update={"plant": plant}),
        reference("trapezoid", 30.0, loop.sample_rate),
        faults=faults,
        noise_u_std=5e-3,
        noise_y_std=1e-5,
        seed=seed,
    )
    return replace(made, channels={"load": np.full(made.samples, load)})


def scenes() -> Iterator[Scene]:
    """Yield the machines; recordings that are judged have seeds of their own."""
    rig = with_covariate(ss.Loop.load(RIG), "oil_temperature")
    warm = [warm_up(rig, i, 30.0 + 2.0 * i, rise) for i, rise in enumerate(RISES)]
    same = [warm_up(rig, 20 + i, 40.0, 0.0) for i in range(len(RISES))]

    def heat(rng: np.random.Generator, worn: bool) -> ss.Recording:
        return warm_up(rig, int(rng.integers(1000, 2**31)), rng.uniform(30.0, 38.0), rng.uniform(5.0, 30.0), worn)

    def hold(rng: np.random.Generator, worn: bool) -> ss.Recording:
        return warm_up(rig, int(rng.integers(1000, 2**31)), rng.uniform(31.0, 57.0), 0.0, worn)

    yield Scene("oil that warms", rig, warm, same, heat, 1.1)
    yield Scene("oil at one temperature", rig, warm, same, hold, 1.1)
    axis = with_covariate(ss.Loop.from_dict({**AXIS, "monitor": SHORT_RESTS}), "load")

    def move(rng: np.random.Generator, worn: bool) -> ss.Recording:
        return carry(axis, int(rng.integers(1000, 2**31)), rng.uniform(1.0, 5.0), worn)

    loads = [carry(axis, i, load) for i, load in enumerate(LOADS * 2)]
    yield Scene("load", axis, loads, [carry(axis, 20 + i, 1.0) for i in range(6)], move, 1.5, warms=False)


def with_covariate(loop: ss.Loop, name: str) -> ss.Loop:
    """Return a loop that depends on a column."""
    return loop.model_copy(update={"columns": loop.columns.model_copy(update={"covariates": {name: name}})})


def judged_scenes(count: int) -> Iterator[tuple[Scene, ss.Loop, list[ss.Recording]]]:
    """Yield each scene, its loop without the covariate, and `count` healthy recordings before as many worn ones."""
    for scene in scenes():
        plain = scene.loop.model_copy(update={"columns": ss.Loop.from_dict(AXIS).columns})
        rng = np.random.default_rng(4)
        yield scene, plain, [scene.draw(rng, worn) for worn in (False, True) for _ in range(count)]


def learn_covariates(scene: Scene, plain: ss.Loop) -> dict[str, ss.Baseline]:
    """Return what is learned with the covariate, and where it warms without."""
    learned = {"the covariate": ss.learn(scene.loop, scene.healthy)}
    if scene.warms:
        hidden = plain.monitor.model_copy(update={"hidden_warm_up": True})
        learned["a hidden warm-up"] = ss.learn(plain.model_copy(update={"monitor": hidden}), scene.healthy)
    return learned


@with_one_blas_thread
def live_rows(count: int) -> list[tuple[str, ...]]:
    """Follow healthy and worn recordings of each machine as streams: alarms, and how long after the onset."""
    found = []
    for scene, plain, recordings in judged_scenes(count):
        for name, baseline in learn_covariates(scene, plain).items():
            monitor, first = ss.Monitor(baseline), []
            for one in recordings:
                _, trace = monitor.run(monitor.init(), one.r, one.u, one.y, one.restart, channels=one.channels)
                first.append(float(trace.t[np.argmax(trace.exceeded)]) if trace.exceeded.any() else np.inf)
            onset = recordings[0].duration_s / 2.0
            late = np.array([t - onset for t in first[count:] if np.isfinite(t) and t > onset])
            early = sum(t <= onset for t in first[count:]) + sum(np.isfinite(first[:count]))
            delay = f"{np.median(late):.2g} s" if late.size else "-"
            found.append((scene.name, name, f"{early}", f"{late.size}", delay))
    return found


@with_one_blas_thread
def rows(count: int) -> list[tuple[str, ...]]:
    """Judge healthy and worn recordings of each machine by three baselines."""
    found = []
    for scene, plain, recordings in judged_scenes(count):
        for name, baseline in learn_covariates(scene, plain).items():
            said = [ss.diagnose(baseline, one) for one in recordings]
            alarms = [one.verdict in ("suspect", "fault") for one in said]
            sizes = [one.faults[0].ratio for one in said[count:] if len(one.faults) == 1]
            near = sum(abs(size / scene.ratio - 1.0) <= NEAR for size in sizes)
            counts = f"{sum(alarms[:count])}", f"{sum(alarms[count:])}", f"{len(sizes)}", f"{near}"
            found.append((scene.name, name, *counts))
        for name, healthy in (("their scatter", scene.healthy), ("one state", scene.same)):
            monitor = ss.Monitor(ss.learn(plain, healthy))
            alarms = [monitor.run(monitor.init(), one.r, one.u, one.y)[1].exceeded.any() for one in recordings]
            found.append((scene.name, name, f"{sum(alarms[:count])}", f"{sum(alarms[count:])}", "-", "-"))
        for detector in detectors(WINDOW_S, CUTOFF_HZ):
            scores = judge(detector, scene.healthy, recordings)
            alarms = [score > scores.limit for score in scores.largest]
            found.append((scene.name, detector.name, f"{sum(alarms[:count])}", f"{sum(alarms[count:])}", "-", "-"))
    return found


def main() -> None:
    """Run the command line of this process."""
    command = parser(__doc__)
    command.add_argument("--count", type=int, default=100, help="recordings judged, healthy and worn each")
    command.add_argument("--live", action="store_true", help="follow the recordings as streams")
    given = command.parse_args()
    if given.live:
        note = f"{given.count} healthy and {given.count} worn recordings a row, followed sample by sample."
        live = "what varies", "learned with", "alarms without wear", "worn ones found", "median delay"
        show([Table("Covariates live", note, live, tuple(live_rows(given.count)))], given.json)
        return
    heads = ("what varies", "learned with", "alarms, healthy", "alarms, worn", "one fault named", "size within 3 %")
    note = f"{given.count} healthy and {given.count} worn recordings a row; six healthy ones to learn from."
    show([Table("Covariates", note, heads, tuple(rows(given.count)))], given.json)
