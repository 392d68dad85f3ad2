"""Measured axes: changes of random size, kind and time added to u, and what servoscope and simple detectors say.

    python benchmarks public/axis_injections [--data DIR] [--count N] [--seed S] [--machine NAME] [--json]

Each machine is learned as a plant of kind ``axis``; `count` changes go into each of its cases, 5 to 50 % either way,
the sizes even in their logarithms, between a quarter and three quarters of the recording.

- EMPS: DATA_EMPS learned; changes into it and into the recording with pulses. The force that a change adds is that of
  the learned coefficients; speed and acceleration are those of a cubic through five samples (5 ms): smoothed over
  11 ms, the acceleration of the pulses is too small by 3 %.
- QUBE: fourteen runs, each judged with what the thirteen others taught.
- XL330: simulated, for what it logs as u is its own P law of y, which an added force would not obey. The plant is that
  learned from its eight files, the reference a measured one, five times over; eight simulated recordings are learned,
  a hundred healthy ones judged.
- Cranfield: runs 1 to 5 at 20 kgf learned, u of the others multiplied: a stepper's current has no physical inertia to
  change, so its plant is the polynomial one of examples/cranfield.toml, without a refit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from tables import Table, parse_with_data, parser, show

import servoscope as ss
from public import cranfield, qube
from public.servoscope_detector import OURS, ROOT, with_gain
from public.simple_detectors import detectors, judge
from servoscope.core.arrays import FloatArray
from servoscope.isolation.ml.axis_vibration import scan_limit
from servoscope.isolation.ml.axis_window import AxisWindow
from servoscope.isolation.ml.hypothesis import fit_hypothesis
from servoscope.isolation.ml.window import ChangeProfile
from servoscope.learning.axis_fit import fit_axis
from servoscope.simulation import FaultEvent, simulate

KINDS = ("payload", "motor_constant", "dry_friction", "lubrication")
SHOWN = (*KINDS, "gravity")
POLYNOMIAL = {"input_gain": "motor_constant"}  # what a polynomial plant calls it
TOGETHER = 0.95  # probability of the causes that are told together
BANDS = ((0.05, 0.1), (0.1, 0.2), (0.2, 0.5))
POINTS = 0.02  # added to both ends of an interval of a size, beside the interval as stated
BETWEEN = 0.25, 0.75  # of a recording, where changes begin
LEARNED, HEALTHY, REPEATS = 8, 100, 5  # simulated recordings that are learned, and judged as they are; of the reference

Change = Callable[[int, str, float, int], ss.Recording]
"""From a number, a kind, a size and an onset to the recording that holds the change."""


@dataclass(frozen=True)
class Case:
    """What is learned, and what is judged with it."""

    name: str
    loop: ss.Loop
    learned: Sequence[ss.Recording]
    judged: ss.Recording  # what changes go into
    kinds: tuple[str, ...]
    changed: Callable[[ss.Baseline], Change]
    window_s: float  # of the simple detectors
    healthy: Sequence[ss.Recording] = ()  # further healthy recordings


@dataclass(frozen=True)
class Injection:
    """A change and what was said of it."""

    size: float  # the ratio minus 1
    found: dict[str, bool]  # by detector
    named: bool  # whether it alone was named
    wrong: bool  # whether something else was
    together: bool  # whether it is among the fewest causes that have 95 % together
    inside: tuple[bool, bool, bool] | None  # size in its interval, in the wider one, onset in its; None unless named


def added_force(recording: ss.Recording, span: int = 5) -> Callable[[ss.Baseline], Change]:
    """Return changes whose u holds what they would have asked for; speed and acceleration over `span` samples."""
    from scipy.signal import savgol_filter

    T = 1.0 / recording.sample_rate
    v, a = (savgol_filter(recording.y, span, 3, deriv=order, delta=T) for order in (1, 2))

    def of_baseline(baseline: ss.Baseline) -> Change:
        model, gain = baseline.axis, baseline.loop.plant.input_gain
        learned = model.coefficients if model is not None else {}
        rest = model.rest_speed if model is not None else 0.0
        forward, backward = (
            learned.get(f"viscous_friction{way}", learned.get("viscous_friction", 0.0))
            for way in ("_forward", "_backward")
        )
        forces: dict[str, FloatArray] = {
            "payload": learned.get("inertia", 0.0) * a,
            "motor_constant": gain * recording.u,
            "dry_friction": learned.get("coulomb_friction", 0.0) * np.sign(v) * (np.abs(v) > 0.1 * rest),
            "lubrication": forward * np.maximum(v, 0.0) + backward * np.minimum(v, 0.0),
        }

        def change(_: int, kind: str, size: float, at: int) -> ss.Recording:
            if kind == "motor_constant":
                return with_gain(recording, 1.0 + size, (at + 0.5) / recording.samples)
            since = np.arange(recording.samples) >= at
            return replace(recording, u=recording.u + size * forces[kind] / gain * since)

        return change

    return of_baseline


def emps(data: Path) -> Iterator[Case]:
    """One recording learned, and that and another judged."""
    settings = ss.Loop.load(ROOT / "examples" / "emps.toml").to_dict()
    terms = ["viscous_by_direction", "coulomb", "offset"]
    settings["plant"] = {"kind": "axis", "terms": terms, "input_gain": settings["plant"]["input_gain"]}
    loop = ss.Loop.from_dict(settings)
    both = [ss.read(data / "real" / "emps" / f"{name}.mat", loop) for name in ("DATA_EMPS", "DATA_EMPS_PULSES")]
    for one in both:
        yield Case(one.name.removesuffix(".mat"), loop, both[:1], one, KINDS, added_force(one), 2.0)


def qube_runs(data: Path) -> Iterator[Case]:
    """Each run left out; its arm shows no Coulomb friction."""
    settings = ss.Loop.load(ROOT / "examples" / "qube.toml").to_dict()
    settings["plant"] = {"kind": "axis", "terms": ["viscous", "offset"]}
    settings["monitor"]["model_error"] = 0.0
    loop = ss.Loop.from_dict(settings)
    runs = qube.runs(data, loop)
    kinds = tuple(kind for kind in KINDS if kind != "dry_friction")
    for k, one in enumerate(runs):
        force = added_force(one, 7)  # its encoder is coarse
        yield Case("QUBE", loop, runs[:k] + runs[k + 1 :], one, kinds, force, qube.WINDOW_S)


def xl330(data: Path) -> Iterator[Case]:
    """Yield the closed loop of the pendulum, simulated with the plant that its recordings taught."""
    columns = {"time": "timestamp", "reference": "goal_position", "input": "load % 65536", "output": "position"}
    plant = {"kind": "axis", "terms": ["viscous", "coulomb", "gravity"]}
    settings = {"sample_rate": 200.0, "columns": columns | {"resample": True}, "plant": plant}
    loop = ss.Loop.from_dict(settings | {"name": "XL330", "monitor": {"cutoff": 5.0, "memory": 5.0}})
    runs = [ss.read(path, loop) for path in sorted((data / "real" / "xl330").glob("*.parquet"))]
    model, _ = fit_axis(loop, runs)
    assert model is not None
    driven = next(run for run in runs if run.name.startswith("sin_sin_kp400"))
    k_p = float(driven.u @ (driven.r - driven.y) / ((driven.r - driven.y) @ (driven.r - driven.y)))
    changes = {
        "plant": plant | {"coefficients": model.coefficients},
        "controller": {"kind": "pi", "k_p": k_p, "k_i": 0.0},
    }
    simulated = ss.Loop.from_dict(loop.to_dict() | changes)
    # what no term explains, as white noise of the force with the same power at low frequencies
    noise = model.noise.acceleration_std * np.sqrt(2.0 * model.noise.correlation_s * loop.sample_rate)
    noises = {"noise_u_std": float(noise) * model.coefficients["inertia"], "noise_y_std": model.noise.y_std}
    r = np.tile(driven.r, REPEATS)

    def run(seed: int, faults: Sequence[FaultEvent] = ()) -> ss.Recording:
        return simulate(simulated, r, faults=faults, seed=seed, **noises)[0]

    def of_baseline(_: ss.Baseline) -> Change:
        names = {fault.name: fault.parameter for fault in loop.plant.faults}
        return lambda i, kind, size, at: run(1000 + i, [FaultEvent(names[kind], 1.0 + size, at / loop.sample_rate)])

    seen = [run(seed) for seed in range(LEARNED + HEALTHY)]
    yield Case("XL330, simulated", loop, seen[:LEARNED], seen[LEARNED], SHOWN, of_baseline, 6.0, seen[LEARNED + 1 :])


def cranfield_runs(data: Path) -> Iterator[Case]:
    """Five healthy runs learned, the others multiplied."""
    loop = ss.Loop.load(ROOT / "examples" / "cranfield.toml")
    runs = cranfield.runs(data, loop, "normal", "20")
    for one in runs[5:]:
        yield Case("Cranfield, 20 kgf", loop, runs[:5], one, ("motor_constant",), added_force(one), cranfield.CYCLE_S)


MACHINES: dict[str, Callable[[Path], Iterator[Case]]] = {
    "emps": emps,
    "qube": qube_runs,
    "xl330": xl330,
    "cranfield": cranfield_runs,
}


def inject(
    case: Case, baseline: ss.Baseline, count: int, rng: np.random.Generator
) -> tuple[list[Injection], dict[str, int], int]:
    """Return what was said of random changes, false alarms by detector, and how many recordings were healthy."""
    change = case.changed(baseline)
    healthy = [case.judged, *case.healthy]
    drawn, judged = [], []
    for i in range(count):
        kind, way = case.kinds[i % len(case.kinds)], rng.choice([-1.0, 1.0])
        size = float(way * np.exp(rng.uniform(np.log(BANDS[0][0]), np.log(BANDS[-1][1]))))
        at = int(rng.uniform(*BETWEEN) * case.judged.samples)
        drawn.append((kind, size, float(case.judged.t[at])))
        judged.append(change(i, kind, size, at))
    found: dict[str, list[bool]] = {}
    for one in detectors(case.window_s, case.loop.monitor.cutoff or 0.1 * case.loop.sample_rate):
        scores = judge(one, case.learned, [*healthy, *judged])
        found[one.name] = [score > scores.limit for score in scores.largest]
    false = {name: sum(each[: len(healthy)]) for name, each in found.items()}
    false[OURS] = sum(ss.diagnose(baseline, one).verdict == "fault" for one in healthy)
    made = []
    for i, ((kind, size, at_s), recording) in enumerate(zip(drawn, judged, strict=True), start=len(healthy)):
        diagnosis = ss.diagnose(baseline, recording)
        names, inside = [POLYNOMIAL.get(fault.name, fault.name) for fault in diagnosis.faults], None
        if names == [kind] and diagnosis.onset_s is not None and diagnosis.faults[0].interval is not None:
            low, high = diagnosis.faults[0].interval
            begin, _, end = diagnosis.onset_s
            wide = low - POINTS <= 1.0 + size <= high + POINTS
            inside = low <= 1.0 + size <= high, wide, begin <= at_s <= end
        told = {name: each[i] for name, each in found.items()} | {OURS: diagnosis.verdict in ("suspect", "fault")}
        together, total = [], 0.0
        for cause in diagnosis.candidates:
            if total < TOGETHER:
                together.append(POLYNOMIAL.get(cause.name, cause.name))
                total += cause.probability
        wrong = bool(names) and names != [kind]
        made.append(Injection(size, told, names == [kind], wrong, kind in together, inside))
    return made, false, len(healthy)


def smallest_changes(case: Case, baseline: ss.Baseline) -> dict[str, float]:
    """Return by kind the change half-way whose likelihood ratio comes to the limit of the scan."""
    if baseline.axis is None:
        return {}
    window = AxisWindow.from_recording(baseline, case.judged, 0, case.judged.samples)
    faults, middle = baseline.plant.faults, ChangeProfile(window.samples // 2)
    found = {}
    for fault in faults:
        fit = fit_hypothesis(window, [fault], middle, np.zeros(window.nuisance_count), [np.zeros(1)], free=True)
        variance = window.inflation(fit.jacobian, fit.residual, 1) * fit.cost / window.used
        found[fault.name] = float(np.expm1(np.sqrt(scan_limit(len(faults)) * variance * fit.covariance[0, 0])))
    return found


def found_cells(name: str, detector: str, made: Sequence[Injection], false: int, healthy: int) -> tuple[str, ...]:
    """Return the cells of one detector."""
    bands = [[one.found[detector] for one in made if low <= abs(one.size) < high] for low, high in BANDS]
    return name, detector, f"{false} of {healthy}", *(f"{sum(band)} of {len(band)}" for band in bands)


def told_cells(name: str, made: Sequence[Injection]) -> tuple[str, ...]:
    """Return what servoscope said of the changes that it found."""
    told = [one for one in made if one.found[OURS]]
    named = [one.inside for one in told if one.inside is not None]
    shares = [f"{sum(each)} of {len(named)}" for each in zip(*named, strict=True)] or ["0 of 0"] * 3
    right = sum(one.named for one in told)
    together = sum(one.together for one in told)
    wrong = sum(one.wrong for one in told)
    return (name, f"{right} of {len(told)}", str(wrong), f"{together} of {len(told)}", *shares)


def main() -> None:
    """Run the command line of this process."""
    command = parser(__doc__)
    command.add_argument("--count", type=int, default=40, help="changes per case; a machine with many shares them")
    command.add_argument("--seed", type=int, default=1)
    command.add_argument("--machine", choices=MACHINES, action="append", help="only this machine")
    given = parse_with_data(command, "real")
    rng = np.random.default_rng(given.seed)
    found_rows, told_rows, shown_rows, values = [], [], [], {}
    for machine in given.machine or MACHINES:
        groups: dict[str, list[Case]] = {}
        for case in MACHINES[machine](given.data):
            groups.setdefault(case.name, []).append(case)
        for name, cases in groups.items():
            made: list[Injection] = []
            shown: list[dict[str, float]] = []
            false, healthy = dict[str, int](), 0
            for case in cases:
                baseline = ss.learn(case.loop, case.learned)
                shown += filter(None, [smallest_changes(case, baseline)])
                some, of_healthy, n = inject(case, baseline, -(-given.count // len(cases)), rng)
                made, healthy = made + some, healthy + n
                false = {key: false.get(key, 0) + of_healthy[key] for key in of_healthy}
            rows = [
                found_cells(name, key, made, false[key], healthy) for key in (OURS, *(k for k in false if k != OURS))
            ]
            found_rows += rows
            told_rows.append(told_cells(name, made))
            if shown:
                medians = {kind: float(np.median([one[kind] for one in shown])) for kind in shown[0]}
                shown_rows.append((name, *(f"{100 * medians[k]:.0f} %" if k in medians else "" for k in SHOWN)))
                values |= {f"{name}.smallest.{kind}": f"{100 * size:.0f} %" for kind, size in medians.items()}
            values |= {f"{name}.found.{i}": cell for i, cell in enumerate(rows[0][3:])}
            values |= {f"{name}.false": rows[0][2], f"{name}.named": told_rows[-1][1]}
    bands = [f"found of {100 * low:g} to {100 * high:g} %" for low, high in BANDS]
    note = f"About {given.count} changes per recording or machine, seed {given.seed}. False: of the healthy recordings."
    tables = [
        Table("Axes: changes found", note, ("recording", "detector", "false", *bands), tuple(found_rows)),
        Table(
            "Axes: what was said",
            "Of the changes that servoscope found. Told: the fewest causes that have 95 % together. Intervals are "
            "those of the changes named right.",
            (
                "recording",
                "named right",
                "named wrong",
                "among those told",
                "size in 95 %",
                "with 2 points",
                "onset in 95 %",
            ),
            tuple(told_rows),
        ),
        Table(
            "Axes: what the motion can show",
            "The change half-way through a recording from which the data tell it apart from noise: its likelihood "
            "ratio comes to the limit of the scan. Medians over recordings.",
            ("recording", *SHOWN),
            tuple(shown_rows),
        ),
    ]
    show(tables, given.json, values)
