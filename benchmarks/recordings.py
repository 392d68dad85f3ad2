"""The whole job on recorded loops: what is found, named and missed, and how long it takes; prints Markdown tables.

    python benchmarks/recordings.py [--data DIR] [--json] [--no-timings]

The loop files are those of `examples/` and the reference rig inside the package. Every baseline is learned from
recordings that are not judged with it.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path

import servoscope as ss
from servoscope.monitor import examine

ROOT = Path(__file__).resolve().parent.parent
RIG = Path(str(files("servoscope"))) / "examples" / "reference-rig.toml"
BUSY = 1.0  # load average from which timings are marked
REPEATS = 5
AUTHORS = {"inertia": 95.1089, "viscous_friction": 203.5034, "coulomb_friction": 20.3935, "offset": -3.1648}


@dataclass(frozen=True)
class Table:
    """One table of results: a title, what it shows, column heads and rows of text."""

    title: str
    note: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def markdown(self) -> str:
        """Return the table with its heading."""
        lines = [self.columns, ("---",) * len(self.columns), *self.rows]
        table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
        return f"## {self.title}\n\n{self.note}\n\n{table}\n"


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
        diagnosis, trace = examine(baseline, recording)
        seconds = time.perf_counter() - start
        top = float(trace.statistic[trace.ready].max(initial=0.0))
        return cls(diagnosis, top, trace.threshold, seconds)

    @property
    def candidate(self) -> str:
        """The best explanation with its probability and size."""
        if not self.diagnosis.candidates:
            return ""
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
        rows.append((kind, truth, after, sized, foreign.named, f"{own.seconds:.2f} s"))
    yield Table(
        "Reference rig",
        "Recordings of an independent simulator, 60 s at 100 Hz, faults from 30 s on. One baseline per reference, each "
        "from one healthy recording of 60 s. Foreign reference: baseline from the profile, and from the multisine "
        "for recordings of the profile.",
        ("reference", "truth", "detected after", "own reference", "foreign reference", "time"),
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
    sigma = baseline.cov().diagonal() ** 0.5
    rows = []
    for name, value, std in zip(baseline.names, baseline.theta, sigma, strict=True):
        off = f"{100.0 * (value / AUTHORS[name] - 1.0):+.2f} %"
        rows.append((name, f"{value:.2f}", f"{std:.2f}", f"{AUTHORS[name]:.2f}", off))
    yield Table(
        "EMPS: parameters",
        f"Measured positioning axis, {whole.duration_s:.1f} s at 1 kHz. The model explains {baseline.explained:.2%} of "
        f"the variance of u; with friction by direction, {refined.explained:.2%} (residual variance "
        f"{refined.R / baseline.R:.2f} times as large).",
        ("coefficient", "learned", "std. dev.", "authors", "difference"),
        tuple(rows),
    )
    half = whole.duration_s / 2.0
    first, second = whole.part(0.0, half), whole.part(half, whole.duration_s + 1.0)
    rows = []
    for label, one, other in (("first, second", first, second), ("second, first", second, first)):
        judged = Judged.of(ss.learn(loop, [one]), other)
        rows.append((label, judged.named, _ratio(judged), f"{judged.seconds:.2f} s"))
    yield Table(
        "EMPS: halves",
        f"Learned from one half of {half:.1f} s, the other judged.",
        ("learned from, judged", "verdict", "largest T^2 / threshold", "time"),
        tuple(rows),
    )


def pump(data: Path) -> Iterator[Table]:
    """Loads of the pump-controlled cylinder; load 1 with the long stroke is the baseline."""
    folder = data / "real" / "eha_pump"
    loop = ss.Loop.load(ROOT / "examples" / "eha-pump.toml")
    baseline = ss.learn(loop, [ss.read(folder / "exp_data_1_4.csv", loop)])
    rows = []
    for load, stroke in ((1, 3), (3, 2), (3, 4), (5, 2), (5, 4)):
        judged = Judged.of(baseline, ss.read(folder / f"exp_data_{load}_{stroke}.csv", loop))
        rows.append((str(load), str(stroke), judged.named, _ratio(judged), f"{judged.seconds:.2f} s"))
    yield Table(
        "Pump-controlled EHA",
        f"Measured, 31 s at 1 kHz each. Learned from load 1, stroke 4 (explained {baseline.explained:.2%} of u's "
        "variance). A load is no fault, and no coefficient of the model: it has to be found and must not be named.",
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
        f"Measured, three healthy runs of 20 s at 500 Hz, model_error = {loop.monitor.model_error:g}.",
        ("learned from", "judged", "verdict", "largest T^2 / threshold", "time"),
        tuple(rows),
    )


def cranfield(data: Path) -> Iterator[Table]:
    """Alarms per load and seeded fault of the ball screw."""
    folder = data / "real" / "cranfield"
    loop = ss.Loop.load(ROOT / "examples" / "cranfield.toml")
    rows = []
    for load in ("20", "40", "-40"):
        where = {"load": load, "run": "1-5"}
        baseline = ss.learn(loop, ss.read_parts(folder / "normal.csv", loop, where=where, by="run"))
        cells = []
        seconds: list[float] = []
        for file, runs in (("normal", "6-10"), ("backlash2", "1-10"), ("lackLubrication1", "1-10")):
            where = {"load": load, "run": runs}
            parts = ss.read_parts(folder / f"{file}.csv", loop, where=where, by="run")
            judged = [Judged.of(baseline, part) for part in parts]
            count = sum(one.diagnosis.verdict == "fault" for one in judged)
            names = sorted({one.diagnosis.faults[0].name for one in judged if one.diagnosis.faults})
            cells.append(f"{count} of {len(judged)}" + (f" ({', '.join(names)})" if names else ""))
            seconds += [one.seconds for one in judged]
        mean = sum(seconds) / len(seconds)
        rows.append((f"{load} kgf", f"{baseline.explained:.1%}", *cells, f"{mean:.2f} s"))
    yield Table(
        "Cranfield ball screw",
        "Measured, runs of 65 s at 25 Hz; u is a stepper's current. Learned per load from healthy runs 1 to 5. Alarms "
        "out of runs, and in brackets which coefficients were named.",
        ("load", "explained", "healthy, runs 6 to 10", "backlash", "lack of lubrication", "time per run"),
        tuple(rows),
    )


def timings(_: Path) -> Iterator[Table]:
    """Wall times of the command line as a user sees them, and of the recursion alone."""
    loop = ss.Loop.load(RIG)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        at = Path(folder)
        command = [sys.executable, "-m", "servoscope"]
        _run([*command, "simulate", str(RIG), "-o", str(at / "h.csv"), "--seed", "1"])
        _run([*command, "simulate", str(RIG), "-o", str(at / "s.csv"), "--seed", "2", "--fault", "C_ie=1.2@30"])
        _run([*command, "learn", str(RIG), str(at / "h.csv"), "-o", str(at / "b.json")])
        for words, arguments in (
            ("import servoscope, minus a bare interpreter", None),
            ("servoscope --help", ["--help"]),
            ("servoscope learn, 60 s at 100 Hz", ["learn", str(RIG), str(at / "h.csv"), "-o", str(at / "b2.json")]),
            ("servoscope diagnose, 60 s at 100 Hz, healthy", ["diagnose", str(at / "b.json"), str(at / "h.csv")]),
            ("servoscope diagnose, 60 s at 100 Hz, fault", ["diagnose", str(at / "b.json"), str(at / "s.csv")]),
        ):
            if arguments is None:
                bare = _median(lambda: _run([sys.executable, "-c", "pass"]))
                seconds = _median(lambda: _run([sys.executable, "-c", "import servoscope"])) - bare
            else:
                seconds = _median(lambda words=arguments: _run([*command, *words]))
            rows.append((words, f"{seconds:.3f} s"))
        baseline = ss.Baseline.load(at / "b.json")
        recording = ss.read(at / "s.csv", loop)
    monitor = ss.Monitor(baseline)
    signals = (recording.r, recording.u, recording.y)
    seconds = _median(lambda: monitor.run(monitor.init(), *signals))
    rows.append(("Monitor.run, per sample", f"{1e6 * seconds / recording.samples:.2f} us"))
    state = monitor.init()
    seconds = _median(lambda: [monitor.step(state, *sample) for sample in zip(*signals, strict=True)])
    rows.append(("Monitor.step, per sample, called from Python", f"{1e6 * seconds / recording.samples:.2f} us"))
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    busy = f"; **the machine was busy (load {load:.1f}), to be repeated**" if load >= BUSY else ""
    yield Table(
        "Timings",
        f"Wall time, median of {REPEATS} after a first run that is not counted (it compiles, once per installation); "
        f"each command in a process of its own{busy}.",
        ("what", "time"),
        tuple(rows),
    )


def _run(command: Sequence[str]) -> None:
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def _median(job: Callable[[], object]) -> float:
    seconds = []
    for _ in range(REPEATS + 1):
        start = time.perf_counter()
        job()
        seconds.append(time.perf_counter() - start)
    return sorted(seconds[1:])[REPEATS // 2]


def _ratio(judged: Judged) -> str:
    return f"{judged.statistic / judged.threshold:.2f}"


def machine() -> str:
    """Say in a line when and on what this ran."""
    import numba
    import numpy

    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        lines = info.read_text(encoding="utf-8").splitlines()
        model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), model)
    versions = f"Python {platform.python_version()}, numpy {numpy.__version__}, numba {numba.__version__}"
    return f"servoscope {ss.__version__}, {time.strftime('%Y-%m-%d')}, {os.cpu_count()} cores of {model}, {versions}"


def main() -> None:
    """Run the command line of this process."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the recordings")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of Markdown")
    parser.add_argument("--no-timings", action="store_true", help="leave out the wall times of the command line")
    given = parser.parse_args()
    if not (given.data / "eha_cases").is_dir():
        parser.error(f"{given.data}: no recordings there; name their folder with --data")
    jobs = [reference_rig, emps, pump, qube, cranfield, *([] if given.no_timings else [timings])]
    tables = [table for job in jobs for table in job(given.data)]
    if given.json:
        print(json.dumps({"machine": machine(), "tables": [asdict(table) for table in tables]}, indent=1))
    else:
        print("\n".join([f"{machine()}\n", *(table.markdown() for table in tables)]), end="")


if __name__ == "__main__":
    main()
