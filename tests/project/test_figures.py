"""Figures in documents stand between markers, and a page that says something else than was measured fails."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
from sources import load

PROJECT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def figures() -> ModuleType:
    return load(PROJECT / "scripts" / "figures.py")


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """Return a copy of the documents and of the stored results."""
    for name in ("README.md", "docs", "benchmarks/figures", "benchmarks/figures.toml", "benchmarks/RECORDINGS.md"):
        source, target = PROJECT / name, tmp_path / name
        target.parent.mkdir(parents=True, exist_ok=True)
        (shutil.copytree if source.is_dir() else shutil.copy)(source, target)
    return tmp_path


def test_every_page_says_what_was_measured(figures: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert figures.main([]) == 0, capsys.readouterr().out


def test_a_changed_number_is_found(figures: ModuleType, copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = copy / "docs" / "results.md"
    text = page.read_text(encoding="utf-8")
    begin = text.index("cranfield-40: 40.false -->") + len("cranfield-40: 40.false -->")
    page.write_text(text[:begin] + "5 of 5" + text[text.index("<!-- end -->", begin) :], encoding="utf-8")
    assert figures.main([], copy) == 1
    line = text.count("\n", 0, begin) + 1
    assert capsys.readouterr().out.startswith(f"docs/results.md:{line}: value cranfield-40: 40.false has '5 of 5'")


def test_a_changed_cell_of_a_table_is_found(figures: ModuleType, copy: Path) -> None:
    page = copy / "benchmarks" / "RECORDINGS.md"
    page.write_text(
        page.read_text(encoding="utf-8").replace("| viscous_friction | 203.5", "| viscous_friction | 204.5")
    )
    assert figures.main([], copy) == 1


def test_what_depends_on_the_machine_is_compared_in_form_only(figures: ModuleType, copy: Path) -> None:
    page = copy / "benchmarks" / "RECORDINGS.md"
    text = page.read_text(encoding="utf-8")
    row = next(line for line in text.splitlines() if line.startswith("| profile_healthy_1 "))
    slower = row.rsplit("|", 2)[0] + "| 99.99 s |"
    page.write_text(text.replace(row, slower), encoding="utf-8")
    assert figures.main([], copy) == 0
    page.write_text(text.replace(row, slower.replace(" s |", " minutes |")), encoding="utf-8")
    assert figures.main([], copy) == 1


def test_written_pages_agree(figures: ModuleType, copy: Path) -> None:
    stored = copy / "benchmarks" / "figures" / "cranfield-40.json"
    results = json.loads(stored.read_text(encoding="utf-8"))
    results["values"]["40.false"] = "4 of 5"
    stored.write_text(json.dumps(results), encoding="utf-8")
    assert figures.main([], copy) == 1
    assert [path.name for path in figures.write(copy, {"cranfield-40": results})] == ["results.md"]
    assert figures.main([], copy) == 0


def test_a_rate_has_its_interval(figures: ModuleType) -> None:
    """Ends after Clopper and Pearson (1934): 1 - 0.025^(1/n) where nothing was found in n."""
    assert figures.with_intervals("0 of 4; 10 of 10") == "0 of 4 (0\N{EN DASH}60 %); 10 of 10 (69\N{EN DASH}100 %)"
    assert round(100.0 * (1.0 - 0.025 ** (1.0 / 4.0))) == 60
    assert figures.with_intervals("6 of 300") == "6 of 300 (0.7\N{EN DASH}4 %)"
    assert figures.with_intervals("3 of 2; 0 of 0; runs 1 to 5") == "3 of 2; 0 of 0; runs 1 to 5"


@pytest.mark.parametrize(
    ("marker", "message"),
    [
        ("<!-- value nobody: x -->1<!-- end -->", "no program 'nobody' in benchmarks/figures.toml"),
        ("<!-- value recordings: nothing -->1<!-- end -->", "no value 'nothing'"),
        ("<!-- table recordings: Nothing -->1<!-- end -->", "no table 'Nothing'"),
    ],
)
def test_a_marker_of_nothing_is_one_line(
    figures: ModuleType, copy: Path, capsys: pytest.CaptureFixture[str], marker: str, message: str
) -> None:
    (copy / "docs" / "new.md").write_text(f"# New\n\n{marker}\n", encoding="utf-8")
    assert figures.main([], copy) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and told.startswith("docs/new.md:3: ") and message in told


def test_a_program_that_fails_is_one_line(figures: ModuleType, copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (copy / "benchmarks" / "figures.toml").write_text("[broken]\ncommand = \"-c 'raise SystemExit(3)'\"\n")
    assert figures.main(["--run"], copy) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("broken: `-c")


def test_programs_that_count_the_same_agree() -> None:
    """The ball screw at 40 kgf is counted by four programs: results of other days must not contradict each other."""
    stored = {
        name: json.loads((PROJECT / "benchmarks" / "figures" / f"{name}.json").read_text(encoding="utf-8"))
        for name in ("recordings", "settings", "cranfield", "cranfield-40")
    }

    def rows(program: str, title: str) -> dict[str, list[str]]:
        table = next(one for one in stored[program]["tables"] if one["title"] == title)
        return {row[0]: row[1:] for row in table["rows"]}

    load = rows("recordings", "Cranfield ball screw")["40 kgf"]
    dry = {
        "recordings": load[4].split(" (")[0],
        "settings": rows("settings", "Cutoff: Cranfield")["1 Hz"][1],
        **{name: stored[name]["values"]["40.lackLubrication1"] for name in ("cranfield", "cranfield-40")},
    }
    assert len(set(dry.values())) == 1, dry
    assert load[1] == stored["cranfield"]["values"]["40.false"] == stored["cranfield-40"]["values"]["40.false"]


def test_the_picture_of_the_benchmarks_is_that_of_the_stored_results(tmp_path: Path) -> None:
    drawn = tmp_path / "benchmarks.svg"
    command = [sys.executable, "benchmarks", "public/overview", "--picture", str(drawn)]
    subprocess.run(command, cwd=PROJECT, check=True, capture_output=True)
    assert drawn.read_text(encoding="utf-8") == (PROJECT / "docs" / "images" / "benchmarks.svg").read_text("utf-8")


@pytest.mark.slow
def test_quick_programs_print_what_the_pages_say(shared_data: Path) -> None:
    """Measured again, on this machine: an alarm more or less among five healthy runs would show."""
    done = subprocess.run(
        [sys.executable, "scripts/figures.py", "--quick"], cwd=PROJECT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_pictures_show_what_is_stored(tmp_path: Path) -> None:
    """Those of the demonstration and of pages are compared where tests make these."""
    pictures = load(PROJECT / "scripts" / "pictures.py")
    drawn = {name: pictures.shown_by_results(name) for name in pictures.pictures()}
    recorded = {name: entry["shows"] for name, entry in pictures.load().items()}
    assert recorded.keys() == drawn.keys()
    stale = [pictures.stale(name, shows or recorded[name]) for name, shows in drawn.items()]
    assert [why for why in stale if why] == []
    other = tmp_path / pictures.IMAGES
    shutil.copytree(PROJECT / pictures.IMAGES, other)
    assert "shows something older" in pictures.stale("report.png", "another report", tmp_path)
    (other / "report.png").write_bytes((other / "growth.png").read_bytes())
    assert "is not the recorded one" in pictures.stale("report.png", recorded["report.png"], tmp_path)


def test_the_same_page_has_the_same_hash_at_another_time() -> None:
    pictures = load(PROJECT / "scripts" / "pictures.py")
    assert pictures.shown_by_page(["Fleet", "Alarms 3"]) == pictures.shown_by_page(["Fleet", "Alarms 12"])
    assert pictures.shown_by_page(["Fleet", "Begin"]) != pictures.shown_by_page(["Fleet"])
    report = "<head><title>x</title></head><h1>Fault: <b>leakage</b></h1><svg>{}</svg>"
    assert pictures.shown_by_report(report.format(1)) == pictures.shown_by_report(report.format(2))
    assert pictures.shown_by_report(report) != pictures.shown_by_report(report.replace("leakage", "pump"))


MEASURED = ("README", "accuracy", "benchmarks", "fleet", "how-it-works", "nonlinear-rig", "paper", "reliability")
MEASURED = (*MEASURED, "before-deployment", "results", "speed")
DATE = re.compile(r"[Mm]easured\W+(?:on )?20\d\d-\d\d-\d\d, commit `[0-9a-f]{7}`|Estimate|one run of \w+ 20\d\d")
NO_MEASUREMENTS = ("paper.md: ## Where each equation is", "nonlinear-rig.md: ## Simulation")
FIGURE = re.compile(r"(?<![\w`])\d+(?:\.\d+)?")


def test_a_table_of_measured_figures_has_a_program_or_a_date() -> None:
    """Between markers, or in a section that says when it was measured: not everything can be measured again in CI."""
    undated = []
    for page in [PROJECT / "README.md", *(PROJECT / "docs").rglob("*.md")]:
        text = page.read_text(encoding="utf-8")
        for section in re.split(r"^(?=#+ )", text, flags=re.M) if page.stem in MEASURED else ():
            own = re.sub(r"<!-- table .*?<!-- end -->|`[^`]*`|\]\([^)]*\)", "", section, flags=re.S)
            rows = [line for line in own.splitlines() if line.startswith("|") and "<!-- value" not in line]
            if sum(bool(FIGURE.search(row)) for row in rows) > 2 and not DATE.search(section):
                undated.append(f"{page.name}: {section.splitlines()[0]}")
    assert set(undated) == set(NO_MEASUREMENTS)
