"""The whole job on recorded loops: what is found, named and missed; prints Markdown tables.

    python benchmarks studies/recordings [--data DIR] [--json]

The loop files are those of `examples/` and the reference rig inside the package. Every baseline is learned from
recordings that are not judged with it.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path

from studies.recording_values import values
from tables import Table, parse_with_data, parser, show

import servoscope as ss
from servoscope.diagnosis.diagnose import diagnose_with_trace

ROOT = Path(__file__).resolve().parents[2]
RIG = Path(str(files("servoscope"))) / "simulation" / "reference-rig.toml"
AUTHORS = {"inertia": 95.1089, "viscous_friction": 203.5034, "coulomb_friction": 20.3935, "offset": -3.1648}


@dataclass(frozen=True)
class Judged:
    """A recording with its diagnosis, the largest statistic and the seconds that judging it took."""

    diagnosis: ss.Diagnosis
    statistic: float
    threshold: float
    seconds: float

    @classmethod
    def of(cls, baseline: ss.Baseline, recording: ss.Recording) -> Judged:
        """Diagnose a recording."""
        start = time.perf_counter()
        diagnosis, trace = diagnose_with_trace(baseline, recording)
        seconds = time.perf_counter() - start
        top = max((float(T2) for T2 in trace.statistic[trace.ready]), default=0.0)
        return cls(diagnosis, top, baseline.thresholds.statistic, seconds)

    @property
    def candidate(self) -> str:
        """The best explanation with its probability and size."""
        if not self.diagnosis.candidates:
            return f"none: {self.diagnosis.verdict}"
        best = self.diagnosis.candidates[0]
        sizes = [f" x {fault.ratio:.4g} ({fault.interval[0]:.4g} to {fault.interval[1]:.4g})" for fault in best.faults]
        return f"{best.name}{''.join(sizes)}, {_share(best.probability)}"

    @property
    def named(self) -> str:
        """What the verdict names: a fault with its probability, or that nothing was named."""
        d = self.diagnosis
        if d.verdict != "fault":
            return d.verdict
        if d.faults:
            return f"{d.faults[0].name}, {_share(d.probability or 0.0)}"
        return "fault, not named: " + " or ".join(f"{c.name} {c.probability:.0%}" for c in d.candidates[:2])


def _share(probability: float) -> str:
    return "> 99.9 %" if probability > 0.999 else f"{100.0 * probability:.1f} %"


def reference_rig(data: Path) -> Iterator[Table]:
    """Faults in an independent simulator of the reference rig, judged with the baseline of two references."""
    folder = data / "eha_cases"
    loop = ss.Loop.load(RIG)
    cases = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    healthy = {kind: f"{kind}_healthy_{i}.csv" for kind, i in (("profile", 0), ("multisine", 2), ("trapezoid", 4))}
    learned = {kind: ss.learn(loop, [ss.read(folder / file, loop)]) for kind, file in healthy.items()}
    rows = []
    for case in cases:
        if case["file"] in healthy.values():
            continue
        recording = ss.read(folder / case["file"], loop)
        kind = case["reference"]
        own = Judged.of(learned[kind], recording)
        foreign = Judged.of(learned["multisine" if kind == "profile" else "profile"], recording)
        truth = " and ".join(f"{name} x {ratio:g}" for name, ratio in case["ratios"].items()) or "healthy"
        late = own.diagnosis.detected_at_s
        after = "" if late is None else f"{late - case['fault_at_s']:.2f} s"
        sized = own.candidate if own.diagnosis.faults else own.named
        rows.append((case["file"].removesuffix(".csv"), truth, after, sized, foreign.named, f"{own.seconds:.2f} s"))
    yield Table(
        "Reference rig",
        "Recordings of an independent simulator, 60 s at 100 Hz, faults from 30 s on. One baseline per reference, each "
        "from one healthy recording of 60 s. Foreign reference: baseline from the profile, and from the multisine "
        "for recordings of the profile.",
        ("recording", "truth", "detected after", "own reference", "foreign reference", "time"),
        tuple(rows),
    )


def emps(data: Path) -> Iterator[Table]:
    """Parameters of the positioning axis against its authors', and one half of the recording against the other."""
    loop = ss.Loop.load(ROOT / "examples" / "emps.toml")
    whole = ss.read(data / "real" / "emps" / "DATA_EMPS.mat", loop)
    settings = loop.to_dict()
    settings["plant"]["friction"] = "directional"
    directional = ss.Loop.from_dict(settings)
    baseline, refined = ss.learn(loop, [whole]), ss.learn(directional, [whole])
    sigma = baseline.covariance_array().diagonal() ** 0.5
    rows = []
    for name, value, std in zip(baseline.names, baseline.theta, sigma, strict=True):
        off = f"{100.0 * (value / AUTHORS[name] - 1.0):+.2f} %"
        rows.append((name, f"{value:.2f}", f"{std:.2f}", f"{AUTHORS[name]:.2f}", off))
    shares = [learned.detectability.explained for learned in (baseline, refined)]
    yield Table(
        "EMPS: parameters",
        f"Measured positioning axis, {whole.duration_s:.1f} s at 1 kHz. The model explains {shares[0]:.2%} of "
        f"the variance of u; with friction by direction, {shares[1]:.2%} (residual variance "
        f"{refined.recursion.R / baseline.recursion.R:.2f} times as large).",
        ("coefficient", "learned", "std. dev.", "authors", "difference"),
        tuple(rows),
    )
    half = whole.duration_s / 2.0
    first, second = whole.part(0.0, half), whole.part(half, whole.duration_s + 1.0)
    halves = []
    for label, one, other in (("first, second", first, second), ("second, first", second, first)):
        judged = Judged.of(ss.learn(loop, [one]), other)
        halves.append((label, judged.named, _ratio(judged), f"{judged.seconds:.2f} s"))
    yield Table(
        "EMPS: halves",
        f"Learned from one half of {half:.1f} s, the other judged. {_promised(ss.learn(loop, [first]))}",
        ("learned from, judged", "verdict", "largest T^2 / threshold", "time"),
        tuple(halves),
    )


def injected(data: Path) -> Iterator[Table]:
    """Add changes to u of measured recordings, from half-way on."""
    rows = []
    emps_loop, qube_loop = (ss.Loop.load(ROOT / "examples" / f"{name}.toml") for name in ("emps", "qube"))
    whole = ss.read(data / "real" / "emps" / "DATA_EMPS.mat", emps_loop)
    half = whole.t[0] + whole.duration_s / 2.0
    runs = [ss.read(path, qube_loop) for path in sorted((data / "real" / "qube").glob("*.csv"))]
    for machine, loop, healthy, judged in (
        ("EMPS, second half", emps_loop, [whole.part(0.0, half)], whole.part(half, whole.t[-1] + 1.0)),
        ("QUBE, run 3", qube_loop, runs[:2], runs[2]),
    ):
        baseline = ss.learn(loop, healthy)
        for name in ("inertia", "viscous_friction", "input_gain"):
            changed, at = change_u(judged, baseline, name)
            said = Judged.of(baseline, changed)
            d = said.diagnosis
            late = "" if d.detected_at_s is None else f"{d.detected_at_s - at:.1f} s"
            onset = "" if d.onset_s is None else " ".join(f"{x - at:+.1f}" for x in d.onset_s)
            rows.append((machine, f"{name} x {1.1 if name == 'input_gain' else 1.3}", late, said.candidate, onset))
    yield Table(
        "Injected changes",
        "u of the measured recording is raised by 30 % of a coefficient's share, or by 10 % altogether, from half-way "
        "on. Best candidate with size, 95 % interval and probability; it is named from 95 % on. Onset: 95 % interval "
        "and likeliest time (in the middle) against the truth.",
        ("recording", "truth", "detected after", "best candidate", "onset - truth [s]"),
        tuple(rows),
    )


def pump(data: Path) -> Iterator[Table]:
    """Judge loads of the pump-controlled cylinder; load 1 with the long stroke is the baseline."""
    folder = data / "real" / "eha_pump"
    loop = ss.Loop.load(ROOT / "examples" / "eha-pump.toml")
    baseline = ss.learn(loop, [ss.read(folder / "exp_data_1_4.csv", loop)])
    rows = []
    for load, stroke in ((1, 3), (3, 2), (3, 4), (5, 2), (5, 4)):
        judged = Judged.of(baseline, ss.read(folder / f"exp_data_{load}_{stroke}.csv", loop))
        rows.append((str(load), str(stroke), judged.named, _ratio(judged), f"{judged.seconds:.2f} s"))
    explained = baseline.detectability.explained
    yield Table(
        "Pump-controlled EHA",
        f"Measured, 31 s at 1 kHz each. Learned from load 1, stroke 4 (explained {explained:.2%} of u's variance). "
        "A load is no fault, and no coefficient of the model: it has to be found and must not be named. "
        + _promised(baseline),
        ("load", "stroke", "verdict", "largest T^2 / threshold", "time"),
        tuple(rows),
    )


def qube(data: Path) -> Iterator[Table]:
    """Healthy runs of the pendulum against each other."""
    loop = ss.Loop.load(ROOT / "examples" / "qube.toml")
    runs = [ss.read(path, loop) for path in sorted((data / "real" / "qube").glob("*.csv"))]
    rows = []
    for i, run in enumerate(runs):
        others = [j for j in range(len(runs)) if j != i]
        for chosen in [others, *([j] for j in others)]:
            judged = Judged.of(ss.learn(loop, [runs[j] for j in chosen]), run)
            words = " and ".join(str(j + 1) for j in chosen)
            rows.append((words, str(i + 1), judged.named, _ratio(judged), f"{judged.seconds:.2f} s"))
    yield Table(
        "QUBE",
        f"Measured, three healthy runs of 20 s at 500 Hz, model_error = {loop.monitor.model_error:g}; "
        f"{ss.learn(loop, runs).detectability.explained:.1%} of the variance of u explained. "
        + _promised(ss.learn(loop, runs)),
        ("learned from", "judged", "verdict", "largest T^2 / threshold", "time"),
        tuple(rows),
    )


def cranfield(data: Path) -> Iterator[Table]:
    """Alarms per load and seeded fault of the ball screw."""
    folder = data / "real" / "cranfield"
    loop = ss.Loop.load(ROOT / "examples" / "cranfield.toml")
    rows, promised = [], ""
    for load in ("20", "40", "-40"):
        where = {"load": load, "run": "1-5"}
        baseline = ss.learn(loop, ss.read_parts(folder / "normal.csv", loop, where=where, by="run"))
        promised = promised or _promised(baseline)
        cells = []
        seconds: list[float] = []
        for file, runs in (("normal", "6-10"), ("backlash2", "1-10"), ("lackLubrication1", "1-10")):
            where = {"load": load, "run": runs}
            parts = ss.read_parts(folder / f"{file}.csv", loop, where=where, by="run")
            judged = [Judged.of(baseline, part) for part in parts]
            count = sum(one.diagnosis.verdict in ("suspect", "fault") for one in judged)
            names = sorted({one.diagnosis.faults[0].name for one in judged if one.diagnosis.faults})
            cells.append(f"{count} of {len(judged)}" + (f" ({', '.join(names)})" if names else ""))
            if file == "normal":
                cells.append(f"{max(one.statistic / one.threshold for one in judged):.2f}")
            seconds += [one.seconds for one in judged]
        mean = sum(seconds) / len(seconds)
        rows.append((f"{load} kgf", f"{baseline.detectability.explained:.1%}", *cells, f"{mean:.2f} s"))
    yield Table(
        "Cranfield ball screw",
        "Measured, runs of 65 s at 25 Hz; u is a stepper's current. Learned per load from healthy runs 1 to 5. Alarms "
        "out of runs, and in brackets which coefficients were named. At 20 kgf: " + promised,
        (
            "load",
            "explained",
            "healthy, runs 6 to 10",
            "their largest T^2 / threshold",
            "backlash",
            "lack of lubrication",
            "time per run",
        ),
        tuple(rows),
    )


def change_u(recording: ss.Recording, baseline: ss.Baseline, name: str) -> tuple[ss.Recording, float]:
    """Return the recording with a change from half-way on, and when that is [s]."""
    from scipy.signal import savgol_filter

    half = recording.samples // 2
    u = recording.u.copy()
    if name == "input_gain":
        u[half:] *= 1.1
    else:
        window = int(0.1 * recording.sample_rate) // 2 * 2 + 1
        order = {"viscous_friction": 1, "inertia": 2}[name]
        derivative = savgol_filter(recording.y, window, 3, deriv=order, delta=1.0 / recording.sample_rate)
        coefficient = baseline.theta[baseline.names.index(name)] / baseline.loop.plant.input_gain
        u[half:] += 0.3 * coefficient * derivative[half:]
    return replace(recording, u=u), float(recording.t[half])


def _promised(baseline: ss.Baseline) -> str:
    told = [f"{p.name} {p.change:.0%}" for p in baseline.detectability.changes if p.change is not None]
    return f"Promised to be seen from a change of: {', '.join(told)}."


def _ratio(judged: Judged) -> str:
    return f"{judged.statistic / judged.threshold:.2f}"


def main() -> None:
    """Run the command line of this process."""
    given = parse_with_data(parser(__doc__), "eha_cases")
    jobs = (reference_rig, emps, pump, qube, injected, cranfield)
    tables = [table for job in jobs for table in job(given.data)]
    show(tables, given.json, values({table.title: table for table in tables}))
