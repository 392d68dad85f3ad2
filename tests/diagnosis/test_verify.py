"""A diagnosis can be repeated by anyone from three files, and what was changed is seen."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import servoscope as ss
from servoscope.cli import app
from servoscope.core.arrays import FloatArray
from servoscope.diagnosis.verify import provenance, verify
from servoscope.signals import clean
from servoscope.signals.writers import write_recording

SETTINGS = {
    "name": "mass",
    "sample_rate": 100.0,
    "plant": {"kind": "polynomial", "order": 2, "stiffness": True},
    "monitor": {"cutoff": 2.0, "memory": 3.0, "frequencies": [0.5, 1.0]},
}


def recording(seed: int, gain: float = 1.0) -> ss.Recording:
    """Return motion of a spring and damper whose u is what its inverse asks for, with a little noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(3000) / 100.0
    phase = rng.uniform(0.0, 6.0, 4)
    w = np.array([0.9, 2.1, 3.3, 4.7])
    angle: FloatArray = np.multiply.outer(t, w) + phase
    y = np.sin(angle).sum(axis=1)
    u = gain * (y + 0.2 * (w * np.cos(angle)).sum(axis=1) - 0.05 * (w**2 * np.sin(angle)).sum(axis=1))
    noisy = u + rng.normal(0.0, 0.01, t.size)
    return clean(t, y, noisy, y + rng.normal(0.0, 1e-4, t.size), name=f"run{seed}.csv", sample_rate=100.0)


@pytest.fixture(scope="module")
def baseline() -> ss.Baseline:
    return ss.learn(ss.Loop.from_dict(SETTINGS), [recording(0), recording(1)])


@pytest.fixture
def files(baseline: ss.Baseline, tmp_path: Path) -> tuple[Path, Path, Path]:
    """Return diagnosis, recording and baseline as files, the first printed by the command line."""
    write_recording(tmp_path / "run.csv", recording(7, gain=1.3))
    baseline.save(tmp_path / "baseline.json")
    found = CliRunner().invoke(app, ["diagnose", str(tmp_path / "baseline.json"), str(tmp_path / "run.csv"), "--json"])
    assert found.exit_code == 3, found.output
    (tmp_path / "diagnosis.json").write_text(found.stdout, encoding="utf-8")
    return tmp_path / "diagnosis.json", tmp_path / "run.csv", tmp_path / "baseline.json"


def test_the_same_files_give_the_same_verdict(files: tuple[Path, Path, Path]) -> None:
    assert json.loads(files[0].read_text())["verdict"] == "fault"
    found = CliRunner().invoke(app, ["verify", *map(str, files)])
    assert found.exit_code == 0, found.output
    assert "Verified: the same verdict" in found.output


@pytest.mark.parametrize("key", ["recording", "baseline"])
def test_another_hash_is_seen(files: tuple[Path, Path, Path], key: str) -> None:
    told = json.loads(files[0].read_text())
    told["provenance"][key] = "0" * 16
    files[0].write_text(json.dumps(told), encoding="utf-8")
    found = CliRunner().invoke(app, ["verify", *map(str, files), "--json"])
    assert found.exit_code == 1
    said = json.loads(found.stdout)
    assert not said["same"]
    assert "0" * 16 in said["differences"][0]


def test_another_verdict_is_seen(files: tuple[Path, Path, Path]) -> None:
    told = json.loads(files[0].read_text())
    told["verdict"] = "healthy"
    files[0].write_text(json.dumps(told), encoding="utf-8")
    found = CliRunner().invoke(app, ["verify", *map(str, files)])
    assert found.exit_code == 1
    assert "the verdict was healthy and is fault" in " ".join(found.output.split())


def test_one_changed_sample_is_seen(files: tuple[Path, Path, Path]) -> None:
    lines = files[1].read_text().splitlines()
    cells = lines[100].split(",")
    lines[100] = ",".join([*cells[:-1], str(float(cells[-1]) + 1e-9)])
    files[1].write_text("\n".join(lines) + "\n", encoding="utf-8")
    found = CliRunner().invoke(app, ["verify", *map(str, files)])
    assert found.exit_code == 1
    assert "not the samples" in " ".join(found.output.split())


def test_what_is_no_diagnosis_is_one_line(files: tuple[Path, Path, Path]) -> None:
    files[0].write_text("{}", encoding="utf-8")
    found = CliRunner().invoke(app, ["verify", *map(str, files)])
    assert found.exit_code == 1
    assert "is not one diagnosis" in found.output + (found.stderr or "")


def test_a_diagnosis_without_provenance_is_compared_by_its_verdict(baseline: ss.Baseline) -> None:
    rec = recording(8)
    found = verify(ss.diagnose(baseline, rec), baseline, rec)
    assert found.same
    assert [remark.key for remark in found.remarks] == ["verify.no_provenance"]


def test_other_versions_are_a_remark(baseline: ss.Baseline) -> None:
    rec = recording(8)
    before = provenance(baseline, rec).model_copy(update={"numpy": "1.0"})
    found = verify(ss.diagnose(baseline, rec).model_copy(update={"provenance": before}), baseline, rec)
    assert found.same
    assert "numpy was 1.0" in str(found.remarks[0])
