"""The exported monitor as a co-simulation unit, read, validated and simulated by FMPy."""

from __future__ import annotations

import functools
import re
import subprocess
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from commands import run
from drives import compiler
from fmpy.fmi1 import FMICallException
from fmpy.fmi3 import FMU3Slave
from fmpy.validation import validate_fmu
from test_export import demo

from servoscope.diagnosis.monitor import Monitor
from servoscope.export import export_c, export_fmu, unpack_image
from servoscope.export.golden import golden_signals

SAMPLES = 3000


@pytest.fixture(scope="module")
def unit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler("cc")
    path = tmp_path_factory.mktemp("unit") / "demo.fmu"
    assert export_fmu(demo(), path)
    return path


@pytest.fixture
def slave(unit: Path, tmp_path: Path) -> Iterator[FMU3Slave]:
    """An instance of the unit, initialised."""
    description = fmpy.read_model_description(unit)
    folder = fmpy.extract(unit, tmp_path)
    slave = FMU3Slave(
        guid=description.guid,
        unzipDirectory=folder,
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="monitor",
    )
    slave.instantiate()
    slave.enterInitializationMode(startTime=0.0)
    slave.exitInitializationMode()
    yield slave
    slave.freeInstance()


@functools.cache
def references(path: Path) -> dict[str, int]:
    return {each.name: each.valueReference for each in fmpy.read_model_description(path).modelVariables}


def step(slave: FMU3Slave, k: int, signals: Any) -> None:
    r, u, y, restart = signals
    slave.setFloat64([1, 2, 3], [r[k], u[k], y[k]])
    slave.setBoolean([4], [bool(restart[k])])
    slave.doStep(currentCommunicationPoint=k / 100.0, communicationStepSize=0.01)


def test_the_unit_is_valid(unit: Path) -> None:
    assert validate_fmu(str(unit)) == []
    description = fmpy.read_model_description(unit, validate=True)
    assert description.fmiVersion == "3.0"
    assert [v.name for v in description.modelVariables if v.causality == "input"] == ["r", "u", "y", "restart"]


def test_steps_give_the_bits_of_the_monitor(unit: Path, slave: FMU3Slave) -> None:
    """Gaps, NaN and restarts are among the samples."""
    at, monitor, signals = references(unit), Monitor(demo()), golden_signals(demo(), SAMPLES)
    _, trace = monitor.run(monitor.init(), *signals)
    names = ["statistic", "level", "crossed_s", *(f"theta.{name}" for name in demo().names)]
    wanted = np.column_stack([trace.statistic, trace.level, trace.crossed, trace.theta])
    gamma = trace.ifrf.H - trace.ifrf_expected.H
    found: list[list[float]] = []
    for k in range(SAMPLES):
        step(slave, k, signals)
        if slave.getUInt64([at["evaluations"]])[0] > len(found):
            found.append(slave.getFloat64([at[name] for name in names]))
    assert np.array_equal(found, wanted, equal_nan=True)
    assert slave.getFloat64([at["gamma[2].real"], at["gamma[2].imag"]]) == [gamma[-1, 1].real, gamma[-1, 1].imag]
    assert slave.getInt64([at["verdict"]]) == [2], "the golden samples end with a fault"
    assert slave.getFloat64([at["limit"]]) == [demo().thresholds.statistic]


def test_a_simulator_runs_it(unit: Path) -> None:
    """As FMPy's command line does: r, u and y are a table, and the result is one."""
    r, u, y, _ = golden_signals(demo(), SAMPLES)
    signals = np.nan_to_num(np.stack([r, u, y]), nan=0.0, posinf=0.0)
    signals[np.abs(signals) > 1e100] = 0.0
    table = np.zeros(SAMPLES, dtype=[("time", "f8"), ("r", "f8"), ("u", "f8"), ("y", "f8")])
    table["time"] = np.arange(SAMPLES) * 0.01
    for name, signal in zip("ruy", signals, strict=True):
        table[name] = signal
    result = fmpy.simulate_fmu(
        str(unit), stop_time=SAMPLES * 0.01, step_size=0.01, output_interval=0.01, input=table, output=["statistic"]
    )
    monitor = Monitor(demo())
    _, trace = monitor.run(monitor.init(), *signals)
    last = result["statistic"][-1]
    assert last == trace.statistic[-1]
    assert last > demo().thresholds.statistic


def test_state_is_serialized_as_the_image_that_the_server_reads(slave: FMU3Slave) -> None:
    signals, monitor = golden_signals(demo(), SAMPLES), Monitor(demo())
    for k in range(500):
        step(slave, k, signals)
    state = slave.getFMUState()
    saved = slave.serializeFMUState(state)
    made = export_c(demo())
    image, _, _ = unpack_image(saved[: 8 * (len(monitor.init()) + 2) + 12], made.mark)
    there, _ = monitor.run(monitor.init(), *(signal[:500] for signal in signals))
    assert image.tobytes() == there.tobytes()
    for k in range(500, 900):
        step(slave, k, signals)
    later = slave.serializeFMUState(slave.getFMUState())
    slave.setFMUState(slave.deserializeFMUState(saved))
    for k in range(500, 900):
        step(slave, k, signals)
    assert slave.serializeFMUState(slave.getFMUState()) == later
    with pytest.raises(FMICallException):
        slave.deserializeFMUState(bytes([saved[0] ^ 1]) + saved[1:])


def test_another_step_is_refused(slave: FMU3Slave) -> None:
    with pytest.raises(FMICallException):
        slave.doStep(currentCommunicationPoint=0.0, communicationStepSize=0.02)


def test_every_function_of_the_standard_is_there(unit: Path, tmp_path: Path) -> None:
    header = (Path(fmpy.__file__).parent / "c-code" / "fmi3Functions.h").read_text(encoding="utf-8")
    standard = set(re.findall(r"FMI3_Export fmi3\w+TYPE\s+(fmi3\w+);", header))
    assert len(standard) > 70
    with zipfile.ZipFile(unit) as archive:
        (library,) = [name for name in archive.namelist() if name.startswith("binaries/")]
        archive.extract(library, tmp_path)
    table = subprocess.run(
        [compiler("nm"), "-D", "--defined-only", tmp_path / library], capture_output=True, text=True, check=True
    )
    assert standard <= set(re.findall(r"\bfmi3\w+", table.stdout))


def test_sources_compile_without_a_warning(tmp_path: Path, unit: Path) -> None:
    """Parameters that the standard demands and this unit does not need apart."""
    with zipfile.ZipFile(unit) as archive:
        archive.extractall(tmp_path)
    strict = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-Wno-unused-parameter", "-fsyntax-only"]
    source = tmp_path / "sources" / "fmi3.c"
    done = subprocess.run([compiler("gcc"), *strict, source], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_without_a_compiler_there_are_the_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert not export_fmu(demo(), tmp_path / "sources.fmu")
    assert validate_fmu(str(tmp_path / "sources.fmu")) == []
    with zipfile.ZipFile(tmp_path / "sources.fmu") as archive:
        assert not any(name.startswith("binaries/") for name in archive.namelist())


def test_the_same_baseline_gives_the_same_file(tmp_path: Path, unit: Path) -> None:
    export_fmu(demo(), tmp_path / "again.fmu")
    again, first = zipfile.ZipFile(tmp_path / "again.fmu"), zipfile.ZipFile(unit)
    with again, first:
        for name in first.namelist():
            if not name.startswith("binaries/"):
                assert again.read(name) == first.read(name)


def test_command(tmp_path: Path) -> None:
    demo().save(tmp_path / "baseline.json")
    result = run("export", tmp_path / "baseline.json", "--fmu", tmp_path / "demo.fmu")
    assert result.code == 0, result.err
    assert validate_fmu(str(tmp_path / "demo.fmu")) == []
    nothing = run("export", tmp_path / "baseline.json")
    assert nothing.code != 0
    assert "--fmu" in nothing.err
