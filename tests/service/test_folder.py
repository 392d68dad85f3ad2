"""A source of kind folder: which files are read, when, in which order; each row once, whatever happens in between."""

from __future__ import annotations

import errno
import gzip
import os
import time
import zipfile
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from brokers import until
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from shares import BEGAN, LOOP, Share, csv, rows

from servoscope.core.errors import ConfigError
from servoscope.models.loop import Columns
from servoscope.service.sources import log_reader
from servoscope.service.sources import share as share_module


def test_files_are_read_in_the_order_of_their_first_time_stamps_and_each_row_counts_once(
    share: Callable[..., Share],
) -> None:
    press = share()
    press.put("c.csv", csv(*rows(0, 150)))
    press.put("b.csv", csv(*rows(100, 150)))  # overlaps the one before
    press.put("a.csv", csv(*rows(250, 100)))
    press.open()
    assert press.until_rows(350) == list(range(350))
    signals = np.concatenate(press.counted["press"], axis=1)
    assert np.allclose(signals[0], BEGAN + 0.01 * np.arange(350), rtol=0.0, atol=1e-6)
    assert np.array_equal(signals[2:], [np.arange(350) + 0.5, 2.0 * np.arange(350)])
    press.settle()
    assert not press.rejections


def test_the_same_content_again_is_skipped_and_counted_and_late_rows_are_told(share: Callable[..., Share]) -> None:
    press = share()
    press.put("a.csv", csv(*rows(100, 100)))
    press.open()
    press.until_rows(100)
    press.put("copy.csv", csv(*rows(100, 100)))
    press.until(lambda: press.rejections["repeated"])
    press.put("late.csv", csv(*rows(0, 50)))
    press.until(lambda: press.rejections["late"])
    press.put("next.csv", csv(*rows(200, 50)))
    assert press.until_rows(150) == list(range(100, 250))
    assert [one.reason for one in press.reasons] == [
        "copy.csv has the content of a.csv",
        "late.csv: all its rows were counted before, or come too late",
    ]


def test_logs_of_the_same_content_count_where_their_names_say_another_asset_or_time(
    share: Callable[..., Share],
) -> None:
    hall = share("press", "lift", match="{asset}_{time}.csv")
    at_rest = csv(*((0.01 * k, 0.0, 0.0, 0.0) for k in range(100)))
    for name in ("press_20260101_000000", "lift_20260101_000000", "press_20260101_000100"):
        hall.put(f"{name}.csv", at_rest)
    hall.open()
    hall.until_rows(100, "lift")
    hall.until_rows(200, "press")
    assert not hall.rejections


def test_a_file_is_read_when_it_has_not_changed_for_a_while_and_one_that_grows_is_read_again(
    share: Callable[..., Share],
) -> None:
    press = share(complete_after_s=0.4)
    press.open()
    path = press.put("log.csv", csv(*rows(0, 50)))
    begin = time.monotonic()
    for k in range(50, 100, 10):
        time.sleep(0.1)
        press.turn()
        with path.open("a") as file:
            file.write(csv(*rows(k, 10)).partition("\n")[2])
    last_change = time.monotonic()
    assert press.until_rows(100) == list(range(100))
    assert time.monotonic() - last_change > 0.35 and last_change - begin > 0.4
    with path.open("a") as file:
        file.write(csv(*rows(100, 100)).partition("\n")[2])
    assert press.until_rows(200) == list(range(200))
    assert not press.rejections


def test_temporary_names_and_links_are_left_alone(share: Callable[..., Share], tmp_path: Path) -> None:
    press = share()
    secret = tmp_path / "secret.csv"
    secret.write_text(csv(*rows(1000, 50)))
    press.put("b.csv.part", csv(*rows(100, 50)))
    press.put("~$c.csv", csv(*rows(100, 50)))
    press.put(".d.csv", csv(*rows(100, 50)))
    (press.folder / "link.csv").symlink_to(secret)
    (press.folder / "linked").symlink_to(tmp_path)
    press.put("a.csv", csv(*rows(0, 50)))
    press.open()
    press.until_rows(50)
    press.settle()
    assert press.rows_of() == list(range(50))
    (press.folder / "b.csv.part").rename(press.folder / "b.csv")
    assert press.until_rows(100) == [*range(50), *range(100, 150)]


def test_a_file_that_cannot_be_read_is_set_aside_and_the_next_good_one_ends_the_alarm(
    share: Callable[..., Share],
) -> None:
    press = share("press", "lift", match="{asset}_*.csv")
    press.put("press_1.csv", csv(*rows(0, 50)).replace("0.2,20.0", "0.2,twenty"))
    press.put("lift_1.csv", csv(*rows(0, 50)))
    source = press.open()
    press.until_rows(50, "lift")
    press.until(lambda: press.rejections["unreadable"])
    assert press.reasons[0].asset == "press"
    trouble = source.asset_troubles["press"]
    assert trouble.state == "refused" and "press_1.csv" in trouble.why
    assert "lift" not in source.asset_troubles
    press.put("press_1b.csv", (press.folder / "press_1.csv").read_bytes())  # the same content once more
    press.until(lambda: press.rejections["repeated"])
    press.put("press_2.csv", csv(*rows(50, 50)))
    assert press.until_rows(50) == list(range(50, 100))
    assert not source.asset_troubles
    assert press.rejections == {"unreadable": 1, "repeated": 1}
    assert (press.folder / "press_1.csv").exists()


def test_files_move_to_done_or_failed_once_they_are_stored(share: Callable[..., Share]) -> None:
    press = share(afterwards="move")
    press.put("a.csv", csv(*rows(100, 50)))
    press.put("bad.csv", "t,r,u,y\n1,2,x,4\n" * 30)
    press.open()
    blocks = []
    until(lambda: blocks.extend(press.turn(commit=False)) or len(blocks) == 1)
    time.sleep(0.3)
    assert (press.folder / "a.csv").exists()  # nothing is stored yet
    press.source.acknowledge("press", 1)  # type: ignore[union-attr]
    press.until(lambda: (press.folder / "done/a.csv").exists() and (press.folder / "failed/bad.csv").exists())
    press.put("a.csv", csv(*rows(150, 50)))  # the next one under the same name
    press.until(lambda: len(list((press.folder / "done").iterdir())) == 2)
    press.put("late.csv", csv(*rows(0, 50)))
    press.until(lambda: (press.folder / "failed/late.csv").exists())
    assert (
        press.reasons[-1].asset == "press" and "late.csv: all its rows were counted before" in press.reasons[-1].reason
    )
    assert not list(press.folder.glob("*.csv"))


def test_empty_files_are_counted_and_raise_no_alarm(share: Callable[..., Share]) -> None:
    press = share()
    press.put("a.csv", "")
    press.put("b.csv", "t,r,u,y\n")
    press.put("c.csv", csv(*rows(0, 50)))
    source = press.open()
    press.until_rows(50)
    press.settle()
    assert press.rejections == {"empty": 2}
    assert not source.asset_troubles


def test_each_format_is_read_packed_or_not(share: Callable[..., Share]) -> None:
    press = share()
    table = pa.table(np.array(rows(0, 100)).T.tolist(), names=["t", "r", "u", "y"])
    pq.write_table(table, press.folder / "a.parquet")
    press.put("b.csv.gz", gzip.compress(csv(*rows(100, 100)).encode()))
    with zipfile.ZipFile(press.folder / "c.zip", "w") as archive:
        archive.writestr("c.csv", csv(*rows(200, 100)))
    press.put("d.txt", csv(*rows(300, 100)).replace(",", "\t"))
    press.put("e.csv", csv(*rows(400, 100)).replace(",", ";").replace(".", ","))
    press.open()
    assert press.until_rows(500) == list(range(500))
    assert not press.rejections


def test_subfolders_names_or_a_column_say_which_asset_it_is(share: Callable[..., Share]) -> None:
    for match, names in (
        ("{asset}/*.csv", ("P07/1.csv", "lift/1.csv")),
        ("*_{asset}.csv", ("1_P07.csv", "1_lift.csv")),
    ):
        hall = share("press", "lift", match=match, called={"press": "P07"})
        for k, name in enumerate(names):
            hall.put(name, csv(*rows(100 * k, 60)))
        hall.put(names[0].replace("P07", "P08"), csv(*rows(500, 60)))  # nobody's
        hall.open()
        assert hall.until_rows(60, "press") == list(range(60))
        assert hall.until_rows(60, "lift") == list(range(100, 160))
    hall = share("press", "lift", asset_column="machine", called={"press": "7"})
    lines = [line for k, row in enumerate(rows(0, 120)) for line in [(*row, ("7", "lift", "8")[k % 3])]]
    one_each = [(t - 0.01 * (k % 3) - 0.02 * (k // 3), *rest) for k, (t, *rest) in enumerate(lines)]
    hall.put("all.csv", csv(*one_each, header="t,r,u,y,machine").replace("'", ""))
    hall.open()
    assert hall.until_rows(40, "press") == list(range(0, 120, 3))
    assert hall.until_rows(40, "lift") == list(range(1, 120, 3))


def test_rows_that_only_count_seconds_are_dated_by_the_name_or_by_when_the_file_was_written(
    share: Callable[..., Share],
) -> None:
    press = share(match="log_{time}.csv")
    press.put("log_2026-01-01_00-00-10.csv", csv(*rows(0, 100, origin=0.0)))
    press.open()
    press.until_rows(100)
    assert np.allclose(press.counted["press"][0][0], BEGAN + 10.0 + 0.01 * np.arange(50), rtol=0.0, atol=1e-6)
    press = share()
    press.put("trace.csv", csv(*rows(0, 100, origin=0.0)), modified=BEGAN + 99.0)
    press.open()
    press.until_rows(100)
    assert press.counted["press"][-1][0, -1] == pytest.approx(BEGAN + 99.0, abs=1e-6)


def test_local_dates_are_those_of_their_zone(share: Callable[..., Share]) -> None:
    loop = LOOP.model_copy(update={"columns": Columns(time_zone="Europe/Berlin")})
    press = share(loop=loop)
    local = [datetime.fromtimestamp(t + 3600.0, UTC).isoformat(" ", "milliseconds")[:-6] for t, *_ in rows(0, 100)]
    press.put("a.csv", csv(*((t, *rest) for t, (_, *rest) in zip(local, rows(0, 100), strict=True))).replace("'", ""))
    press.open()
    press.until_rows(100)
    assert np.allclose(
        np.concatenate([one[0] for one in press.counted["press"]]), BEGAN + 0.01 * np.arange(100), rtol=0.0, atol=1e-6
    )


def test_a_machine_that_stands_still_is_followed(share: Callable[..., Share]) -> None:
    press = share()
    press.put("a.csv", csv(*((t, 0.0, 0.0, 1.0) for t, *_ in rows(0, 100))))
    press.open()
    assert len(press.until_rows(100)) == 100
    assert not press.rejections


def test_a_start_leaves_out_what_was_logged_before(share: Callable[..., Share]) -> None:
    press = share(start=datetime.fromtimestamp(BEGAN + 0.5, UTC))
    press.put("a.csv", csv(*rows(0, 100)))
    press.open()
    press.until_rows(48)
    press.settle()
    assert press.rows_of() == list(range(51, 100))
    press = share(start="now")
    press.put("a.csv", csv(*rows(0, 100)))
    press.open()
    now = time.time()
    press.put("b.csv", csv(*rows(0, 100, origin=now)))
    press.until_rows(95)
    press.settle()
    assert press.rows_of()[-1] == 99.0 and press.counted["press"][0][0, 0] > now - 1.0


def test_a_folder_that_goes_has_an_alarm_of_its_own_and_nobody_is_silent(share: Callable[..., Share]) -> None:
    press = share()
    press.put("a.csv", csv(*rows(0, 50)))
    source = press.open()
    press.until_rows(50)
    press.settle()
    assert source.connected and not source.trouble
    press.folder.rename(press.folder.with_name("gone"))
    press.until(lambda: source.trouble)
    assert str(press.folder) in source.trouble and "No such file" in source.trouble
    assert not source.connected and source.pause_s == np.inf and not source.asset_troubles
    press.folder.with_name("gone").rename(press.folder)
    press.put("b.csv", csv(*rows(50, 50)))
    assert press.until_rows(100) == list(range(100))
    assert source.connected and not source.asset_troubles and not press.rejections


def test_a_share_that_does_not_answer_is_told(share: Callable[..., Share], monkeypatch: pytest.MonkeyPatch) -> None:
    press = share()
    source = press.open()
    press.settle()
    source.transport._reader.asked_at = time.monotonic() - 31.0
    assert os.strerror(errno.ETIMEDOUT) in source.trouble


def test_a_file_that_may_not_be_opened_is_tried_again(
    share: Callable[..., Share], monkeypatch: pytest.MonkeyPatch
) -> None:
    press = share()
    opened, locked = share_module.Share.file, [True]

    def refuse(kept: share_module.Share, name: str) -> Any:
        if name == "locked.csv" and locked[0]:
            raise PermissionError(errno.EACCES, "Permission denied")
        return opened(kept, name)

    press.put("locked.csv", csv(*rows(0, 50)))
    monkeypatch.setattr(share_module.Share, "file", refuse)
    source = press.open()
    press.until(lambda: press.rejections["unreadable"])
    assert "Permission denied" in source.asset_troubles["press"].why
    time.sleep(0.2)
    locked[0] = False
    assert press.until_rows(50) == list(range(50))
    assert press.rejections == {"unreadable": 1}


def test_a_file_that_changes_while_it_is_read_is_read_again(
    share: Callable[..., Share], monkeypatch: pytest.MonkeyPatch
) -> None:
    press = share()
    path = press.put("a.csv", csv(*rows(0, 50)))
    parse, grown = log_reader.parse_files, []

    def grow(*arguments: Any) -> Any:
        found = parse(*arguments)
        if not grown:
            with path.open("a") as more:
                more.write(csv(*rows(50, 50)).partition("\n")[2])
            grown.append(True)
        return found

    monkeypatch.setattr(log_reader, "parse_files", grow)
    press.open()
    assert press.until_rows(100) == list(range(100))
    assert all(block.shape[1] == 50 for block in press.counted["press"])


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    spans=st.lists(st.tuples(st.integers(0, 200), st.integers(2, 120)), min_size=1, max_size=5),
    limits=st.lists(st.integers(1, 4), min_size=1, max_size=6),
    commits=st.lists(st.booleans(), min_size=6, max_size=6),
)
def test_every_row_counts_once_whatever_overlaps_and_whenever_it_is_killed(
    tmp_path_factory: pytest.TempPathFactory,
    spans: list[tuple[int, int]],
    limits: list[int],
    commits: list[bool],
) -> None:
    """Kill between any two polls; what was polled and not stored comes again, and nothing else does."""
    press = Share(tmp_path_factory.mktemp("share"), complete_after_s=0.001, poll_s=0.005)
    for k, (first, count) in enumerate(spans):
        press.put(f"{k}.csv", csv(*rows(first, count)))
    expected = sorted({k for first, count in spans for k in range(first, first + count)})
    for limit, commit in zip(limits, commits, strict=False):
        press.open()
        deadline = time.monotonic() + 0.05
        while not press.turn(limit, commit=commit) and time.monotonic() < deadline:
            time.sleep(0.002)
        press.kill()
    source = press.open()
    press.until(lambda: source.pause_s < np.inf and press.rows_of() == expected)  # at rest before it has begun, too
    press.kill()
    counted = press.rows_of()
    assert counted == sorted(set(counted)), "each at most once, in order"
    assert counted == expected
    sequences = press.kept["press"].sequence
    assert sequences == len(press.counted["press"]) - 1


def test_settings_that_do_not_say_which_asset_a_file_is_of_are_refused(share: Callable[..., Share]) -> None:
    for words, assets, more in (
        ("write {asset}", ("press", "lift"), {}),
        ("write {asset}", ("press",), {"match": "{asset}.csv", "asset_column": "a"}),
        ("no asset 'lift'", ("press",), {"called": {"lift": "L"}}),
        ("called the same", ("press", "lift"), {"match": "{asset}.csv", "called": {"press": "lift"}}),
        ("a path in the folder", ("press",), {"match": "{asset}/{asset}.csv"}),
    ):
        with pytest.raises(ConfigError, match=words):
            share(*assets, **more).open()
