"""A folder that others write to: early clocks, torn lines, links, odd names, and a crowd of files."""

from __future__ import annotations

import gzip
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from brokers import until
from shares import BEGAN, Share, csv, rows

from servoscope.service.sources import log_reader
from servoscope.service.sources import share as share_module
from servoscope.service.sources.log_files import LogFile
from servoscope.service.sources.message import Backlog


def test_a_file_ahead_of_the_clock_waits_in_its_place_and_blinds_nobody(share: Callable[..., Share]) -> None:
    press = share(afterwards="move")
    press.ahead_s = 1.0
    press.put("0.csv", csv(*rows(2000, 50)))
    source = press.open()
    press.until_rows(50)  # there is a process that reads
    now = time.time()
    early = press.put("a.csv", csv(*rows(1000, 50, origin=now - 6.0)))  # 4 s ahead
    press.until(lambda: source.asset_troubles)
    assert source.asset_troubles["press"].state == "refused" and "ahead of" in source.asset_troubles["press"].why
    for number in range(3):
        press.put(f"b{number}.csv", csv(*rows(50 * number, 50, origin=now - 6.0)))
        press.until_rows(50 * (number + 2))
    assert early.exists() and press.rejections == {"ahead": 1} and not source.asset_troubles
    assert press.until_rows(250) == [*range(2000, 2050), *range(150), *range(1000, 1050)]
    press.until(lambda: not list(press.folder.glob("*.csv")))
    assert press.rejections == {"ahead": 1} and time.time() > now + 3.4


def test_a_last_line_without_an_end_waits_until_it_is_whole(share: Callable[..., Share]) -> None:
    press = share(complete_after_s=0.6)
    press.open()
    whole = csv(*rows(0, 49), (BEGAN + 0.49, 49.0, 49.5, 0.0302))
    path = press.put("log.csv", whole.removesuffix("302\n"))
    end = time.monotonic() + 0.9
    while time.monotonic() < end:
        assert not press.turn()
        time.sleep(0.02)
    with path.open("a") as file:
        file.write("302\n")
    press.until_rows(50)
    assert np.concatenate(press.counted["press"], axis=1)[3, -1] == 0.0302
    press.put("end.csv", csv(*rows(50, 50)).removesuffix("\n"))  # it stays without one
    assert press.until_rows(100) == [*range(100)]


def test_folders_that_are_links_are_refused(share: Callable[..., Share], tmp_path: Path) -> None:
    press, home = share(afterwards="move"), tmp_path / "home"
    home.mkdir()
    (press.folder / "done").symlink_to(home)
    path = press.put("authorized_keys.csv", csv(*rows(0, 50)))
    press.open()
    press.until_rows(50)
    press.until(lambda: press.rejections["not moved"])
    assert path.exists() and not list(home.iterdir())
    kept = share_module.Share(press.folder)
    (press.folder / "linked").symlink_to(home)
    (home / "a.csv").write_text("t\n1\n")
    (press.folder / "link.csv").symlink_to(home / "a.csv")
    for refused in ("linked/a.csv", "link.csv"):
        with pytest.raises(OSError, match="link"), kept.file(refused):
            pass
    with pytest.raises(OSError, match="linked"):
        kept.move("authorized_keys.csv", "linked/a.csv", "b.csv")
    press.put("failed/authorized_keys.csv", "kept")
    press.put("failed/other.csv", "kept too")
    with pytest.raises(FileExistsError):
        kept.move("authorized_keys.csv", "failed/authorized_keys.csv", "other.csv")
    assert path.exists() and (press.folder / "failed/authorized_keys.csv").read_text() == "kept"


def test_many_files_are_handed_over_together_in_turns_and_what_waits_is_told(share: Callable[..., Share]) -> None:
    hall = share("press", "lift", match="{asset}_*.csv", interval_s=0.2)
    for k in range(60):
        hall.put(f"press_{k:02d}.csv", csv(*rows(20 * k, 20)))
    hall.put("lift_99.csv", csv(*rows(0, 20)))
    source = hall.open()
    until(lambda: len(source.transport.waiting) > 50)  # nobody polls
    names = [message.address for message in source.transport.waiting]
    assert "lift_99.csv" in names[:2]
    until(lambda: source.transport.backlog and source.transport.backlog.trouble)
    assert source.transport.backlog and source.transport.backlog.files >= 61
    assert hall.until_rows(1200) == [*range(1200)] and hall.rows_of("lift") == [*range(20)]
    hall.until(lambda: source.transport.backlog == Backlog())


def test_a_name_that_is_not_utf_8_is_written_out(share: Callable[..., Share]) -> None:
    press = share()
    (press.folder / os.fsdecode(b"caf\xe9\x01.csv")).write_text("t,r,u,y\n1,2,x,4\n" * 30)
    source = press.open()
    press.until(lambda: press.rejections["unreadable"])
    assert "caf\\xe9\\x01.csv" in press.reasons[-1].reason and "\\xe9" in source.asset_troubles["press"].why
    press.reasons[-1].reason.encode()


def test_a_nul_in_a_columns_name_is_written_out(share: Callable[..., Share]) -> None:
    press = share()
    pq.write_table(
        pa.table([[1.0], [2.0], [3.0], [4.0]], names=["t", "r", "u", "pos\0ition"]), press.folder / "a.parquet"
    )
    source = press.open()
    press.until(lambda: press.rejections["unreadable"])
    assert "pos\\x00ition" in press.reasons[-1].reason and "\0" not in source.asset_troubles["press"].why


def test_a_slow_file_holds_up_its_own_asset_and_no_other_one(
    share: Callable[..., Share], monkeypatch: pytest.MonkeyPatch
) -> None:
    hall, end, parse, seen = share("press", "lift", match="{asset}_*"), Event(), log_reader.parse_files, list[str]()

    def wait(folder: Path, files: Sequence[LogFile], *arguments: Any) -> Any:
        seen.extend(file.name for file in files)
        return (files[0].name != "press_0.csv.gz" or end.wait()) and parse(folder, files, *arguments)

    monkeypatch.setattr(log_reader, "parse_files", wait)
    monkeypatch.setattr(log_reader, "QUICK_S", 1.0)
    monkeypatch.setattr(log_reader, "FIRST_S", 1.0)
    for k in range(3):
        packed = gzip.compress(csv(*rows(20 * k, 20)).encode())
        hall.put(f"press_{k}.csv.gz", packed)
        hall.put(f"lift_{k}.csv" + ".gz" * (k == 2), packed if k == 2 else csv(*rows(20 * k, 20)))
    hall.open()
    assert hall.until_rows(60, "lift") == [*range(60)] and not hall.rows_of()
    end.set()
    assert hall.until_rows(60) == [*range(60)]
    names = [*(f"lift_{k}.csv" for k in range(2)), "lift_2.csv.gz", *(f"press_{k}.csv.gz" for k in range(3))]
    assert sorted(seen) == names  # each was read once


def test_rows_that_the_service_refuses_as_ahead_come_again_and_blind_nobody(share: Callable[..., Share]) -> None:
    press = share(afterwards="move")
    press.put("a.csv", csv(*rows(0, 150)))
    source = press.open()
    blocks = []
    until(lambda: blocks.extend(press.turn(commit=False)) or len(blocks) == 3)
    for block in blocks[1:]:  # the clock was set back behind the first one
        source.refuse(block, "future", "ahead")
    press.counted["press"].append(blocks[0].signals)
    source.acknowledge("press", 3)
    assert press.until_rows(150) == [*range(150)]
    press.until(lambda: (press.folder / "done/a.csv").exists())
    assert press.rejections == {"future": 2}


def test_a_late_file_that_lay_there_at_the_start_is_told_and_one_that_was_counted_is_done(
    share: Callable[..., Share],
) -> None:
    press = share(afterwards="move")
    press.note = press.folder.with_name("in-hand")
    press.put("a.csv", csv(*rows(100, 50)))
    press.open()
    press.until_rows(50)
    press.until(lambda: (press.folder / "done/a.csv").exists())
    press.put("b.csv", csv(*rows(150, 50)))
    until(lambda: len(press.turn(commit=False)) == 1)
    press.kept["press"] = press.kept["press"]._replace(sequence=1, last_t=BEGAN + 1.99)  # killed before it was moved
    press.kill()
    press.put("late.csv", csv(*rows(0, 50)))
    press.open()
    press.until(lambda: (press.folder / "failed/late.csv").exists() and (press.folder / "done/b.csv").exists())
    assert [one.reason.partition(":")[0] for one in press.reasons] == ["late.csv"] and press.rejections == {"late": 1}
