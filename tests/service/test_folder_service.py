"""A service that follows a folder of logs: verdicts, alarms, silence, restarts, and what a check says."""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path

import halls
from brokers import Running, until
from commands import one_line, run
from halls import asked


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
        interval_s = 3.0
        [assets.press]
        baseline = "baseline.json"
        source = "share"
        {more}
        """
    )
    return path


def drop(folder: Path, log: str, name: str) -> None:
    shutil.copy(folder / log, folder / "share" / name)


def test_a_service_follows_logs_that_fall_into_a_folder(tmp_path: Path) -> None:
    path = hall(
        tmp_path,
        """
        [alarms.data_quality]
        on_delay_s = 0.1
        [alarms.reception]
        on_delay_s = 0.1
        [alarms.connection]
        on_delay_s = 0.1
        """,
    )
    drop(tmp_path, "healthy.csv", "press_20260101_000000.csv")

    def alarms(name: str) -> list[tuple[str, str]]:
        return asked(path, f"SELECT after, cause FROM transitions WHERE alarm = '{name}' ORDER BY number")

    def verdicts() -> list[str]:
        return [row[0] for row in asked(path, "SELECT summary FROM diagnoses WHERE verdict = 'fault' ORDER BY number")]

    running = Running(halls.service_of(path))
    until(lambda: asked(path, "SELECT * FROM checkpoints WHERE asset = 'press' AND sequence = 59"), 60.0)
    assert not alarms("data_quality") and not alarms("reception")
    drop(tmp_path, "leaky.csv", "press_20260101_000100.csv")
    until(lambda: any("leakage" in summary for summary in verdicts()), 60.0)
    assert alarms("fault")[0][0] == "unacknowledged"
    (tmp_path / "share/press_20260101_000200.csv").write_text("t,r,u,y\n0,1,2,three\n")
    until(lambda: alarms("reception"), 60.0)
    assert "press_20260101_000200.csv" in alarms("reception")[0][1]
    running.end(stop=True)
    assert asked(path, "SELECT count(*) FROM audit WHERE what = 'refused' AND asset = 'press'") == [(1,)]

    running = Running(halls.service_of(path))  # which counts nothing again
    drop(tmp_path, "healthy.csv", "press_20260101_000300.csv")  # the same bytes at another time
    until(lambda: asked(path, "SELECT * FROM checkpoints WHERE asset = 'press' AND sequence = 179"), 60.0)
    ((status,),) = asked(path, "SELECT status FROM checkpoints WHERE asset = 'press'")
    assert json.loads(status)["counted"]["samples"] == 18_000
    (tmp_path / "share").rename(tmp_path / "away")
    until(lambda: alarms("connection.share"), 60.0)
    assert str(tmp_path / "share") in alarms("connection.share")[0][1]
    known = alarms("data_quality")
    time.sleep(5.0)
    assert alarms("data_quality") == known  # longer than the interval, and nobody is called silent
    running.end(stop=True)


def test_a_log_that_pauses_lacks_no_samples(tmp_path: Path) -> None:
    path = hall(tmp_path, "[alarms.data_quality]\non_delay_s = 0.1")
    path.write_text(path.read_text().replace("interval_s = 3.0", "interval_s = 600.0"))
    drop(tmp_path, "healthy.csv", "press_20260101_000000.csv")
    drop(tmp_path, "healthy.csv", "press_20260101_001000.csv")
    running = Running(halls.service_of(path))
    until(lambda: asked(path, "SELECT * FROM checkpoints WHERE asset = 'press' AND sequence = 119"), 60.0)
    running.end(stop=True)
    assert not asked(path, "SELECT * FROM transitions WHERE alarm = 'data_quality'")


def test_silence_is_what_lasts_longer_than_the_interval(tmp_path: Path) -> None:
    path = hall(tmp_path, "[alarms.data_quality]\non_delay_s = 0.1\n[alarms.reception]\non_delay_s = 0.1")
    silent = "SELECT document FROM transitions WHERE alarm IN ('data_quality', 'reception')"
    begin = time.monotonic()
    running = Running(halls.service_of(path))
    until(lambda: asked(path, silent), 30.0)  # it was never heard
    assert 3.0 <= time.monotonic() - begin < 6.5
    running.end(stop=True)
    for name in ("hall.sqlite", "history.sqlite"):
        (tmp_path / name).unlink(missing_ok=True)
    drop(tmp_path, "healthy.csv", "press_20260101_000000.csv")
    running = Running(halls.service_of(path))
    until(lambda: asked(path, "SELECT * FROM checkpoints WHERE asset = 'press' AND sequence = 59"), 60.0)
    begin = time.monotonic()
    until(lambda: asked(path, silent), 30.0)
    assert 2.5 <= time.monotonic() - begin < 7.0
    running.end(stop=True)


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
