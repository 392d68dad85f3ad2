"""Logs with known causes as features: simulated ones, and the measured process loops."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from assessment import loops
from servoscope.assessment.assess import MIN_ROWS, equidistant
from servoscope.assessment.causes import CAUSES
from servoscope.assessment.features import analyse
from servoscope.models.loop import Columns
from servoscope.signals.readers.recording_file import read_rows
from servoscope.signals.samples import Samples

COLUMNS = Columns(time="time")
EVERY = 12  # of the many short recordings of two folders, this one is taken


@dataclass(frozen=True)
class Records:
    """Features of logs, and what is known of each."""

    names: tuple[str, ...]
    features: npt.NDArray[np.float64]  # (N, F)
    possible: npt.NDArray[np.bool_]  # (N, causes)
    loops: npt.NDArray[np.str_]  # which loop each is of, (N,)
    sizes: npt.NDArray[np.float64]  # severity of simulated loops, (N,)


def simulated(number: int, seed: int, family: str) -> Records:
    """Return simulated loops of a family, each a loop of its own."""
    made = loops.simulate(number, seed, family)
    rows = [analyse(loop.r, loop.u, loop.y).features for loop in made]
    possible = np.array([[cause == loop.cause for cause in CAUSES] for loop in made])
    return _records(rows, possible, [f"{family} {i}" for i in range(number)], [loop.size for loop in made])


def process_logs(folder: Path) -> Iterator[tuple[str, bool, Samples]]:
    """Yield loop, whether its valve sticks, and samples of the measured process loops; by index.csv, not by names."""
    with (folder / "index.csv").open(encoding="utf-8") as index:
        rows = list(csv.DictReader(index))
    for row in rows:
        ((_, samples),) = read_rows(folder / row["file"], COLUMNS).items()
        yield row["loop"], row["label"] == "stiction", samples


def measured(folder: Path) -> Records:
    """Return the process loops; of one that does not stick, no more is known."""
    logs = list(process_logs(folder))
    rows = [analyse(s.r, s.u, s.y).features for _, _, s in logs]
    possible = np.array([[(cause == "stiction") == sticks for cause in CAUSES] for _, sticks, _ in logs])
    return _records(rows, possible, [loop for loop, _, _ in logs], [np.nan] * len(logs))


def servos(folder: Path) -> Records:
    """Return healthy servo recordings, of two large folders every twelfth: nothing is wrong but perhaps the grid."""
    rows, names = [], []
    for i, (of, name, log) in enumerate(servo_logs(folder)):
        if of in ("sts3215", "ur10e") and i % EVERY:
            continue
        _, r, u, y, _ = equidistant(log, name)
        if y.size >= MIN_ROWS:
            rows.append(analyse(r, u, y).features)
            names.append(of)
    possible = np.array([[cause in ("good", "quantisation") for cause in CAUSES]] * len(rows))
    return _records(rows, possible, names, [np.nan] * len(rows))


def servo_logs(folder: Path) -> Iterator[tuple[str, str, Samples]]:
    """Yield folder, name and samples of all measured servo recordings that are healthy."""
    pump = Columns(
        time="time", time_unit="ms", reference="ADC1_Channel_13", input="ADC1_Channel_8", output="ADC1_Channel_14"
    )
    screw = Columns(
        time="time", reference="set_point", input="current", output="set_point - position_error", segment=("group",)
    )
    hobby = Columns(time="timestamp", reference="goal_position", input="load % 65536", output="position")
    pendulum = Columns(time="t", reference="target_theta", input="plant_input", output="theta")
    for path in sorted((folder / "eha_pump").glob("*.csv")):
        yield from _named("eha_pump", path, pump)
    for path in sorted((folder / "emps").glob("*.mat")):
        yield from _named("emps", path, Columns(time="t", reference="qg", input="vir", output="qm"))
    for load in ("20", "40", "-40"):
        yield from _named("cranfield", folder / "cranfield" / "normal.csv", screw, {"load": load}, "run")
    for path in [*sorted((folder / "qube").glob("*.csv")), *sorted((folder / "qube" / "more").glob("*.parquet"))]:
        yield from _named("qube", path, pendulum)
    for path in sorted((folder / "sts3215").glob("*.parquet")):
        yield from _named("sts3215", path, Columns(), None, "run")
    for path in sorted((folder / "xl330").glob("*.parquet")):
        yield from _named("xl330", path, hobby, {"torque_enable": "1"})
    for joint in range(1, 7):
        robot = Columns(time="t", reference=f"current{joint}_raw", input=f"current{joint}_raw", output=f"q{joint}_raw")
        yield from _named("tx40", folder / "tx40" / "tx40.parquet", robot)
        for path in sorted((folder / "ur10e").glob("*.parquet")):
            yield from _named(
                "ur10e", path, Columns(time="t", reference=f"i{joint}", input=f"i{joint}", output=f"q{joint}")
            )


def _named(
    folder: str, path: Path, columns: Columns, where: dict[str, str] | None = None, by: str | None = None
) -> Iterator[tuple[str, str, Samples]]:
    for name, samples in read_rows(path, columns, where, by).items():
        yield folder, name, samples


def _records(
    rows: list[dict[str, float]], possible: npt.NDArray[np.bool_], names: list[str], sizes: list[float]
) -> Records:
    features = np.array([list(row.values()) for row in rows])
    return Records(tuple(rows[0]), features, possible, np.array(names), np.array(sizes))
