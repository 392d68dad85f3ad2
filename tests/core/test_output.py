"""Writing files whole: errors in one line, nothing half-written left, links and devices."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from commands import run

from servoscope.core.errors import OutputError
from servoscope.core.files import atomic_write


def test_where_nothing_can_be_written_is_told_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    for path, reason in (
        (tmp_path / "none" / "r.html", "there is no folder"),
        (tmp_path / "file" / "r.html", "there is no folder"),
        (tmp_path, "is a directory"),
        (tmp_path / ("x" * 300), "name too long"),
        (f"{tmp_path}/a\0b", "cannot be written"),
    ):
        with pytest.raises(OutputError, match=f"(?i){reason}") as caught:
            atomic_write(path, b"x")
        assert "\n" not in str(caught.value) and "\0" not in str(caught.value)
    assert [each.name for each in tmp_path.iterdir()] == ["file"]


def test_writing_follows_links_and_leaves_devices_alone(tmp_path: Path) -> None:
    (tmp_path / "real").write_bytes(b"old")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    atomic_write(tmp_path / "link", b"new")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "real").read_bytes() == b"new"
    atomic_write(os.devnull, b"gone")
    assert not Path(os.devnull).is_file()


def test_names_cannot_steer_the_terminal(tmp_path: Path) -> None:
    """Those of files and columns come from strangers; a terminal obeys what begins with ESC."""
    path = tmp_path / "\x1b[2Jlog.csv"
    path.write_text("t,r\x1b[31m,u\x07,y\n" + "".join(f"{0.01 * k:.2f},{k % 7},{k % 5},{k % 3}\n" for k in range(300)))
    result = run("inspect", path)
    assert "?[2Jlog.csv" in result.out and "r?[31m" in result.out
    assert not set("\x1b\x07") & set(result.out + result.err)
