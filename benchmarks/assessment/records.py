"""Measured logs of which something is known: process loops of which some stick, and servo channels that are healthy."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

from servoscope.models.loop import Columns
from servoscope.signals.readers.recording_file import read_rows
from servoscope.signals.samples import Samples

COLUMNS = Columns(time="time")


def process_logs(folder: Path) -> Iterator[tuple[str, bool, Samples]]:
    """Yield loop, whether its valve sticks, and samples of the measured process loops; by index.csv, not by names."""
    with (folder / "index.csv").open(encoding="utf-8") as index:
        rows = list(csv.DictReader(index))
    for row in rows:
        ((_, samples),) = read_rows(folder / row["file"], COLUMNS).items()
        yield row["loop"], row["label"] == "stiction", samples


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
