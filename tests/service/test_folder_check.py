"""What a check says about a folder of logs."""

from __future__ import annotations

import shutil
from pathlib import Path

import halls
from commands import one_line, run


def hall(tmp_path: Path, more: str = "") -> Path:
    """Write a service file that follows a folder, with what it names."""
    halls.files(tmp_path)
    (tmp_path / "share").mkdir()
    path = tmp_path / "hall.toml"
    path.write_text(
        f"""
        name = "hall"
        [service]
        listen = ""
        commit_every_s = 0.05
        log = "error"
        [diagnosis]
        window_s = 40.0
        [quality]
        silent_s = 1.0
        [sources.share]
        kind = "folder"
        path = "share"
        match = "{{asset}}_{{time}}.csv"
        complete_after_s = 0.1
        poll_s = 0.05
        interval_s = 20.0
        [assets.press]
        baseline = "baseline.json"
        source = "share"
        {more}
        """
    )
    return path


def drop(folder: Path, log: str, name: str) -> None:
    shutil.copy(folder / log, folder / "share" / name)


def test_a_check_says_what_would_be_read(tmp_path: Path) -> None:
    path = hall(tmp_path)
    result = run("run", path, "--check")
    assert result.code == 0
    assert "0 files match {asset}_{time}.csv" in result.out and "no file of press" in result.out
    drop(tmp_path, "healthy.csv", "press_20260101_000000.csv")
    assert "all can be read; the first is press_20260101_000000.csv" in run("run", path, "--check").out
    (tmp_path / "share/press_20260101_000100.csv").write_text("t,r,u,y\n0,1,2,three\n")
    assert "press_20260101_000100.csv cannot be read: " in run("run", path, "--check").out
    (tmp_path / "share").rename(tmp_path / "gone")
    assert "No such file" in run("run", path, "--check").out
    moving = (
        path.read_text().replace("[service]", "[service]\nworkers = 2").replace("poll_s", 'afterwards = "move"\npoll_s')
    )
    path.write_text(moving)
    one_line(run("run", path, "--check"), "[sources] share: one process moves its files")
