"""A baseline that is learned anew: more recordings, a repair, a slow fault that must not be learned, one step back."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from axis_logs import LOOP, axis
from commands import one_line, run

import servoscope as ss
from servoscope.baseline.comparison import compare_baselines
from servoscope.baseline.history import read_history, step_back
from servoscope.core.errors import BaselineError
from servoscope.signals import Recording
from servoscope.signals.writers import write_recording


def worn(seed: int, share: float) -> Recording:
    """Return the axis with an input that has to be larger by a share, as with a motor that has lost torque."""
    recording = axis(seed)
    return ss.Recording(**{**vars(recording), "u": recording.u * (1.0 + share)})


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("learned")
    for i in range(4):
        write_recording(folder / f"{i}.csv", axis(i))
    write_recording(folder / "worn.csv", worn(9, 0.3))
    ss.learn(LOOP, [folder / f"{i}.csv" for i in range(3)]).save(folder / "baseline.json")
    return folder


@pytest.fixture
def folder(learned: Path, tmp_path: Path) -> Path:
    for file in learned.iterdir():
        if file.is_file():
            (tmp_path / file.name).write_bytes(file.read_bytes())
    return tmp_path


def test_a_recording_joins_those_before_and_one_step_leads_back(folder: Path) -> None:
    path = folder / "baseline.json"
    first = ss.Baseline.load(path)
    added = run("learn", "--add", folder / "3.csv", "-b", path, "--why", "a week later", "--who", "miller")
    assert added.code == 0, added.err
    assert "coulomb_friction" in added.out
    second = ss.Baseline.load(path)
    assert [source.name for source in second.sources] == ["0.csv", "1.csv", "2.csv", "3.csv"]
    assert (second.revision.number, second.revision.kind, second.revision.who) == (2, "healthy", "miller")
    rows = json.loads(run("baseline", "log", path, "--json").out)
    assert [(row["number"], row["why"]) for row in rows] == [(1, ""), (2, "a week later")]
    assert "a week later" in run("baseline", "log", path).out
    assert run("baseline", "back", path, "--why", "not run in").code == 0
    restored = ss.Baseline.load(path)
    assert restored.hash == first.hash and restored.revision.kind == "back"
    assert list(read_history(path)) == [1, 2, 3]
    with pytest.raises(BaselineError, match="no earlier baseline"):
        step_back(path)


def test_a_fault_is_refused_with_the_finding(folder: Path) -> None:
    path = folder / "baseline.json"
    before = path.read_bytes()
    one_line(run("learn", "--add", folder / "worn.csv", "-b", path), "worn.csv", "not healthy", "--accept-change")
    assert path.read_bytes() == before and not (folder / "baseline.history").exists()


def test_after_a_repair_the_recordings_are_replaced_and_what_moved_is_named(folder: Path) -> None:
    path = folder / "baseline.json"
    answer = run("learn", "--add", folder / "worn.csv", "-b", path, "--after", "repair", "--why", "motor", "--json")
    document = json.loads(answer.out)
    moves = {row["name"]: row for row in document["points"][0]["moves"]}
    assert moves["inertia"]["certain"] and 0.2 < moves["inertia"]["change"] < 0.4
    renewed = ss.Baseline.load(path)
    assert [source.name for source in renewed.sources] == ["worn.csv"] and renewed.revision.reference == 2
    assert any("accepted as healthy" in str(note) for note in renewed.notes)
    differs = json.loads(run("baseline", "diff", folder / "baseline.history/000001.json", path, "--json").out)
    assert differs["points"] == document["points"]


def test_a_fault_of_one_percent_a_week_is_never_learned_away(folder: Path) -> None:
    """Each week's recording joins the baseline until one is refused; the reference stays the first baseline."""
    path, refused = folder / "baseline.json", None
    for week in range(1, 30, 3):
        write_recording(folder / f"week-{week}.csv", worn(100 + week, 0.01 * week))
        try:
            assert ss.relearn(path, [folder / f"week-{week}.csv"]).revision.reference == 1
        except BaselineError as error:
            refused = week, str(error)
            break
    assert refused is not None and "not healthy by the" in refused[1]
    smallest = min(change.change for change in read_history(path)[1].detectability.changes if change.change)
    assert refused[0] <= 100 * 3 * smallest  # of the input gain, 4.6 %


def test_a_recording_that_is_gone_is_named(folder: Path) -> None:
    path = folder / "baseline.json"
    (folder / "1.csv").unlink()
    one_line(run("learn", "--add", folder / "3.csv", "-b", path), "1.csv", "put it there")
    preview = ss.relearn(path, [folder / "3.csv"], leave_out=True, save=False)
    assert any("1.csv" in str(note) for note in preview.notes) and ss.Baseline.load(path).revision.number == 1


def test_recordings_that_are_long_together_are_found_again(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Week after week, also for a baseline of 1.0, which kept the samples that it learned from; not another file."""
    for module in ("operating_points", "relearn"):
        monkeypatch.setattr(f"servoscope.diagnosis.{module}.MAX_SAMPLES", 6_000)
    path = folder / "baseline.json"
    for week in range(2):
        write_recording(folder / f"week-{week}.csv", axis(20 + week))
        baseline = ss.relearn(path, [folder / f"week-{week}.csv"])
    assert [source.name for source in baseline.sources][3:] == [f"week-{week}.csv" for week in range(2)]
    assert all(source.samples == axis(0).samples and source.hash for source in baseline.sources)
    old = json.loads(path.read_text())
    for source in old["sources"]:
        del source["hash"]
        source["samples"] = 6_000 // len(old["sources"])
    path.write_text(json.dumps(old))
    write_recording(folder / "late.csv", axis(30))
    assert len(ss.relearn(path, [folder / "late.csv"]).sources) == 6
    write_recording(folder / "0.csv", axis(31))
    one_line(run("learn", "--add", folder / "3.csv", "-b", path), "0.csv", "put it there")


def test_options_that_do_not_go_together_are_refused(folder: Path) -> None:
    path = folder / "baseline.json"
    assert run("learn", "--add", folder / "3.csv").code == 2
    assert run("learn", folder / "3.csv").code == 2
    assert (
        run("learn", folder / "loop.toml", folder / "3.csv", "-o", folder / "new.json", "--after", "repair").code == 2
    )
    with pytest.raises(BaselineError, match="no operating point 'cold'"):
        ss.relearn(path, {"cold": [folder / "3.csv"]})


def test_baselines_of_different_plants_are_not_compared(folder: Path) -> None:
    one = ss.Baseline.load(folder / "baseline.json")
    with pytest.raises(BaselineError, match="nothing to compare"):
        compare_baselines(one, one.model_copy(update={"point": "cold"}))
