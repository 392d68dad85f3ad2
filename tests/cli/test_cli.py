"""The command line from end to end: results, exit codes, files, pure JSON."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from commands import loop_with, one_line, prepared, rows_of, run, write_rows
from sources import load

import servoscope as ss
from servoscope.cli import progress

PROJECT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepared(tmp_path_factory.mktemp("made"))


def test_demo_says_what_it_does_and_leaves_all_its_files(tmp_path: Path) -> None:
    result = run("demo", "-o", tmp_path / "out")
    assert result.code == 0
    assert "leakage has risen by a fifth" in result.out and "C_ie × 1.199" in result.out
    assert result.out.count("$ servoscope ") == 4
    commands = [line for line in result.out.splitlines() if line.startswith(("$", "    "))]
    assert all(len(line) <= 80 or len(line.split()) <= 3 for line in commands)
    assert any(line.endswith(" \\") for line in commands) and "coefficients of s^0 ... s^3" in result.out
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "baseline.json",
        "diagnosis.json",
        "healthy.csv",
        "loop.toml",
        "report.html",
        "suspect.csv",
        "trace.parquet",
    }
    diagnosis = json.loads((tmp_path / "out" / "diagnosis.json").read_text(encoding="utf-8"))
    (fault,) = diagnosis["faults"]
    assert fault["interval"][0] < 1.2 < fault["interval"][1]
    assert abs(diagnosis["onset_s"][1] - 30.0) < 0.5
    pictures = load(PROJECT / "scripts" / "pictures.py")
    shows = pictures.shown_by_report((tmp_path / "out" / "report.html").read_text(encoding="utf-8"))
    drawn = [name for name in pictures.pictures() if name.startswith(pictures.DEMONSTRATION)]
    assert drawn and [stale for name in drawn if (stale := pictures.stale(name, shows))] == []


def test_simulate_tells_the_truth(made: Path, tmp_path: Path) -> None:
    result = run(
        *("simulate", made / "loop.toml", "-o", tmp_path / "x.parquet", "--reference", "multisine"),
        *("--duration", 20, "--fault", "leakage=1.5@10~5", "--fault", "p_s=0.9@15", "--seed", 3, "--json"),
    )
    assert result.code == 0
    said = json.loads(result.out)
    assert said["samples"] == 2000
    assert [(f["name"], f["parameter"], f["ratio"], f["at_s"], f["ramp_s"]) for f in said["faults"]] == [
        ("leakage", "C_ie", 1.5, 10.0, 5.0),
        ("pump", "p_s", 0.9, 15.0, 0.0),
    ]
    assert pq.read_table(tmp_path / "x.parquet").column_names == ["t", "r", "u", "y"]


def test_simulate_writes_what_the_loop_reads(made: Path, tmp_path: Path) -> None:
    names = '[columns]\ntime = "Time"\ntime_unit = "ms"\nreference = "set point"\nsegment = ["run"]\n\n[plant]'
    loop = loop_with(tmp_path, made, "[plant]", names)
    for suffix in ("csv", "parquet"):
        path = tmp_path / f"x.{suffix}"
        assert run("simulate", loop, "-o", path, "--duration", 20).code == 0
        said = json.loads(run("inspect", path, "--loop", loop, "--json").out)
        assert said["sampling"]["samples"] == 2000
        assert said["sampling"]["sample_rate_hz"] == pytest.approx(100.0)
        assert said["defects"] == []


def test_simulate_says_how_to_read_columns_that_are_no_plain_names(made: Path, tmp_path: Path) -> None:
    loop = loop_with(tmp_path, made, "[plant]", '[columns]\noutput = "0.025 * counts"\n\n[plant]')
    result = run("simulate", loop, "-o", tmp_path / "x.csv", "--duration", 5)
    assert "--columns 't=t, r=r, u=u, y=y'" in " ".join(result.out.split())
    assert list(rows_of(tmp_path / "x.csv")) == ["t", "r", "u", "y"]


def test_inspect_lists_the_columns_of_a_file_that_needs_a_mapping(made: Path, tmp_path: Path) -> None:
    rows = rows_of(made / "healthy.csv")
    path = write_rows(tmp_path / "x.csv", {"zeit": rows["t"], "soll": rows["r"], "k": rows["u"], "ist": rows["y"]})
    result = run("inspect", path)
    assert result.code == 0 and result.err == ""
    assert "perhaps: --columns 't=zeit, r=soll, y=ist'" in result.out and "no name suggests u: say which" in result.out
    assert f"servoscopeinit{path}" in "".join(result.out.split())  # wrapped where the path is long
    for name in ("zeit", "soll", "k", "ist"):
        assert f"  {name} " in result.out
    listed = json.loads(run("inspect", path, "--json").out)
    assert [channel["name"] for channel in listed["channels"]] == ["zeit", "soll", "k", "ist"]
    mapped = run("inspect", path, "--columns", "t=zeit, r=soll, u=k, y=ist", "--report", tmp_path / "x.html")
    assert mapped.code == 0
    assert "Usable" in mapped.out
    assert "<html" in (tmp_path / "x.html").read_text(encoding="utf-8")


def test_learn_prints_what_it_found(made: Path, tmp_path: Path) -> None:
    result = run("learn", made / "loop.toml", made / "healthy.csv", "-o", tmp_path / "b.json")
    for word in ("theta_3", "C_ie", "leakage", "noise", "delay", "explained", "false alarms", "model_error"):
        assert word in result.out
    assert max(map(len, result.out.splitlines()[:-1])) <= 80
    said = json.loads(run("learn", made / "loop.toml", made / "healthy.csv", "-o", tmp_path / "c.json", "--json").out)
    assert said["healthy_ratios"]["C_ie"] == pytest.approx(1.0, abs=0.02)
    assert said["explained"] > 0.99
    assert (tmp_path / "b.json").read_bytes() == (tmp_path / "c.json").read_bytes()


def test_a_nominal_baseline_needs_no_recording(made: Path, tmp_path: Path) -> None:
    assert run("learn", made / "loop.toml", "--nominal", "-o", tmp_path / "b.json").code == 0
    said = json.loads(run("diagnose", tmp_path / "b.json", made / "suspect.csv", "--json").out)
    assert said["verdict"] == "fault"


def test_learn_keeps_its_columns_in_the_baseline(made: Path, tmp_path: Path) -> None:
    for name in ("healthy", "suspect"):
        rows = rows_of(made / f"{name}.csv")
        write_rows(
            tmp_path / f"{name}.csv", {"time": rows["t"], "r": rows["r"], "amps": 0.5 * rows["u"], "y": rows["y"]}
        )
    mapping = ("--columns", "t=time, u=2 * amps")
    baseline = tmp_path / "b.json"
    assert run("learn", made / "loop.toml", tmp_path / "healthy.csv", "-o", baseline, *mapping).code == 0
    result = run("diagnose", baseline, tmp_path / "suspect.csv")
    assert result.code == 3
    assert "leakage has risen by a fifth" in result.out and "C_ie × 1.199" in result.out
    assert run("diagnose", baseline, made / "suspect.csv", "--columns", "t=t, u=u").code == 3


def test_diagnose_writes_json_report_and_trace(made: Path, tmp_path: Path) -> None:
    outputs = ("--report", tmp_path / "r.html", "--trace", tmp_path / "t.parquet")
    result = run("diagnose", made / "baseline.json", made / "suspect.csv", "--json", *outputs)
    assert result.code == 3
    said = json.loads(result.out)
    assert said["verdict"] == "fault"
    assert said["faults"][0]["name"] == "leakage"
    assert "leakage" in (tmp_path / "r.html").read_text(encoding="utf-8")
    trace = pq.read_table(tmp_path / "t.parquet")
    assert trace.column_names[:2] == ["t", "theta_0"]
    assert trace.column_names[-3:] == ["statistic", "threshold", "level"]
    assert {"ifrf_1Hz_real", "ifrf_20Hz_imag"} <= set(trace.column_names)
    t, statistic, threshold, level = (
        trace.column(name).to_numpy() for name in ("t", "statistic", "threshold", "level")
    )
    first = t[np.argmax((statistic > threshold) | (level >= 1.0))]
    assert 0.0 <= first - said["detected_at_s"] < 0.1  # the sequential test speaks at once, its row comes 0.1 s later


def test_two_faults_at_once_are_told_with_why_and_beside_the_recursion(made: Path, tmp_path: Path) -> None:
    faults = ("--fault", "p_s=0.9@30", "--fault", "C_ie=1.2@30")
    assert run("simulate", made / "loop.toml", "-o", tmp_path / "x.csv", *faults, "--seed", 5).code == 0
    folded = run("diagnose", made / "baseline.json", tmp_path / "x.csv").out
    said = "Fault: pump or valve gain has fallen by a tenth and leakage has risen by a fifth"
    assert said in " ".join(folded.split()) and "--details" in folded and "What to check:" in folded
    assert "Refit beside recursion" not in folded and "misfit" not in folded.lower()
    result = run("diagnose", made / "baseline.json", tmp_path / "x.csv", "-v")
    lines = [" ".join(line.split()) for line in result.out.splitlines()]
    assert any(line.startswith("pump + leakage > 99.9 % p_s ×") for line in lines)
    assert "Why:" in lines and any(line.startswith("- Rejected: leakage (C_ie x 1.") for line in lines)
    text = " ".join(lines)
    assert "Refit beside recursion:" in lines and "Misfit, and the" in text and "unknown, > 99.9 %" in text
    assert max(map(len, result.out.splitlines())) <= 80


def test_the_exit_code_says_what_happened(made: Path, tmp_path: Path) -> None:
    baseline, healthy, suspect = (made / name for name in ("baseline.json", "healthy.csv", "suspect.csv"))
    missing = tmp_path / "missing.csv"
    assert run("diagnose", baseline, suspect).code == 3
    assert run("diagnose", baseline, suspect, "--fail-on-fault").code == 3, "as scripts for 1.0 call it"
    assert run("diagnose", baseline, healthy).code == 0
    assert run("diagnose", baseline, missing).code == 1
    assert run("diagnose", baseline, missing, suspect).code == 3
    assert run("diagnose", baseline).code == 2


def test_a_bad_file_does_not_stop_the_good_ones(made: Path, tmp_path: Path) -> None:
    paths = (tmp_path / "missing.csv", made / "healthy.csv", made / "suspect.csv")
    result = run("diagnose", made / "baseline.json", *paths, "--json")
    assert result.code == 3 and "missing.csv" in result.err and len(result.err.splitlines()) == 1
    said = [json.loads(line) for line in result.out.splitlines()]
    assert [(each["recording"], each["verdict"]) for each in said] == [
        ("healthy.csv", "healthy"),
        ("suspect.csv", "fault"),
    ]
    learned = run("learn", made / "loop.toml", *paths[:2], "-o", tmp_path / "b.json", "--json")
    one_line(learned, "missing.csv")
    assert [source["name"] for source in json.loads(learned.out)["sources"]] == ["healthy.csv"]
    assert run("inspect", *paths[:2], "--json").code == 1
    one_line(run("learn", made / "loop.toml", paths[0], "-o", tmp_path / "none.json"), "missing.csv")
    assert not (tmp_path / "none.json").exists()


def test_recordings_of_one_name_do_not_overwrite_each_other(made: Path, tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    twin = tmp_path / "a" / "healthy.csv"
    twin.write_bytes((made / "healthy.csv").read_bytes())
    outputs = ("--trace", tmp_path / "t.parquet", "--report", tmp_path / "pages")
    result = run("diagnose", made / "baseline.json", made / "healthy.csv", twin, *outputs)
    assert result.code == 0
    for name in ("t-healthy.parquet", "t-healthy-2.parquet", "pages/healthy.html", "pages/healthy-2.html"):
        assert (tmp_path / name).is_file()
        assert name.rpartition("/")[2] in result.out


def test_one_recording_per_value_of_a_column(made: Path, tmp_path: Path) -> None:
    rows = rows_of(made / "suspect.csv")
    part = np.where(rows["t"] < 30.0, 1, 2)
    path = write_rows(tmp_path / "x.csv", {**rows, "part": part})
    result = run("diagnose", made / "baseline.json", path, "--by", "part", "--json", "--trace", tmp_path / "t.parquet")
    said = [json.loads(line) for line in result.out.splitlines()]
    assert [(each["recording"], each["verdict"]) for each in said] == [
        ("x.csv[part=1]", "healthy"),
        ("x.csv[part=2]", "fault"),
    ]
    assert (tmp_path / "t-x-part-2.parquet").is_file()
    only = json.loads(run("diagnose", made / "baseline.json", path, "--where", "part=1", "--json").out)
    assert only["samples"] == 3000


def process(*words: object, **settings: Any) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": str(PROJECT / "src"), "COLUMNS": "80"}
    command = [sys.executable, "-m", "servoscope", *map(str, words)]
    return subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **settings
    )


def test_the_real_command_prints_pure_json(made: Path) -> None:
    done = process("diagnose", made / "baseline.json", made / "suspect.csv", "--json")
    out, err = done.communicate()
    assert done.returncode == 3
    assert err == ""
    assert json.loads(out)["verdict"] == "fault"


def test_help_and_version_start_fast_and_without_colour() -> None:
    helped = process("--help")
    out, err = helped.communicate()
    assert helped.returncode == 0
    assert err == ""
    assert "\x1b" not in out
    assert max(map(len, out.splitlines())) <= 80
    shown = process("--version")
    assert shown.communicate()[0] == f"servoscope {ss.__version__}\n"
    code = "import sys; import servoscope.cli; print(sorted(set(sys.modules) & {'numpy', 'numba', 'scipy', 'pyarrow'}))"
    environment = {**os.environ, "PYTHONPATH": str(PROJECT / "src")}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_stderr_that_is_no_terminal_says_now_and_then_what_goes_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "LINE_INTERVAL_S", 0.001)
    out = err = ""
    with progress.show_steps(1, 2) as steps:
        steps.begin("press.csv")
        steps.advance("recursion")
        while "press.csv: recursion, " not in err:
            time.sleep(0.001)
            said = capsys.readouterr()
            out, err = out + said.out, err + said.err
        steps.begin("day.csv")
        steps.count_rows("day.csv", 12_000, 0.4)
        assert steps.describe() == "day.csv: 12 000 rows, 40%"
        steps.count_rows("day.csv", 12_000, math.nan)
        assert steps.describe() == "day.csv: 12 000 rows"
    with progress.show_count() as show:
        show("items", 3, 40)
        while "items: 3 of 40, " not in err:
            time.sleep(0.001)
            err += capsys.readouterr().err
    capsys.readouterr()
    assert not out and not any("progress" in thread.name for thread in threading.enumerate())


def test_a_reader_that_leaves_is_no_error(made: Path) -> None:
    gone = process("inspect", made / "healthy.csv", "--json")
    assert gone.stdout is not None
    assert gone.stderr is not None
    gone.stdout.close()
    err = gone.stderr.read()
    gone.stderr.close()
    assert gone.wait() == 0
    assert err == ""


def test_a_full_disk_is_one_line(made: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("there is no full disk to write to")
    environment = {**os.environ, "PYTHONPATH": str(PROJECT / "src")}
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "servoscope", "inspect", str(made / "healthy.csv"), "--json"]
        done = subprocess.run(command, env=environment, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("servoscope: ")
