"""What `init` says of a log is true: what is missing, what is in doubt, what the user's answers leave open."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from commands import one_line, run
from logs import german_axis

from servoscope.models.loop import Loop


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    text = german_axis(tmp_path_factory.mktemp("answers") / "achse.csv").read_text(encoding="utf-8")
    return [line.replace(",", ".") for line in text.splitlines() if line[:1].isdigit()]


def log(folder: Path, header: str, rows: list[str], name: str = "log.csv") -> Path:
    path = folder / name
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def doubts(out: str) -> set[str]:
    """Return the keys of a proposal that are in doubt."""
    return set(re.findall(r"^  ! (\w+) = ", out, re.MULTILINE))


def test_a_log_without_r_says_so(rows: list[str], tmp_path: Path) -> None:
    rows = [";".join(row.split(";")[k] for k in (0, 2, 3)) for row in rows]
    told = run("init", log(tmp_path, "t [ms];torque [Nm];position [mm]", rows), "-o", tmp_path / "loop.toml")
    assert told.code == 0 and "reference" in doubts(told.out)
    assert "no column fits" in told.out and "--columns 'r=...'" in " ".join(told.out.split())
    assert "no column fits" in (tmp_path / "loop.toml").read_text(encoding="utf-8")
    assert Loop.load(tmp_path / "loop.toml").columns.reference == "r"


@pytest.mark.parametrize("words", [("q_des", "tau", "q"), ("Pos_Cmd", "i_q", "Pos_Fbk"), ("sp", "cur", "pv")])
def test_short_names_are_known(words: tuple[str, str, str], rows: list[str], tmp_path: Path) -> None:
    path = log(tmp_path, f"t [ms];{words[0]};{words[1]};{words[2]}", rows)
    assert run("init", path, "-o", tmp_path / "loop.toml").code == 0
    columns = Loop.load(tmp_path / "loop.toml").columns
    assert (columns.reference, columns.input, columns.output) == words


def test_an_answer_keeps_the_other_guesses(rows: list[str], tmp_path: Path) -> None:
    path = log(tmp_path, "t [ms];Sollposition [mm];kanal 7;Istposition [mm]", rows)
    line = one_line(run("init", path, "-o", tmp_path / "a.toml", "--yes"), "no name suggests u")
    assert "--columns 't=`t [ms]`[ms], r=0.001 * `Sollposition [mm]`, u=..., y=0.001 * `Istposition [mm]`'" in line
    assert run("init", path, "-o", tmp_path / "a.toml", "--columns", "u=`kanal 7`").code == 0
    columns = Loop.load(tmp_path / "a.toml").columns
    assert (columns.reference, columns.time_unit) == ("0.001 * `Sollposition [mm]`", "ms")


def test_a_clock_that_counts_is_in_doubt(rows: list[str], tmp_path: Path) -> None:
    rows = [f"{k};{row.split(';', 1)[1]}" for k, row in enumerate(rows)]
    told = run("init", log(tmp_path, "time;target;torque;position", rows), "-o", tmp_path / "loop.toml", "--yes")
    assert "counts in steps of 1" in " ".join(told.out.split()) and "time_unit" in doubts(told.out)


def test_r_in_another_unit_is_in_doubt(rows: list[str], tmp_path: Path) -> None:
    rows = [";".join([row.split(";")[0], str(57.3 * float(row.split(";")[1])), *row.split(";")[2:]]) for row in rows]
    told = run("init", log(tmp_path, "t [ms];target;torque;position", rows), "-o", tmp_path / "loop.toml", "--yes")
    assert "in another unit" in " ".join(told.out.split()) and "reference" in doubts(told.out)


def test_a_stamp_and_a_constant_are_no_output(rows: list[str], tmp_path: Path) -> None:
    rows = [f"{row};{1000 + k};0;0.5;ok" for k, row in enumerate(rows)]
    header = "t [ms];target;torque;angle;header.stamp.sec;speed;position_limit;position state"
    assert run("init", log(tmp_path, header, rows), "-o", tmp_path / "loop.toml", "--yes").code == 0
    assert Loop.load(tmp_path / "loop.toml").columns.output == "angle"


def test_rows_of_one_machine(rows: list[str], tmp_path: Path) -> None:
    both = [f"{row};{machine}" for machine in ("A", "B") for row in rows]
    told = run(
        "init", log(tmp_path, "t [ms];target;torque;angle;machine", both), "-o", tmp_path / "loop.toml", "--where",
        "machine=B", "--yes",
    )  # fmt: skip
    assert told.code == 0 and f"{len(rows)} samples" in told.out
    assert "--where machine=B" in " ".join(told.out.split())
