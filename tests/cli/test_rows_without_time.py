"""Files without a time column: each command names the option, and the loop file keeps what it said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from commands import run

from servoscope.models.loop import Columns, Loop
from servoscope.signals.readers import read
from servoscope.simulation import simulate, tutorial

RATE = 200.0


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a log of r, y and u at 200 Hz, as files of system identification are, which holds no time."""
    folder = tmp_path_factory.mktemp("log")
    recording, _ = simulate(
        Loop.from_dict(tutorial.AXIS), tutorial.motion(1), noise_u_std=0.02, noise_y_std=5e-6, seed=1
    )
    columns = np.column_stack([recording.r, recording.y, recording.u])
    np.savetxt(folder / "lab.txt", columns, "%.7g", ", ", header="r, y, u", comments="")
    return folder / "lab.txt"


def test_each_command_names_the_option(log: Path) -> None:
    listed = run("inspect", log)
    assert "--rate HZ" in listed.out and f"servoscope init {log} --rate HZ" in listed.out.replace("\n", "")
    assert "--rate 50" in run("inspect", log, "--rate", "50").out
    for words in (("init", log, "--yes"), ("assess", log), ("inspect", log, "--columns", "u=u")):
        found = run(*words)
        assert found.code == 1 and "--rate 200 for 200 Hz" in found.err


def test_the_loop_file_keeps_the_rate(log: Path, tmp_path: Path) -> None:
    loop, baseline = tmp_path / "loop.toml", tmp_path / "b.json"
    assert run("init", log, "--rate", RATE, "-o", loop, "--yes").code == 0
    assert Loop.load(loop).columns.row_rate == RATE == Loop.load(loop).sample_rate
    assert run("learn", loop, log, "-o", baseline).code == 0
    assert run("diagnose", baseline, log).code == 0
    assert run("assess", log, "--rate", RATE).code == 0


def test_columns_say_it_too(log: Path) -> None:
    assert "60 s" in run("inspect", log, "--columns", f"t=row/{RATE:g}").out
    assert "sampled at 200 Hz" in run("inspect", log, "--columns", "t=row/200", "--loop", _loop(log)).err


def test_another_rate_is_resampled(log: Path) -> None:
    columns = Columns(time="row/200", resample=True)
    assert read(log, Loop.load(_loop(log)), columns=columns).sample_rate == 100.0


@pytest.mark.parametrize("words", [("--rate", "0"), ("--rate", "-5"), ("--columns", "t=row/0")])
def test_a_rate_is_above_zero(log: Path, words: tuple[str, str]) -> None:
    found = run("inspect", log, *words)
    assert found.code == 2 and "above 0" in found.err


def _loop(log: Path) -> Path:
    path = log.with_name("given.toml")
    path.write_text('sample_rate = 100\n[plant]\nkind = "polynomial"\norder = 2\n')
    return path
