"""What the command line refuses: one line on stderr, an exit code, and nothing half-written."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import loop_with, one_line, prepared, rows_of, run, write_rows

from servoscope.cli.app import _format_warning
from servoscope.core.errors import ObsoleteSettingWarning


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepared(tmp_path_factory.mktemp("made"))


def spoiled(change: Callable[[dict[str, Any]], dict[str, Any]]) -> Callable[[Path, Path], Path]:
    def make(folder: Path, made: Path) -> Path:
        return write_rows(folder / "bad.csv", change(rows_of(made / "healthy.csv")))

    return make


def text_in(rows: dict[str, Any]) -> dict[str, Any]:
    y = rows["y"].astype(object)
    y[100] = "error 7"
    return {**rows, "y": y}


def raw(content: bytes) -> Callable[[Path, Path], Path]:
    def make(folder: Path, made: Path) -> Path:
        (folder / "bad.csv").write_bytes(content)
        return folder / "bad.csv"

    return make


BAD_RECORDINGS = {
    "empty": (raw(b""), "empty"),
    "no column": (spoiled(lambda rows: {k: x for k, x in rows.items() if k != "u"}), "'u'"),
    "text": (spoiled(text_in), "error 7"),
    "constant": (spoiled(lambda rows: {**rows, "y": 0.0 * rows["y"]}), "y"),
    "another type": (raw(b"%PDF-1.7\n%\xe2\xe3\xcf\xd3\n1 0 obj\n" * 50), "PDF"),
    "backwards": (spoiled(lambda rows: {**rows, "t": rows["t"][::-1]}), "backwards"),
    "sample rate": (spoiled(lambda rows: {**rows, "t": 1.02 * rows["t"]}), "Hz"),
    "all NaN": (spoiled(lambda rows: {**rows, "u": np.nan * rows["u"]}), "u"),
    "five samples": (spoiled(lambda rows: {k: x[:5] for k, x in rows.items()}), "5"),
    "swapped": (spoiled(lambda rows: {**rows, "u": rows["y"], "y": rows["u"]}), "swapped"),
}


@pytest.mark.parametrize("case", BAD_RECORDINGS)
def test_a_bad_recording_is_one_line(case: str, made: Path, tmp_path: Path) -> None:
    make, word = BAD_RECORDINGS[case]
    path = make(tmp_path, made)
    before = set(tmp_path.iterdir())
    one_line(run("diagnose", made / "baseline.json", path), "bad.csv", word)
    one_line(run("learn", made / "loop.toml", path, "-o", tmp_path / "b.json"), "bad.csv", word)
    assert set(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("sample_rate", "sample_rat", "'sample_rate'"),
        ("m_p = 4.0", "m_p = -4.0", "m_p"),
        ("[controller]", "[monitor]\ncutoff = 60.0\n\n[controller]", "Nyquist"),
        ("[controller]", "[controller", "TOML"),
    ],
)
def test_a_bad_loop_file_is_one_line(old: str, new: str, word: str, made: Path, tmp_path: Path) -> None:
    loop = loop_with(tmp_path, made, old, new)
    one_line(run("learn", loop, made / "healthy.csv", "-o", tmp_path / "b.json"), "changed.toml", word)
    one_line(run("simulate", loop, "-o", tmp_path / "x.csv"), "changed.toml", word)
    one_line(run("inspect", made / "healthy.csv", "--loop", loop), "changed.toml", word)
    assert [path.name for path in tmp_path.iterdir()] == ["changed.toml"]


def test_a_bad_baseline_is_one_line(made: Path, tmp_path: Path) -> None:
    content = json.loads((made / "baseline.json").read_text(encoding="utf-8"))
    path = tmp_path / "b.json"
    path.write_text(json.dumps({**content, "version": 99}), encoding="utf-8")
    one_line(run("diagnose", path, made / "healthy.csv"), "b.json", "99", "learn it again")
    path.write_text(json.dumps({**content, "R": "much"}), encoding="utf-8")
    one_line(run("diagnose", path, made / "healthy.csv"), "b.json", "R")
    one_line(run("diagnose", made / "loop.toml", made / "healthy.csv"), "loop.toml", "not a baseline")
    one_line(run("diagnose", tmp_path / "none.json", made / "healthy.csv"), "none.json", "no such file")


def test_an_output_that_cannot_be_written_is_one_line_and_leaves_nothing(made: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("here")
    for folder in (tmp_path / "file", tmp_path / "none"):
        one_line(run("simulate", made / "loop.toml", "-o", folder / "x.csv"), "x.csv", "cannot be written")
        one_line(run("learn", made / "loop.toml", made / "healthy.csv", "-o", folder / "b.json"), "b.json")
        for option, name in (("--report", "r.html"), ("--trace", "t.parquet")):
            one_line(run("diagnose", made / "baseline.json", made / "healthy.csv", option, folder / name), name)
    pages = run("diagnose", made / "baseline.json", made / "healthy.csv", "--report", tmp_path / "file" / "pages")
    one_line(pages, "pages")
    one_line(run("demo", "-o", tmp_path / "file"), "file")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_text() == "here"


def test_a_wrong_command_line_exits_with_2(made: Path, tmp_path: Path) -> None:
    loop, healthy, baseline = made / "loop.toml", made / "healthy.csv", made / "baseline.json"
    wrong: list[tuple[Any, ...]] = [
        ("diagnos", baseline),
        ("diagnose", baseline, healthy, "--jsn"),
        ("diagnose", baseline, healthy, "--where", "load"),
        ("diagnose", baseline, healthy, "--columns", "output"),
        ("diagnose", baseline, healthy, "--report", tmp_path / "r.docx"),
        ("diagnose", baseline, healthy, "--trace", tmp_path / "t.csv"),
        ("learn", loop, "-o", tmp_path / "b.json"),
        ("learn", loop, healthy, "--nominal", "-o", tmp_path / "b.json"),
        ("simulate", loop, "-o", tmp_path / "x.xlsx"),
        ("simulate", loop, "-o", tmp_path / "x.csv", "--fault", "C_ie"),
        ("simulate", loop, "-o", tmp_path / "x.csv", "--reference", "sinus"),
        ("simulate", loop, "-o", tmp_path / "x.csv", "--duration", "long"),
        ("simulate", loop, "-o", tmp_path / "x.csv", "--duration", "-1"),
        ("simulate", loop, "-o", tmp_path / "x.csv", "--duration", "1e9"),
        ("simulate", loop),
    ]
    for words in wrong:
        result = run(*words)
        assert result.code == 2, words
        assert result.out == ""
        assert "Traceback" not in result.err
    assert list(tmp_path.iterdir()) == []


def test_no_command_overwrites_its_inputs(made: Path, tmp_path: Path) -> None:
    loop = tmp_path / "loop.csv"
    loop.write_bytes((made / "loop.toml").read_bytes())
    recording = tmp_path / "x.parquet"
    assert run("simulate", loop, "-o", recording, "--duration", 20, "--seed", 9).code == 0
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert run("simulate", loop, "-o", loop).code == 2
    assert run("learn", loop, recording, "-o", recording).code == 2
    assert run("diagnose", made / "baseline.json", recording, "--trace", recording).code == 2
    one_line(run("diagnose", made / "baseline.json", recording, "--trace", tmp_path), "overwritten")
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("compiled", [False, True])
def test_an_interrupt_is_quiet(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compiled: bool) -> None:
    def interrupted(path: Path) -> None:
        if compiled:  # what Python makes of one that comes while compiled code runs
            inner = SystemError("returned a result with an exception set")
            inner.__cause__ = KeyboardInterrupt()
            raise SystemError("returned a result with an exception set") from inner  # once for each compiled caller
        raise KeyboardInterrupt

    monkeypatch.setattr("servoscope.models.loop.Loop.load", interrupted)
    result = run("simulate", made / "loop.toml", "-o", tmp_path / "x.csv")
    assert (result.code, result.out, result.err) == (130, "", "")


@pytest.mark.parametrize(
    ("module", "extra"),
    [("sqlalchemy.exc", "service"), ("segno", "service"), ("prometheus_client", "service"), ("fastapi", "web")],
)
def test_an_extra_that_is_not_installed_is_named(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, extra: str
) -> None:
    def missing(path: Path) -> None:
        raise ModuleNotFoundError(f"No module named '{module}'", name=module)

    monkeypatch.setattr("servoscope.models.loop.Loop.load", missing)
    result = run("simulate", made / "loop.toml", "-o", tmp_path / "x.csv")
    assert result.code == 1 and result.out == ""
    assert result.err == f"servoscope: {module.partition('.')[0]} is missing, pip install 'servoscope[{extra}]'\n"


def test_a_fault_of_the_program_keeps_its_traceback(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(path: Path) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("servoscope.models.loop.Loop.load", broken)
    with pytest.raises(ZeroDivisionError):
        run("simulate", made / "loop.toml", "-o", tmp_path / "x.csv")


def test_a_setting_of_an_earlier_version_is_one_line() -> None:
    told = _format_warning("loop.toml: gone", ObsoleteSettingWarning, "settings.py", 7)
    assert told == "servoscope: warning: loop.toml: gone\n"
    assert "settings.py:7" in _format_warning("other", RuntimeWarning, "settings.py", 7)
