"""A service that follows a folder of logs: faults, files that cannot be read, a share that goes, and silence."""

from __future__ import annotations

import json
import time
from pathlib import Path

import halls
from brokers import Running, until
from halls import asked
from test_folder_check import drop, hall

ALARMS = """
    [alarms.data_quality]
    on_delay_s = 0.1
    [alarms.reception]
    on_delay_s = 2.0
    [alarms.connection]
    on_delay_s = 0.1
"""


def causes(path: Path, alarm: str) -> list[str]:
    """Return why an alarm has occurred, each time."""
    rows = asked(path, "SELECT alarm, after, cause FROM transitions ORDER BY number")
    return [cause for name, after, cause in rows if name == alarm and after == "unacknowledged"]


def counted_blocks(path: Path) -> int:
    rows = asked(path, "SELECT sequence FROM checkpoints WHERE asset = 'press'")
    return rows[0][0] + 1 if rows else 0


def test_a_service_follows_logs_that_fall_into_a_folder(tmp_path: Path) -> None:
    path = hall(tmp_path, ALARMS)
    path.write_text(path.read_text().replace("interval_s = 20.0", "interval_s = 300.0"))
    drop(tmp_path, "healthy.csv", "press_20260101_000000.csv")
    running = Running(halls.service_of(path))
    until(lambda: counted_blocks(path) == 60, 60.0)
    drop(tmp_path, "leaky.csv", "press_20260101_000110.csv")  # a pause that is none of the data's
    until(lambda: any("leakage" in row[0] for row in asked(path, "SELECT summary FROM diagnoses")), 60.0)
    assert causes(path, "fault") and not causes(path, "data_quality") and not causes(path, "reception")
    (tmp_path / "share/press_20260101_000200.csv").write_text("t,r,u,y\n0,1,2,three\n")
    until(lambda: causes(path, "reception"), 60.0)
    assert "press_20260101_000200.csv" in causes(path, "reception")[0]
    running.end(stop=True)
    assert asked(path, "SELECT count(*) FROM audit WHERE what = 'refused' AND asset = 'press'") == [(1,)]

    running = Running(halls.service_of(path))  # counts nothing again
    drop(tmp_path, "healthy.csv", "press_20260101_000300.csv")
    until(lambda: counted_blocks(path) == 180, 60.0)
    running.end(stop=True)
    ((status,),) = asked(path, "SELECT status FROM checkpoints WHERE asset = 'press'")
    assert json.loads(status)["counted"] | {"samples": 18_000, "lost": 0, "late": 0} == json.loads(status)["counted"]


def test_a_share_that_goes_is_an_alarm_of_its_own_and_not_silence(tmp_path: Path) -> None:
    path = hall(tmp_path, ALARMS)
    path.write_text(path.read_text().replace("interval_s = 20.0", "interval_s = 2.0"))
    drop(tmp_path, "healthy.csv", "press_20260101_000000.csv")
    running = Running(halls.service_of(path))
    until(lambda: counted_blocks(path) == 60, 60.0)
    (tmp_path / "share").rename(tmp_path / "away")
    until(lambda: causes(path, "connection.share"), 60.0)
    assert str(tmp_path / "share") in causes(path, "connection.share")[0]
    time.sleep(5.0)  # longer than the interval and `silent_s` together
    assert not causes(path, "data_quality") and not causes(path, "reception")
    ((status,),) = asked(path, "SELECT status FROM checkpoints WHERE asset = 'press'")
    assert json.loads(status)["verdict"] == "undetermined" and str(tmp_path) in json.loads(status)["summary"]
    (tmp_path / "away").rename(tmp_path / "share")
    until(lambda: causes(path, "data_quality"), 60.0)  # it is there again, and the press is silent
    running.end(stop=True)


def test_silence_is_what_lasts_longer_than_the_interval(tmp_path: Path) -> None:
    path = hall(tmp_path, ALARMS)
    path.write_text(path.read_text().replace("interval_s = 20.0", "interval_s = 3.0"))
    begin = time.monotonic()
    running = Running(halls.service_of(path))
    until(lambda: causes(path, "reception"), 60.0)  # 3 s, and 2 s of its delay: it was never heard
    assert 5.0 <= time.monotonic() - begin < 9.0
    drop(tmp_path, "healthy.csv", "press_20260101_000000.csv")
    until(lambda: counted_blocks(path) == 60, 60.0)
    begin = time.monotonic()
    until(lambda: causes(path, "data_quality"), 60.0)
    assert 2.5 <= time.monotonic() - begin < 7.0
    running.end(stop=True)
