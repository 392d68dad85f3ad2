"""The exported monitor in C beside `Monitor.run`, bit by bit, by compiler, option and processor; its size and cost.

python benchmarks studies/export [--samples 10000000] [--emulated 200000] [--json]

Other processors are emulated by QEMU. Instructions of a Cortex-M7 are counted: code for it, linked into a program that
QEMU runs one instruction at a time. That is no count of cycles.
"""

from __future__ import annotations

import itertools
import re
import shutil
import subprocess
import tempfile
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from tables import Table, parser, show

from servoscope import learn
from servoscope.baseline.baseline import Baseline
from servoscope.detection.statistic import apply_alarm_delays, consecutive_exceedances
from servoscope.diagnosis.monitor import Monitor
from servoscope.export import NAME, CMonitor, export_c, unpack_image
from servoscope.export.golden import frozen_signals
from servoscope.models.loop import Loop
from servoscope.signals.quality import QualitySettings
from servoscope.simulation import FaultEvent, reference, simulate

DRIVER = Path(__file__).with_name("export_driver.c")
RIG = Path(__file__).resolve().parents[2] / "src" / "servoscope" / "simulation" / "reference-rig.toml"
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-ffp-contract=off")
LEVELS = ("-O0", "-O1", "-O2", "-O3")
CHUNK = 200_000  # samples
CORTEX_M7 = ("-mcpu=cortex-m7", "-mfpu=fpv5-d16", "-mfloat-abi=hard", "-mthumb")
PROCESSORS = (  # name, compiler, its options, emulator
    ("x86-64", "gcc", (), ()),
    ("x86-64", "clang", (), ()),
    ("AArch64", "aarch64-linux-gnu-gcc", ("-static",), ("qemu-aarch64",)),
    ("Arm, VFPv4", "arm-linux-gnueabihf-gcc", ("-static", "-mfpu=vfpv4"), ("qemu-arm",)),
    ("Arm, VFPv3", "arm-linux-gnueabihf-gcc", ("-static", "-mfpu=vfpv3-d16"), ("qemu-arm",)),
)
SLOW = 10  # where fma is computed by the C library, a sample takes 20 times as long: so many times fewer samples
COUNTER = """
#include "servo_monitor.h"
#include <stdlib.h>
int main(int count, char **words)
{
    static servo_monitor_state state;
    static servo_monitor_evaluation q;
    const long samples = (count > 1) ? strtol(words[1], 0, 10) : 0;
    double x = 0.0;
    long k;
    servo_monitor_init(&state);
    for (k = 0; k < samples; k++) {
        x = (0.9 * x) + (double)((k * 7919) % 13) - 6.0;
        servo_monitor_step(&state, x, 3.0 * x, 0.5 * x, &q);
    }
    return 0;
}
"""


@dataclass
class Build:
    """One compiled driver, and what its runs showed."""

    processor: str
    compiler: str
    level: str
    command: tuple[str, ...]
    folder: Path
    limit: int  # samples that it takes
    samples: int = 0
    evaluations: int = 0
    different: int = 0
    seconds: float = 0.0
    image: bytes = b""

    def take(self, samples: bytes, count: int, rows: npt.NDArray[np.float64], state: bytes, mark: bytes) -> None:
        """Run a chunk of samples and count the evaluations, and the state at its end, that differ."""
        paths = [self.folder / name for name in ("samples", "image", "rows")]
        paths[0].write_bytes(samples)
        paths[1].write_bytes(self.image)
        done = subprocess.run([*self.command, *map(str, paths)], capture_output=True, text=True, check=True)
        self.image = paths[1].read_bytes()
        found = np.fromfile(paths[2]).reshape(-1, rows.shape[1])
        self.samples, self.evaluations = self.samples + count, self.evaluations + len(rows)
        same = (found.view(np.uint64) == rows.view(np.uint64)).all(axis=1) if found.shape == rows.shape else [False]
        self.different += int(np.count_nonzero(~np.asarray(same))) + (
            unpack_image(self.image, mark)[0].tobytes() != state
        )
        self.seconds += float(done.stdout)


@dataclass
class Verdicts:
    """The verdicts of all evaluations so far, which an alarm's delays carry from chunk to chunk."""

    delays: tuple[int, int]
    exceeded: list[npt.NDArray[np.bool_]] = field(default_factory=list)

    def of(self, trace: Any) -> npt.NDArray[np.float64]:
        """Return the verdicts of a trace that follows those before."""
        memory = sum(self.delays) + 2  # evaluations after which none before them counts
        self.exceeded.append(np.asarray(trace.exceeded & trace.ready))
        past = np.concatenate(self.exceeded)
        if len(self.exceeded) > 1 and len(past) > len(trace.t) + memory:
            run = int(consecutive_exceedances(past[: -len(trace.t)])[-1])
            past = past[-len(trace.t) - max(memory, run + 1) :]
        alarm = apply_alarm_delays(past, *self.delays)[-len(trace.t) :]
        return np.where(trace.ready, np.where(alarm, 2.0, 1.0), 0.0)


def chunks(loop: Loop, limits: Collection[int]) -> Iterator[tuple[npt.NDArray[np.float64], ...]]:
    """Yield r, u, y, restart: by turns multisine and profile, healthy and with a fault, with all that data can have."""
    edges = sorted({*range(0, max(limits), CHUNK), *limits})
    for k, (begin, end) in enumerate(itertools.pairwise(edges)):
        count, rng = end - begin, np.random.default_rng(k)
        seconds = count / loop.sample_rate
        faults = [FaultEvent("C_ie", 1.2, 0.4 * seconds), FaultEvent("C_ie", 1.0, 0.7 * seconds)] if k % 3 else []
        kind = "multisine" if k % 2 else "profile"
        recording = simulate(loop, reference(kind, seconds, loop.sample_rate, seed=k), faults=faults, seed=k)[0]
        signals = [x[:count].copy() for x in (recording.r, recording.u, recording.y)]
        restart = np.zeros(count)
        restart[[0, *rng.integers(0, count, 20)]] = 1.0
        for value in (np.nan, np.inf, -np.inf, 1e150, -0.0):
            for at in rng.integers(0, count - 400, 10):
                signals[int(rng.integers(3))][at : at + int(rng.integers(1, 400))] = value
        for at in rng.integers(0, max(count - 1500, 1), 6):
            frozen = signals[int(rng.integers(1, 3))][at : at + int(rng.integers(400, 1500))]
            frozen[:] = frozen[0]
        yield (*signals, restart)


def rows_of(trace: Any, verdicts: Verdicts, names: int, frozen: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    """Return the evaluations of a trace as the C has them; how many updates there were is not in a trace."""
    H = np.stack([trace.ifrf.H.real, trace.ifrf.H.imag], axis=-1)
    response = np.concatenate([H, trace.ifrf.covariance.reshape(*H.shape[:2], 4)], axis=-1).reshape(len(trace.t), -1)
    theta = [trace.theta, trace.covariance.reshape(-1, names**2)]
    columns = [trace.statistic, trace.level, trace.crossed, *(x for each in theta for x in each.T), *response.T]
    return np.column_stack([*columns, verdicts.of(trace), frozen])


def builds(folder: Path, samples: int, emulated: int, levels: Sequence[str] = LEVELS) -> list[Build]:
    """Compile the driver for every processor, compiler and option; each will take so many samples."""
    made = []
    for processor, compiler, options, emulator in PROCESSORS:
        if not all(map(shutil.which, (compiler, *emulator))):
            raise SystemExit(f"{compiler} or its emulator is missing: scripts/install-test-servers installs it")
        for level in levels:
            slow = "VFPv3" in processor or (
                "VFPv4" in processor and level == "-O0"
            )  # which calls it, and inlines nothing
            limit = emulated // (SLOW if slow else 1) if emulator else samples
            own = folder / f"{processor}-{compiler}{level}"
            own.mkdir()
            command = [
                compiler,
                *STRICT,
                *options,
                level,
                "-I",
                folder,
                "-o",
                own / "driver",
                DRIVER,
                folder / f"{NAME}.c",
            ]
            subprocess.run([*map(str, command), "-lm"], check=True)
            run = (*emulator, str(own / "driver"))
            made.append(Build(processor, compiler, level, run, own, limit))
    return made


def compare(baseline: Baseline, made: Sequence[Build], mark: bytes) -> None:
    """Take the samples through the monitor and through every build."""
    monitor, verdicts = Monitor(baseline), Verdicts(baseline.pipeline().delays)
    state, done, names = monitor.init(), 0, len(baseline.names)
    limits = QualitySettings().limits(baseline.loop.sample_rate)
    for r, u, y, restart in chunks(baseline.loop, {build.limit for build in made}):
        state, trace = monitor.run(state, r, u, y, restart > 0.0)
        every = len(r) // len(trace.t)
        frozen = np.bitwise_or.reduceat(frozen_signals(limits, r, u, y), np.arange(0, len(r), every))
        rows = rows_of(trace, verdicts, names, frozen[: len(trace.t)])
        text = np.column_stack([r, u, y, restart]).tobytes()
        for build in made:
            if done < build.limit:
                build.take(text, len(r), rows, state.tobytes(), mark)
        done += len(r)


def stack_bound(folder: Path, compiler: str, options: Sequence[str], entry: str = f"{NAME}_step") -> int:
    """Return the largest sum of stack frames [bytes] on a path of calls, those of the C library apart."""
    command = [compiler, *STRICT, *options, "-fcallgraph-info=su", "-c", f"{NAME}.c", "-o", "stack.o"]
    subprocess.run(command, cwd=folder, check=True)
    text = next(folder.glob("stack*.ci")).read_text(encoding="utf-8")
    frames = {
        node: int(size)
        for node, size in re.findall(r'node: { title: "([^"]+)" label: "[^"]*?(\d+) bytes \(static\)', text)
    }
    calls: dict[str, list[str]] = {}
    for source, target in re.findall(r'edge: { sourcename: "([^"]+)" targetname: "([^"]+)"', text):
        calls.setdefault(source, []).append(target)

    def deepest(node: str) -> int:
        return frames.get(node, 0) + max(map(deepest, calls.get(node, [])), default=0)

    return deepest(next(node for node in frames if node.split(":")[-1] == entry))


def cortex_m7_instructions(folder: Path, every: int) -> tuple[int, int]:
    """Return the instructions of an ordinary sample, and of one with an evaluation, in code for a Cortex-M7."""
    (folder / "counter.c").write_text(COUNTER, encoding="utf-8")
    code = ["arm-none-eabi-gcc", *STRICT, *CORTEX_M7, "-O2", "-c", f"{NAME}.c", "-o", "m7.o"]
    strip = ["arm-linux-gnueabihf-objcopy", "--remove-section", ".ARM.attributes", "m7.o"]
    link = [
        "arm-linux-gnueabihf-gcc",
        "-static",
        "-O2",
        "-z",
        "noexecstack",
        "-o",
        "counter",
        "counter.c",
        "m7.o",
        "-lm",
    ]
    for command in (code, strip, link):
        subprocess.run(command, cwd=folder, check=True)
    first = 20 * every
    counts = []
    for samples in (first - 2, first - 1, first):
        log = folder / "log"
        run = [
            "qemu-arm",
            "-cpu",
            "max",
            "-singlestep",
            "-d",
            "exec,nochain",
            "-D",
            str(log),
            "./counter",
            str(samples),
        ]
        subprocess.run(run, cwd=folder, check=True)
        with log.open("rb") as lines:
            counts.append(sum(1 for line in lines if line.startswith(b"Trace")))
    return counts[1] - counts[0], counts[2] - counts[1]


def tables_of(folder: Path, made: Sequence[Build], baseline: Baseline, exported: CMonitor) -> list[Table]:
    """Return what the runs showed, and the sizes."""
    rows = [
        (
            *(build.processor, build.compiler, build.level, f"{build.samples:,}".replace(",", " ")),
            *(f"{build.evaluations:,}".replace(",", " "), str(build.different)),
            "" if build.processor != "x86-64" else f"{1e9 * build.seconds / max(build.samples, 1):.0f}",
        )
        for build in made
    ]
    note = (
        "Different: evaluations with verdicts and frozen signals, and states, that have another bit in C than from "
        "`Monitor.run` and from the check of data quality."
    )
    columns = ("processor", "compiler", "option", "samples", "evaluations", "different", "ns per sample")
    ordinary, evaluating = cortex_m7_instructions(folder, baseline.pipeline().constants(baseline.tuning).every)
    stacks = [("x86-64, gcc", "gcc", ()), ("Cortex-M7, gcc", "arm-none-eabi-gcc", CORTEX_M7)]
    size = subprocess.run(["arm-none-eabi-size", "m7.o"], cwd=folder, capture_output=True, text=True, check=True)
    sizes = [
        ("state", f"{exported.state_bytes} B"),
        ("what is known of the signals, for the check for frozen ones", f"{exported.signal_bytes} B"),
        ("constants", f"{exported.constant_bytes} B"),
        ("code and constants, Cortex-M7, -O2", f"{size.stdout.split()[6]} B"),
    ]
    for name, compiler, options in stacks:
        bounds = [f"{level} {stack_bound(folder, compiler, (*options, level))} B" for level in LEVELS]
        sizes.append((f"stack of `step`, {name}", ", ".join(bounds)))
    sizes.append(("instructions of an ordinary sample, Cortex-M7, -O2", str(ordinary)))
    sizes.append(("instructions of a sample with an evaluation, Cortex-M7, -O2", str(evaluating)))
    about = "The demo's baseline. Instructions are counted, not cycles; the stack is without what the C library takes."
    return [
        Table("Bits", note, columns, tuple(rows)),
        Table("Size and cost", about, ("what", "measured"), tuple(sizes)),
    ]


def main() -> None:
    """Run the command line of this process."""
    arguments = parser(__doc__)
    arguments.add_argument("--samples", type=int, default=10_000_000)
    arguments.add_argument("--emulated", type=int, default=200_000, help="samples for emulated processors")
    given = arguments.parse_args()
    loop = Loop.load(RIG)
    baseline = learn(loop, [simulate(loop, reference("profile", 60.0, 100.0), seed=1)[0]])
    with tempfile.TemporaryDirectory() as scratch:
        exported = export_c(baseline)
        exported.save(scratch)
        made = builds(Path(scratch), given.samples, given.emulated)
        compare(baseline, made, exported.mark)
        show(tables_of(Path(scratch), made, baseline, exported), given.json)
