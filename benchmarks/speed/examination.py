"""What it costs a service to examine two minutes of an asset, and how many it examines at a time; Markdown tables.

python benchmarks speed/examination [--json]

120 blocks of a second at 100 Hz, warm, one BLAS thread as in the service; the kinds in turns, in one run. The
verdict is the one of before, as it nearly always is: a new one is stored with its document, which takes longer.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from tables import Table, parser, show
from tools.timing import time_interleaved

import servoscope as ss
from servoscope.core.arrays import IntArray
from servoscope.core.blas import with_one_blas_thread
from servoscope.service.assets.examination import examine_blocks, undetermined
from servoscope.service.assets.examination_schedule import ExaminationState, examination_phase, update_examination
from servoscope.service.config import DiagnosisSettings, shard_number
from servoscope.service.sources.block import Block
from servoscope.simulation import FaultEvent, reference, simulate
from servoscope.simulation.nonlinear_eha import Rig, simulate_rig
from servoscope.simulation.tutorial import AXIS

LOAD = os.getloadavg()[0]
RATE, SECONDS, REPEATS = 100.0, 120.0, 15
EPOCH, HOUR = 1767225600.0, 3600  # s
RIG = ss.Loop.load(Path(ss.__file__).parent / "simulation/reference-rig.toml")
WARMING = RIG.model_copy(update={"columns": RIG.columns.model_copy(update={"covariates": {"oil": "T_oil"}})})
LEAK, WEAR = FaultEvent.parse("C_ie=1.2@60"), FaultEvent.parse("viscous_friction=1.25@60")


def record_rig(seed: int, *faults: FaultEvent) -> ss.Recording:
    """Simulate the hydraulic rig."""
    return simulate(RIG, reference("multisine", SECONDS, RATE), seed=seed, faults=faults)[0]


def record_axis(seed: int, *faults: FaultEvent) -> ss.Recording:
    """Simulate the motor axis of the tutorial."""
    loop, r = ss.Loop.from_dict(AXIS | {"sample_rate": RATE}), reference("trapezoid", SECONDS, RATE)
    return simulate(loop, r, seed=seed, faults=faults, noise_u_std=5e-3, noise_y_std=1e-5)[0]


def record_warm(seed: int, *faults: FaultEvent, start: float = 38.0, rise: float = 12.0) -> ss.Recording:
    """Simulate the rig while its oil warms."""
    rig = replace(Rig.ideal(), temperature=start, warming=rise, warming_time=60.0)
    made, truth = simulate_rig(WARMING, reference("profile", SECONDS, RATE), rig, faults=faults, seed=seed)
    return replace(made, channels={"oil": truth.temperature})


def blocks_of(recording: ss.Recording) -> list[Block]:
    """Return a recording in blocks of a second."""
    signals = [EPOCH + recording.t, recording.r, recording.u, recording.y, *recording.channels.values()]
    parts = np.split(np.stack(signals), int(SECONDS), axis=1)
    return [Block.from_signals("a", k, np.ascontiguousarray(part)) for k, part in enumerate(parts)]


def count_examinations(assets: int, workers: int) -> IntArray:
    """Return how many examinations a service makes in each second of its first hour, if all assets begin at once.

    As its schedule has it: nothing happens to the assets, whose blocks of a second begin at moments of their own.
    """
    settings, count = DiagnosisSettings(), np.zeros(HOUR, dtype=np.int64)
    names = [f"axis-{k:05d}" for k in range(assets)]
    shards = Counter(shard_number(name, workers) for name in names)
    found = undetermined("none").model_copy(update={"verdict": "healthy"})
    for name, begin in zip(names, np.random.default_rng(0).uniform(0.0, 1.0, assets).tolist(), strict=True):
        phase, t = examination_phase(name), EPOCH + begin
        state = ExaminationState.begin(t, settings, phase, shards[shard_number(name, workers)])
        while (t := t + math.ceil(state.due - t)) < EPOCH + HOUR:
            count[int(t - EPOCH)] += 1
            state, _ = update_examination(state, settings, t, False, lambda: found, phase)
    return count


def tabulate_schedule(ms: float) -> Table:
    """Return the table of how many examinations there are at a time, of `ms` each."""
    rows = []
    for assets, workers in ((1000, 1), (10_000, 1), (10_000, 2)):
        count = count_examinations(assets, workers)
        tens = count.reshape(-1, 10).sum(axis=1) / 10.0
        mean, most = count[HOUR // 2 :].mean(), tens.max()
        share = [f"{100.0 * each * ms / 1e3:.1f} %" for each in (mean, most)]
        busiest = f"{10 * tens.argmax()}", f"{mean:.1f}", f"{most:.1f}", f"{count.max()}"
        rows.append((f"{assets}", f"{workers}", *busiest, *share))
    note = (
        "The first hour of assets that begin together and stay healthy, by the schedule alone; two minutes, every ten."
    )
    header = (
        "assets",
        "workers",
        "busiest at, s",
        "later, /s",
        "busiest 10 s, /s",
        "busiest second",
        "later, of a core",
        "busiest 10 s, of a core",
    )
    return Table("Examinations of assets that begin together", note, header, tuple(rows))


def main() -> None:
    """Measure and print."""
    given = parser(__doc__).parse_args()
    axis = ss.learn(ss.Loop.from_dict(AXIS | {"sample_rate": RATE}), [record_axis(seed) for seed in range(6)])
    assert axis.features is not None, "six recordings are enough for features"
    warm = [record_warm(i, start=30.0 + 2.0 * i, rise=5.0 + 5.0 * i) for i in range(6)]
    kinds = {
        "hydraulic axis": (ss.learn(RIG, [record_rig(seed) for seed in range(3)]), record_rig, LEAK),
        "motor axis, with features": (axis, record_axis, WEAR),
        "hydraulic axis, with covariates": (ss.learn(WARMING, warm), record_warm, LEAK),
    }
    jobs = {}
    for name, (baseline, record, fault) in kinds.items():
        for verdict, faults in (("healthy", ()), ("fault", (fault,))):
            blocks = blocks_of(record(100, *faults))
            found = examine_blocks(baseline, "a", blocks).verdict
            assert found == verdict, f"{name}: {found} instead of {verdict}"
            jobs[name, verdict] = partial(examine_blocks, baseline, "a", blocks, known=found)
    timings = with_one_blas_thread(time_interleaved)(jobs, REPEATS)
    ms = {key: 1e3 * timing.processor for key, timing in timings.items()}
    rows = tuple(
        (
            name,
            f"{ms[name, 'healthy']:.1f}",
            f"{ms[name, 'fault']:.1f}",
            f"{100.0 * ms[name, 'healthy'] * 10_000 / 600_000:.0f} %",
        )
        for name in kinds
    )
    note = f"Two minutes at 100 Hz; medians of {REPEATS} runs in turns; load average before {LOAD:.1f}."
    header = ("baseline", "healthy, ms", "fault, ms", "10 000 healthy assets every ten minutes, of a core")
    schedule = tabulate_schedule(ms["hydraulic axis", "healthy"])
    show([Table("Cost of an examination", note, header, rows), schedule], given.json)
