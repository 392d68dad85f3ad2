"""How fast fleets are: one machine, Spark's tasks, DataFrames and streams on the same lake; rows per second.

    python benchmarks speed/engines FOLDER [--assets 8] [--minutes 5] [--rate 1000] [--window 10]
    python benchmarks speed/engines FOLDER --messages --assets 1000 --minutes 8 --rate 100 [--json]

The lake is made in FOLDER unless it is there. Processor time counts all processes, those of Spark included. With
--messages a stream is measured whose rows are messages of a second, a minute of all assets per micro-batch.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from tables import Table, show

from servoscope import fleet
from servoscope.baseline.baseline import Baseline
from servoscope.fleet import Lake, Plan
from servoscope.learning.learn import learn_baseline
from servoscope.models.loop import Loop
from servoscope.simulation import reference, simulate

RIG = Path(__file__).parents[2] / "src/servoscope/simulation/reference-rig.toml"
DAYS = ("2026-11-01", "2026-11-02")


def loop_at(rate: float) -> Loop:
    """Return the reference rig, sampled at a rate and looked at once a second."""
    content = Loop.load(RIG).to_dict()
    return Loop.from_dict(content | {"sample_rate": rate, "monitor": content["monitor"] | {"evaluation_rate": 1.0}})


def make(folder: Path, assets: int, minutes: float, rate: float) -> int:
    """Write a lake of healthy assets, two days each, and return its rows."""
    loop, rows = loop_at(rate), 0
    r = reference("multisine", 60.0 * minutes, rate)
    x = simulate(loop, r, seed=1)[0]
    for asset in range(assets):
        noise = np.random.default_rng(asset)
        for day in DAYS:
            path = folder / "lake" / f"asset=P{asset:03d}" / f"day={day}" / "part-0.parquet"
            rows += x.samples
            if path.exists():
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            t = np.datetime64(f"{day}T06:00:00", "us") + np.round(1e6 * x.t).astype("timedelta64[us]")
            y = x.y + 1e-9 * noise.normal(size=x.samples)
            pq.write_table(pa.table({"t": t, "r": x.r, "u": x.u, "y": y}), path, row_group_size=100_000)
    file = folder / "baseline.json"
    if not file.exists():
        learn_baseline(loop, [simulate(loop, r[: int(30 * rate)], seed=2)[0]]).save(file)
    return rows


def make_messages(folder: Path, assets: int, minutes: int, rate: float) -> None:
    """Write a minute of messages of a second per file, all assets in it; with the baseline."""
    loop, n = loop_at(rate), round(rate)
    r = reference("multisine", 60.0 * minutes, rate)
    x, noise = simulate(loop, r, seed=1)[0], np.random.default_rng(3)
    learn_baseline(loop, [simulate(loop, r[: 60 * n], seed=2)[0]]).save(folder / "baseline.json")
    (folder / "messages").mkdir()
    names = [f"P{asset:05d}" for asset in range(assets)]
    offsets = pa.array(range(0, 60 * assets * n + 1, n), pa.int32())
    begin = np.datetime64(f"{DAYS[0]}T06:00:00", "us")
    for minute in range(minutes):
        seconds = np.arange(60 * minute, 60 * minute + 60)
        once = {name: getattr(x, name)[60 * minute * n :][: 60 * n].reshape(60, 1, n) for name in "ruy"}
        signals = {name: np.broadcast_to(values, (60, assets, n)) for name, values in once.items()}
        signals["y"] = signals["y"] + 1e-9 * noise.normal(size=(60, assets, n))
        lists = {name: pa.ListArray.from_arrays(offsets, values.ravel()) for name, values in signals.items()}
        t = begin + np.repeat(seconds, assets).astype("timedelta64[s]")
        table = pa.table({"asset": names * 60, "t": t, "dt": np.full(len(t), 1.0 / rate), **lists})
        path = folder / "messages" / f"{minute:04d}.parquet"
        pq.write_table(table, path, row_group_size=5000)
        os.utime(path, (1e9 + minute, 1e9 + minute))  # Spark takes them in this order


def measured(name: str, rows: int, work: Callable[[], object], pids: Callable[[], list[int]] = list) -> None:
    """Print rows per second and processor time per row."""
    begin, used = time.perf_counter(), cpu(pids())
    work()
    wall, own = time.perf_counter() - begin, cpu(pids()) - used
    print(f"{name:28s} {rows / wall:12.3g} rows/s {1e9 * own / rows:10.0f} ns of processor per row {wall:8.1f} s")


def cpu(pids: list[int]) -> float:
    """Return the processor time of this process, of children that have ended, and of others that run [s]."""
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    total = sum(one.ru_utime + one.ru_stime for one in both)
    tick = os.sysconf("SC_CLK_TCK")
    for pid in pids:
        with suppress(OSError):  # it has ended; its parent counts it
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
            total += sum(map(int, fields[11:15])) / tick
    return total


def descendants() -> list[int]:
    """Return the processes under this one."""
    parents: dict[int, int] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            text = path.read_text()
        except OSError:
            continue
        parents[int(path.parent.name)] = int(text.rpartition(")")[2].split()[1])
    found = [os.getpid()]
    for pid in found:
        found += [child for child, parent in parents.items() if parent == pid]
    return found[1:]


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--assets", type=int, default=8)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--rate", type=float, default=1000.0)
    parser.add_argument("--window", type=float, default=10.0, help="seconds that a diagnosis sees")
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--messages", action="store_true", help="measure a stream of messages, and nothing else")
    parser.add_argument("--json", action="store_true", help="with --messages: print one JSON object")
    asked = parser.parse_args()
    if asked.messages:
        table = stream_of_messages(asked.folder, asked.assets, round(asked.minutes), asked.rate, asked.cores)
        return show([table], asked.json)
    rows = make(asked.folder, asked.assets, asked.minutes, asked.rate)
    lake = str(asked.folder / "lake")
    file = asked.folder / "baseline.json"

    def plan(name: str) -> Plan:
        shutil.rmtree(asked.folder / name, ignore_errors=True)
        return Plan(Lake.open(lake), asked.folder / name, baselines=file, window_s=asked.window)

    print(f"{asked.assets} assets, {rows} rows at {asked.rate:g} Hz")
    fleet.run(plan("warm"), fleet.local(1))  # machine code is made once
    measured("local, 1 process", rows, lambda: fleet.run(plan("one"), fleet.local(1)))
    measured(f"local, {asked.cores} processes", rows, lambda: fleet.run(plan("many"), fleet.local(asked.cores)))

    for cores in (1, asked.cores):
        on_spark(asked.folder, lake, rows, cores, asked.window, plan)


def session_of(cores: int) -> Any:
    """Start Spark on so many cores of this machine."""
    from servoscope.fleet import spark

    return spark.session(
        f"local[{cores}]",
        spark__driver__memory="2g",
        spark__ui__enabled="false",
        spark__ui__showConsoleProgress="false",
        spark__driver__bindAddress="127.0.0.1",
        spark__driver__host="127.0.0.1",
        spark__sql__shuffle__partitions=str(2 * cores),
        spark__log__level="OFF",
    )


def stream_of_messages(folder: Path, assets: int, minutes: int, rate: float, cores: int) -> Table:
    """Return what a sample of a stream of messages costs, micro-batch by micro-batch."""
    from servoscope.fleet import sinks, streaming

    if not (folder / "baseline.json").exists():
        folder.mkdir(parents=True, exist_ok=True)
        make_messages(folder, assets, minutes, rate)
    session, baseline = session_of(cores), Baseline.load(folder / "baseline.json")
    shutil.rmtree(folder / "stream", ignore_errors=True)
    options = {"maxFilesPerTrigger": "1"}
    stream = sinks.file_stream(session, str(folder / "messages"), baseline.loop.columns, options)
    query = sinks.start(streaming.follow(stream, baseline, assets=assets), folder / "stream", every_s=None)
    cells, samples = [], 60 * assets * rate
    before, used = time.perf_counter(), cpu(descendants())
    for number in range(minutes):
        while query.isActive and not (folder / f"stream/results/batch={number:09d}/_SUCCESS").exists():
            time.sleep(0.1)
        now, total = time.perf_counter(), cpu(descendants())
        cells.append((str(number + 1), f"{1e9 * (total - used) / samples:.0f}", f"{samples / (now - before):.3g}"))
        before, used = now, total
    sinks.wait_for_stream(query)
    session.stop()
    note = (
        f"{assets} assets at {rate:g} Hz, messages of a second in Parquet, {samples:.3g} samples per micro-batch, on "
        f"{cores} cores; each batch follows what the one before has stored, the first has nothing to follow and starts "
        f"up. Load average {os.getloadavg()[0]:.1f}."
    )
    return Table("Stream of messages", note, ("micro-batch", "ns of processor per sample", "samples/s"), tuple(cells))


def on_spark(folder: Path, lake: str, rows: int, cores: int, window: float, plan: Callable[[str], Plan]) -> None:
    """Measure Spark on so many cores."""
    from servoscope.fleet import sinks, spark, streaming

    session = session_of(cores)
    at = f"Spark local[{cores}]"
    session.range(2).count()
    measured(f"{at}, tasks", rows, lambda: fleet.run(plan("tasks"), spark.spark(session)), descendants)
    baseline = Baseline.load(folder / "baseline.json")
    found = spark.diagnose(session.read.parquet(lake), baseline, assets=len(Lake.open(lake).assets), window_s=window)
    measured(f"{at}, DataFrame", rows, found.collect, descendants)
    shutil.rmtree(folder / "stream", ignore_errors=True)
    stream = sinks.file_stream(session, lake, baseline.loop.columns)
    followed = streaming.follow(stream, baseline, assets=len(Lake.open(lake).assets), window_s=window)
    measured(
        f"{at}, stream",
        rows,
        lambda: sinks.wait_for_stream(sinks.start(followed, folder / "stream", every_s=None)),
        descendants,
    )
    session.stop()
