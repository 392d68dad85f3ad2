"""Measured machines, from the command line with the loop files of examples/: what is found, and that nobody is deaf."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from servoscope.baseline.baseline import Baseline
from servoscope.cli import app
from servoscope.cli.exit import RAN
from servoscope.diagnosis.diagnose import diagnose
from servoscope.models.loop import Loop
from servoscope.signals import Recording
from servoscope.signals.readers import read, read_parts

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="module")
def real(shared_data: Path) -> Path:
    return shared_data / "real"


def _run(*arguments: object) -> list[dict[str, Any]]:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code in RAN, result.output
    if "--json" not in arguments:
        return []
    if "\n{" in result.stdout:
        return [json.loads(line) for line in result.stdout.splitlines()]
    return [json.loads(result.stdout)]


def _learn(tmp_path: Path, example: str, files: Sequence[Path], *options: object) -> Path:
    baseline = tmp_path / f"{example}.json"
    _run("learn", EXAMPLES / f"{example}.toml", *files, "-o", baseline, *options)
    return baseline


def _with_force(recording: Recording, baseline: Baseline, name: str) -> Recording:
    """Add 30 % of a coefficient's share to u from half-way on; u itself times 1.1 for "input_gain"."""
    from scipy.signal import savgol_filter

    half = recording.samples // 2
    u = recording.u.copy()
    if name == "input_gain":
        u[half:] *= 1.1
    else:
        order = {"viscous_friction": 1, "inertia": 2}[name]
        window = max(5, int(0.1 * recording.sample_rate) // 2 * 2 + 1)
        derivative = savgol_filter(recording.y, window, 3, deriv=order, delta=1.0 / recording.sample_rate)
        coefficient = baseline.theta[baseline.names.index(name)] / baseline.loop.plant.input_gain
        u[half:] += 0.3 * coefficient * derivative[half:]
    return replace(recording, u=u)


class TestEMPS:
    """Authors' own estimate: M 95.1089 kg, F_v 203.5034 N s/m, F_c 20.3935 N, offset -3.1648 N."""

    def test_parameters_match_the_authors(self, real: Path, tmp_path: Path) -> None:
        learned = Baseline.load(_learn(tmp_path, "emps", [real / "emps" / "DATA_EMPS.mat"]))
        theta = dict(zip(learned.names, learned.theta, strict=True))
        assert theta["inertia"] == pytest.approx(95.1089, rel=0.01)
        assert theta["viscous_friction"] == pytest.approx(203.5034, rel=0.02)
        assert theta["coulomb_friction"] == pytest.approx(20.3935, rel=0.02)
        assert theta["offset"] == pytest.approx(-3.1648, rel=0.05)

    def test_first_half_leaves_the_second_healthy_and_hears_faults(self, real: Path, tmp_path: Path) -> None:
        file = real / "emps" / "DATA_EMPS.mat"
        path = _learn(tmp_path, "emps", [file], "--to", "12.4")
        (said,) = _run("diagnose", path, file, "--from", "12.4", "--json")
        assert said["verdict"] == "healthy"
        baseline = Baseline.load(path)
        second = read(file, baseline.loop).part(12.4, 100.0)
        for name in ("input_gain", "inertia", "viscous_friction"):
            diagnosis = diagnose(baseline, _with_force(second, baseline, name))
            assert [fault.name for fault in diagnosis.faults] == [name]

    def test_friction_by_direction_halves_the_residual(self, real: Path, tmp_path: Path) -> None:
        file = real / "emps" / "DATA_EMPS.mat"
        one = Baseline.load(_learn(tmp_path, "emps", [file]))
        settings = one.loop.to_dict()
        settings["plant"]["friction"] = "directional"
        from servoscope.learning.learn import learn_baseline

        loop = Loop.from_dict(settings)
        two = learn_baseline(loop, [read(file, loop)])
        assert two.recursion.R < 0.5 * one.recursion.R


class TestPumpDrivenActuator:
    def test_loads_are_found_and_none_is_named(self, real: Path, tmp_path: Path) -> None:
        folder = real / "eha_pump"
        path = _learn(tmp_path, "eha-pump", [folder / "exp_data_1_4.csv"])
        files = [folder / f"exp_data_{which}.csv" for which in ("1_3", "3_2", "3_4", "5_2", "5_4")]
        healthy, *loaded = _run("diagnose", path, *files, "--json")
        assert healthy["verdict"] == "healthy"
        for said in loaded:
            assert (said["verdict"], said["faults"]) == ("fault", [])
        baseline = Baseline.load(path)
        assert baseline.detectability.explained > 0.99
        from servoscope.diagnosis.diagnose import diagnose_with_trace

        T2 = [diagnose_with_trace(baseline, read(file, baseline.loop))[1].statistic.max() for file in files]
        assert T2[0] < T2[1] < T2[3]  # the same short stroke under loads 3 and 5
        assert T2[0] < T2[2] < T2[4]
        deaf = diagnose(baseline, _with_force(read(files[0], baseline.loop), baseline, "viscous_friction"))
        assert deaf.verdict == "fault"


class TestQube:
    def test_third_run_is_healthy_and_inertia_is_heard(self, real: Path, tmp_path: Path) -> None:
        files = sorted((real / "qube").glob("*.csv"))
        for i, third in enumerate(files):
            path = _learn(tmp_path, "qube", [file for j, file in enumerate(files) if j != i])
            (said,) = _run("diagnose", path, third, "--json")
            assert said["verdict"] == "healthy", third.name
            baseline = Baseline.load(path)
            assert baseline.loop.monitor.model_error == 0.02
            heavier = diagnose(baseline, _with_force(read(third, baseline.loop), baseline, "inertia"))
            assert heavier.verdict == "fault"
            assert heavier.refit is None, "without nominal values there is none, and the reasons do without it"
            assert heavier.explanation[0].startswith("Alarm at ")
            assert any("inertia has risen" in sentence for sentence in heavier.explanation)
            assert any(sentence.startswith("Rejected: ") for sentence in heavier.explanation)
            assert {candidate.name for candidate in heavier.candidates[:2]} == {"inertia", "input_gain"}


class TestCranfield:
    def test_alarms_per_load(self, real: Path, tmp_path: Path) -> None:
        folder = real / "cranfield"
        alarms: dict[tuple[str, str], int] = {}
        for load in ("20", "40", "-40"):
            pick = ("--by", "run", "--where")
            path = _learn(tmp_path, "cranfield", [folder / "normal.csv"], *pick, f"load={load},run=1-5")
            for file, runs in (("normal", "6-10"), ("backlash2", "1-10"), ("lackLubrication1", "1-10")):
                said = _run("diagnose", path, folder / f"{file}.csv", *pick, f"load={load},run={runs}", "--json")
                assert len(said) == (5 if file == "normal" else 10)
                alarms[file, load] = sum(one["verdict"] == "fault" for one in said)
            if load == "20":
                baseline = Baseline.load(path)
                rows = {"load": load, "run": "6"}
                (run,) = read_parts(folder / "normal.csv", baseline.loop, where=rows, by="run")
                assert diagnose(baseline, _with_force(run, baseline, "input_gain")).verdict == "fault"
        assert sum(alarms["normal", load] for load in ("20", "40", "-40")) <= 1
        assert alarms["backlash2", "20"] == alarms["backlash2", "40"] == 10
        assert alarms["lackLubrication1", "20"] + alarms["lackLubrication1", "40"] >= 15


def test_loop_files_of_the_examples_are_valid() -> None:
    for path in EXAMPLES.glob("*.toml"):
        loop = Loop.load(path)
        assert np.isfinite(loop.sample_rate), path.name
