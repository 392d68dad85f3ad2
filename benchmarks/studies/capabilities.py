"""Which capabilities work together, pair by pair, in each place that takes a baseline; two Markdown tables.

python benchmarks studies/capabilities [--json]

Three small simulated machines are learned with all that their plant allows: a linear motor, the same motor under a
logged load, and an axis with dry friction under a logged load. Each has two operating points and a population of like
machines. Recordings that need one capability each are then given to `diagnose`, `Monitor`, a service, a monitor of
several assets, a lake and the export to C. A pair works where both of its capabilities do their part in one baseline;
elsewhere the product says why, and its sentence stands in the second table.
"""

from __future__ import annotations

import contextlib
import datetime
import itertools
import json
import sqlite3
import string
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from tables import Table, parser, show

import servoscope as ss
from servoscope import fleet
from servoscope.baseline.baseline import Baseline
from servoscope.core.blas import with_one_blas_thread
from servoscope.core.errors import BaselineError
from servoscope.core.messages import render
from servoscope.detection.trace import UNSEEN_EXCESS
from servoscope.export import UNSEEN_MOTION, export_c
from servoscope.fleet.lake import Lake
from servoscope.fleet.tasks import local
from servoscope.service.build import build_components
from servoscope.service.config import ServiceFile
from servoscope.service.service import Service
from servoscope.signals import clean, writers
from servoscope.simulation import FaultEvent, reference, simulate

COVARIATES, FEATURES, REFIT, SEQUENTIAL = "covariates", "features", "refit", "sequential test"
MOTION, PAST, POINTS, POPULATION, TIMELINE = "motion check", "own past", "operating points", "population", "timeline"
CAPABILITIES = COVARIATES, FEATURES, REFIT, SEQUENTIAL, MOTION, PAST, POINTS, POPULATION, TIMELINE
HOMES = "diagnose", "Monitor", "service", "fleet", "lake", "C export"

WARM = "warm"  # the operating point at which recordings are judged, the second one
LOADS = 1.0, 5.0, 2.0, 4.0, 3.0, 1.5  # that are learned
LOAD = 4.6  # of the recordings that are judged
WARMER = 1.3  # times the friction there
MACHINES, MACHINES_SCATTER = 8, 0.03
SECONDS, LONG_SECONDS = 20.0, 120.0
BEGAN = datetime.datetime(2026, 11, 1, 6)
DAY = "2026-11-01"

MOTOR = {
    "name": "motor",
    "sample_rate": 50.0,
    "plant": {"kind": "polynomial", "order": 2, "coefficients": {"inertia": 1.0, "viscous_friction": 10.0}},
    "controller": {"kind": "pi", "k_p": 60.0, "k_i": 20.0},
    "monitor": {"memory": 3.0, "frequencies": [0.5, 1.0], "feature_false_alarms": 0.02},
}
AXIS = {
    "name": "axis",
    "sample_rate": 100.0,
    "plant": {"kind": "axis", "terms": ["viscous", "coulomb", "offset"]},
    "monitor": {"cutoff": 5.0, "memory": 3.0, "frequencies": [1.0], "feature_false_alarms": 0.02},
}
LOGGED = {"columns": {"covariates": {"load": "load"}}}

# what is no refusal, but the division of work
ALARM_ONLY = "it raises the alarm; `diagnose`, service and lake name the cause"
HOLDS_ANYWHERE = "not needed: a plant with a sequential test is known under every motion"
LINEAR_ONLY = "several changes are dated in linear plants only, whose model holds under every motion"

Make = Callable[..., ss.Recording]


def motor(name: str, seed: int, point: str, load: float | None, faults: str = "", **how: float) -> ss.Recording:
    """Return a recording of the motor; its inertia grows with the load, and its friction is larger when warm."""
    loop = ss.Loop.from_dict(MOTOR)
    ratios = {"inertia": 1.0 + 0.1 * (load or 0.0), "viscous_friction": WARMER if point == WARM else 1.0}
    loop = loop.model_copy(update={"plant": loop.plant.with_ratios(ratios)})
    speed, ripple, seconds = how.get("speed", 1.0), how.get("ripple", 0.0), how.get("seconds", SECONDS)
    r = reference("multisine", seconds, loop.sample_rate, amplitude=0.05 * speed)
    events = [FaultEvent.parse(one) for one in faults.split()]
    made, _ = simulate(loop, r, seed=seed, faults=events, noise_u_std=5e-3, noise_y_std=1e-5)
    u = made.u + ripple * np.sin(2.0 * np.pi * 18.0 * made.t)
    return _named(replace(made, u=u), name, load)


def axis(name: str, seed: int, point: str, load: float | None, faults: str = "", **how: float) -> ss.Recording:
    """Return a recording of the axis; its friction grows with the load."""
    rate, seconds, speed = AXIS["sample_rate"], how.get("seconds", SECONDS), how.get("speed", 1.0)
    rng, t = np.random.default_rng(seed), np.arange(round(seconds * rate)) / rate
    waves = [(0.05, 0.4, 0.3), (0.03, 0.9, 1.1), (0.01, 2.3, 2.0)]
    r = sum((speed * a * np.sin(2.0 * np.pi * f * t + phase) for a, f, phase in waves), 0.0 * t)
    v = np.gradient(r) * rate
    more = np.exp(0.1 * (load or 0.0))
    friction = 3.0 * more * np.ones(len(t))
    for event in map(FaultEvent.parse, faults.split()):
        friction = np.where(t >= event.at_s, 3.0 * more * event.ratio, friction)
    u = 2.0 * np.gradient(v) * rate + 30.0 * (WARMER if point == WARM else 1.0) * v + friction * np.sign(v) + 0.5
    u += 0.02 * rng.standard_normal(len(t))
    u += how.get("ripple", 0.0) * np.sin(2.0 * np.pi * 30.0 * t)
    made = clean(t, r, u, r + 2e-7 * rng.standard_normal(len(t)), name=name, sample_rate=rate)
    return _named(made, name, load)


def _named(made: ss.Recording, name: str, load: float | None) -> ss.Recording:
    return replace(made, name=name, channels={} if load is None else {"load": np.full(made.samples, load)})


@dataclass(frozen=True)
class Case:
    """One machine: how it is simulated, and what it is learned with."""

    name: str
    make: Make
    loop: dict[str, object]
    loads: tuple[float | None, ...]
    fault: str  # what `FaultEvent` parses, at 12 s
    ripple: float  # of u, above all that the plant is identified from

    @cached_property
    def baseline(self) -> Baseline:
        """The baseline of two operating points, learned among like machines."""
        loop = ss.Loop.from_dict(self.loop)
        days = {
            point: [self.make(f"{point}-{i}", 100 * k + i, point, load) for i, load in enumerate(self.loads)]
            for k, point in enumerate(("cold", WARM))
        }
        return ss.learn(loop, days, population=like_machines(ss.learn(loop, days["cold"])))

    @property
    def one(self) -> Baseline:
        """That of the operating point at which recordings are judged."""
        return self.baseline.at(WARM)

    @cached_property
    def recordings(self) -> dict[str, ss.Recording]:
        """What is judged: by name, recordings that need one capability each."""
        load = None if self.loads[0] is None else LOAD
        parameter = self.fault.partition("=")[0]
        made = {
            "healthy": self.make("healthy", 901, WARM, load),
            "fault": self.make("fault", 902, WARM, load, f"{self.fault}@10"),
            "ripple": self.make("ripple", 904, WARM, load, ripple=self.ripple, seconds=LONG_SECONDS),
        }
        if TIMELINE in self.learned:
            made["changes"] = self.make("changes", 903, WARM, load, f"{self.fault}@7 {parameter}=1@14")
        if MOTION in self.learned:
            made["far"] = self.make("far", 905, WARM, load, f"{self.fault}@10", speed=4.0)
        return made

    @cached_property
    def learned(self) -> frozenset[str]:
        """The capabilities that the baseline has."""
        one = self.one
        explained = one.exact is not None and one.exact.misfit <= 1.0
        has = {
            COVARIATES: one.covariates is not None,
            FEATURES: one.features is not None,
            REFIT: explained or one.axis is not None,
            SEQUENTIAL: bool(one.thresholds.hypotheses),
            MOTION: one.limited_motion is not None,
            PAST: one.axis is not None or (one.features is not None and one.features.compares_past),
            POINTS: len(self.baseline.points) > 1,
            POPULATION: any(note.key == "learning.population" for note in one.notes),
            TIMELINE: explained and one.axis is None,
        }
        return frozenset(name for name, there in has.items() if there)


def like_machines(baseline: Baseline) -> list[Baseline]:
    """Return baselines of machines that differ from one by some per cent, with both operating points."""
    rng, machines = np.random.default_rng(5), []
    friction = baseline.names.index("viscous_friction")
    for _ in range(MACHINES):
        factors = np.exp(MACHINES_SCATTER * rng.standard_normal(len(baseline.names)))
        machine = baseline.model_copy(update={"point": "cold", "theta": _times(baseline.theta, factors)})
        factors[friction] *= WARMER
        ratios = {
            name: ratio * (WARMER if name == "viscous_friction" else 1.0)
            for name, ratio in baseline.healthy.ratios.items()
        }
        healthy = baseline.healthy.model_copy(update={"ratios": ratios})
        warm = {"point": WARM, "theta": _times(baseline.theta, factors), "healthy": healthy}
        machines.append(machine.model_copy(update={"others": (machine.model_copy(update=warm),)}))
    return machines


def _times(theta: tuple[float, ...], factors: np.ndarray[tuple[int], np.dtype[np.float64]]) -> tuple[float, ...]:
    return tuple((np.array(theta) * factors).tolist())


Outcome = Mapping[str, str]  # capability -> why it does not work; empty where it works


def outcome(home: str, works: Mapping[str, bool], reasons: Mapping[str, str] | None = None) -> Outcome:
    """Return what a home makes of each capability; one that fails without a reason is an error of the home."""
    failed = {name: f"{home}: {name} fails" for name, there in works.items() if not there}
    return dict.fromkeys(works, "") | failed | dict(reasons or {})


def in_diagnose(case: Case) -> Outcome:
    """Judge each recording."""
    said = {name: ss.diagnose(case.baseline, recording) for name, recording in case.recordings.items()}
    return outcome("diagnose", judged({name: one.model_dump(mode="json") for name, one in said.items()}))


def judged(said: Mapping[str, Mapping[str, Any]]) -> dict[str, bool]:
    """Return which capabilities show in the documents of diagnoses, by the name of their recordings."""
    intervals = [interval for name in ("fault", "changes") if name in said for interval in said[name]["intervals"]]
    healthy = said["healthy"]["verdict"] == "healthy"
    return {
        COVARIATES: healthy,
        FEATURES: said["ripple"]["verdict"] == "fault",
        REFIT: any(interval["refit"] is not None for interval in intervals),
        SEQUENTIAL: said["fault"]["verdict"] == "fault",
        MOTION: any(warning["kind"] == "motion" for warning in said.get("far", {"warnings": ()})["warnings"]),
        PAST: said["fault"]["verdict"] == "fault",
        POINTS: healthy and said["healthy"]["point"].startswith(WARM),
        POPULATION: healthy,
        TIMELINE: any(interval["end_interval_s"] is not None for interval in intervals),
    }


def followed(monitor: ss.Monitor, case: Case, fleet: bool) -> dict[str, bool]:
    """Return which capabilities show in the evaluations of a monitor."""
    traces = {}
    for name in ("healthy", "fault", "ripple", *(["far"] if MOTION in case.learned else [])):
        one = case.recordings[name]
        assets = (2, 1) if fleet else 1
        signals = [np.tile(x, assets) for x in (one.r, one.u, one.y, one.restart)]
        channels = {name: np.tile(x, assets) for name, x in one.channels.items()}
        _, trace = monitor.run(monitor.init(), *signals, channels=channels)
        traces[name] = trace.lane(0) if fleet else trace
    quiet = not traces["healthy"].exceeded.any()
    features, far = traces["ripple"].features, traces.get("far")
    return {
        COVARIATES: quiet,
        FEATURES: features is not None and bool(features.max() > 1.0),
        SEQUENTIAL: bool(traces["fault"].level.max() >= 1.0),
        MOTION: far is not None and far.motion is not None and bool(far.motion.max() > UNSEEN_EXCESS),
        PAST: features is not None and bool(traces["fault"].exceeded.any()),
        POINTS: quiet,
        POPULATION: quiet,
    }


def in_monitor(case: Case) -> Outcome:
    """Follow each recording with a monitor of one operating point."""
    works = followed(ss.Monitor(case.one, motion_check=MOTION in case.learned), case, fleet=False)
    return outcome("Monitor", works, dict.fromkeys((REFIT, TIMELINE), ALARM_ONLY))


def in_fleet(case: Case) -> Outcome:
    """Follow each recording with a monitor of two assets."""
    works = followed(ss.Monitor([case.one, case.one], motion_check=MOTION in case.learned), case, fleet=True)
    return outcome("fleet", works, dict.fromkeys((REFIT, TIMELINE), ALARM_ONLY))


def refusal(make: Callable[[], object]) -> str:
    """Return the sentence with which the product refuses; empty where it does not."""
    try:
        make()
    except BaselineError as error:
        return str(error)
    return ""


def in_service(case: Case, folder: Path) -> Outcome:
    """Let a service follow an asset per recording, and read what it has stored."""
    loop = case.one.loop
    case.baseline.save(folder / "baseline.json")
    text = ['name = "hall"', "[service]", 'listen = ""', 'log = "error"', "[store]", 'url = "hall.sqlite"']
    text += ["[diagnosis]", f"window_s = {SECONDS}", f"every_s = {SECONDS / 4.0}", "[sources.line]", 'kind = "replay"']
    text += ["speed = 0.0", "block = 0.5", "start = 2026-01-01T00:00:00Z"]
    for name, recording in case.recordings.items():
        writers.write_recording(folder / f"{name}.csv", recording, loop.columns)
        text += [f"[assets.{name}]", 'baseline = "baseline.json"', f'point = "{WARM}"', 'source = "line"']
        text += [f'files = ["healthy.csv", "{name}.csv"]']
    (folder / "hall.toml").write_text("\n".join(text) + "\n", encoding="utf-8")
    settings = ServiceFile.load(folder / "hall.toml")
    Service(settings, build_components(settings)).run()
    with contextlib.closing(sqlite3.connect(folder / "hall.sqlite")) as store:
        rows = store.execute("SELECT asset, grounds, verdict, document FROM diagnoses ORDER BY t, number").fetchall()
    said: dict[str, dict[str, Any]] = {}
    for asset, grounds, verdict, document in rows:
        found = json.loads(document)
        known = said.setdefault(asset, {"verdict": verdict, "intervals": [], "warnings": [], "point": WARM})
        known["verdict"] = "fault" if "fault" in (verdict, known["verdict"]) else verdict
        if grounds == "full":
            known["intervals"] += found.get("intervals", [])
        known["warnings"] += found.get("warnings", [])
    return outcome("service", judged(said))


def in_lake(case: Case, folder: Path) -> Outcome:
    """Diagnose a lake with an asset per recording."""
    for name, one in case.recordings.items():
        path = folder / "lake" / f"point={WARM}" / f"asset={name}" / f"day={DAY}" / "part-0.parquet"
        path.parent.mkdir(parents=True)
        t = np.datetime64(BEGAN, "us") + np.round(1e6 * one.t).astype("timedelta64[us]")
        pq.write_table(pa.table({"t": t, "r": one.r, "u": one.u, "y": one.y, **one.channels}), path)
    plan = fleet.Plan(Lake.open(str(folder / "lake")), folder / "results", baselines=folder / "baseline.json")
    fleet.run(plan, local(1))
    entries = [json.loads(line) for line in (folder / "results" / "journal.jsonl").read_text().splitlines()[1:]]
    return outcome("lake", judged({entry["asset"]: entry["diagnosis"] for entry in entries}))


def in_c(case: Case) -> Outcome:
    """Export to C what can be exported."""
    reasons, baseline = dict.fromkeys((REFIT, TIMELINE), ALARM_ONLY), case.one
    if FEATURES in case.learned:
        reasons[FEATURES] = reasons[PAST] = refusal(lambda: export_c(baseline))
        baseline = baseline.model_copy(update={"features": None})
    made = export_c(baseline)
    if MOTION in case.learned:
        reasons[MOTION] = UNSEEN_MOTION if UNSEEN_MOTION in made.files["servo_monitor.h"] else ""
    source = made.files["servo_monitor.c"]
    works = {SEQUENTIAL: "update_cusums" in source, COVARIATES: "follow_covariates" in source}
    works |= {POINTS: True, POPULATION: True}
    return outcome("C export", works, reasons)


def homes(case: Case) -> dict[str, Outcome]:
    """Return what each home makes of one machine."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        service = in_service(case, folder)
        lake = in_lake(case, folder)
    return dict(
        zip(HOMES, (in_diagnose(case), in_monitor(case), service, in_fleet(case), lake, in_c(case)), strict=True)
    )


def cell(pair: tuple[str, str], home: str, results: Sequence[tuple[Case, Mapping[str, Outcome]]]) -> str:
    """Return why a pair does not work in a home; empty where it does with one machine."""
    known = [(case, homes) for case, homes in results if case.learned >= set(pair)]
    if not known:
        return unlearned(pair, [case for case, _ in results])
    reasons = [next(filter(None, (homes[home][name] for name in pair)), "") for _, homes in known]
    return "" if "" in reasons else reasons[0]


def unlearned(pair: tuple[str, str], cases: Sequence[Case]) -> str:
    """Return why no machine is learned with both: what `learn` notes, or how the two exclude each other."""
    if set(pair) == {COVARIATES, SEQUENTIAL}:
        notes = [note for case in cases for note in case.one.notes if note.key == "learning.no_test_along"]
        return render(notes[0])
    return HOLDS_ANYWHERE if SEQUENTIAL in pair else LINEAR_ONLY


@with_one_blas_thread
def main() -> None:
    """Run the command line of this process."""
    given = parser(__doc__).parse_args()
    results = [(case, homes(case)) for case in CASES]
    letters: dict[str, str] = {}
    rows = []
    for pair in itertools.combinations(CAPABILITIES, 2):
        cells = []
        for home in HOMES:
            reason = cell(pair, home, results)
            letter = letters.setdefault(reason, string.ascii_lowercase[len(letters)]) if reason else "works"
            cells.append(letter)
        rows.append((*pair, *cells))
    reasons = tuple((letter, reason) for reason, letter in letters.items())
    note = f"{len(rows)} pairs in {len(HOMES)} places; the next table has the reason behind a letter."
    tables = [
        Table("Capabilities: pairs", note, ("capability", "with", *HOMES), tuple(rows)),
        Table("Capabilities: reasons", "A refusal is in the words of the product.", ("", "reason"), reasons),
    ]
    show(tables, given.json)


CASES = (
    Case("motor", motor, MOTOR, (None,) * 5, "viscous_friction=1.5", 0.05),
    Case("loaded motor", motor, MOTOR | LOGGED, LOADS, "viscous_friction=1.5", 0.05),
    Case("axis", axis, AXIS | LOGGED, LOADS, "coulomb_friction=1.5", 0.3),
)
