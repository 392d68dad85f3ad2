"""Other languages than English: complete, with the same fields, on the terminal, in reports and their pictures."""

from __future__ import annotations

import re
import string
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import servoscope as ss
from golden.results import FOLDER
from servoscope.core import messages
from servoscope.core.messages import catalogue, languages, message, render, translate
from servoscope.models import plants

OTHERS = [name for name in languages() if name != "en"]
# English words that no text of another language has; symbols, file names and settings are English everywhere
ENGLISH = r"\b(the|and|with|from|recording|healthy|fault|reference|output|estimate|size|probability|since|none|of)\b"


def fields(template: str) -> Iterator[tuple[str, str]]:
    """The values that a template names, with the way in which numbers are written."""
    for _, name, spec, _ in string.Formatter().parse(template):
        if name is not None:
            yield name, "" if spec in messages.JOINS or spec == "capitalised" else spec or ""
            yield from fields(spec or "")


@pytest.mark.parametrize("language", OTHERS)
def test_a_language_says_all_that_english_says_with_the_same_values(language: str) -> None:
    english, other = catalogue("en"), catalogue(language)
    assert english.keys() == {key for key in other if not key.startswith(("word.", "page."))}
    differ = {key: language for key in english if sorted(set(fields(english[key]))) != sorted(set(fields(other[key])))}
    assert differ == {}


@pytest.mark.parametrize("language", OTHERS)
def test_what_pages_say_keeps_its_values(language: str) -> None:
    known = {key.removeprefix("page."): text for key, text in catalogue(language).items() if key.startswith("page.")}
    place = re.compile(r"\{\d")
    assert [one for one, text in known.items() if sorted(place.findall(one)) != sorted(place.findall(text))] == []


def visible(page: str) -> str:
    """The words of a page that are sentences and headings: neither settings nor identifiers."""
    page = re.sub(r"<style>.*?</style>|<div class=\"settings\">.*?</section>", " ", page, flags=re.S)
    return re.sub(r"<[^>]*>", " ", page).replace("reference rig", "")  # the name of the loop


def test_a_report_is_german_throughout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    baseline = ss.Baseline.load(FOLDER / "rig.json")
    recording = ss.read(FOLDER / "suspect.parquet", baseline.loop)
    ss.write_report(tmp_path / "english.html", baseline, recording)  # what a page leaves behind is not the next one's
    monkeypatch.setattr(messages, "LANGUAGE", "de")
    diagnosis = ss.write_report(tmp_path / "report.html", baseline, recording)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert '<html lang="de">' in page and "Fehler: innere Leckage. C_ie beträgt das 1.199" in diagnosis.summary
    assert " %): Kolbendichtung" in page and "Seit wann" in page and "Sollwert r" in page
    found = re.findall(ENGLISH, visible(page))
    assert found == []
    again = ss.Diagnosis.model_validate_json(diagnosis.model_dump_json())
    assert render(again.headline, "en").startswith("Fault: leakage. C_ie is 1.199")  # keys and values have no language


def test_the_terminal_is_german(tmp_path: Path) -> None:
    argv = [
        sys.executable,
        "-m",
        "servoscope",
        "--language",
        "de",
        "diagnose",
        "--details",
        FOLDER / "rig.json",
        FOLDER / "suspect.parquet",
    ]
    done = subprocess.run(argv, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode == 0 and done.stdout.index("zu prüfen") < done.stdout.index("Warum") < done.stdout.index(
        "95-%-Intervall"
    )
    assert re.findall(ENGLISH, done.stdout) == [], done.stdout
    refused = subprocess.run([*argv[:4], "tlh", "--version"], capture_output=True, text=True, check=False)
    assert refused.returncode == 2 and "choose from de, en" in re.sub(r"[\s│]+", " ", refused.stderr)


def test_words_keep_their_units_and_what_nobody_translated_stays() -> None:
    assert (
        translate("time [s]", "de") == "Zeit [s]"
        and translate("pump + leakage", "de") == "Pumpe oder Ventil + innere Leckage"
    )
    assert translate("sprocket", "de") == "sprocket" and translate("pump", "en") == "pump"
    assert render(message("diagnosis.candidate", names=("pump", "leakage"), probability=0.9), "de").startswith(
        "Pumpe oder"
    )


@pytest.mark.parametrize("language", OTHERS)
def test_faults_of_plants_have_names_and_checks(language: str) -> None:
    axis = plants.axis.FAULTS.values()
    names = [fault.name for fault in plants.eha.FAULTS] + [name for name, _ in axis]
    assert [
        name for name in names if f"word.{name}" not in catalogue(language) or f"check.{name}" not in catalogue()
    ] == []
    words = [one for _, what in axis for one in (what, what.replace("more ", "less ", 1))]
    assert [one for one in words if translate(one, language) == one] == []


def test_the_loop_file_says_what_to_check(tmp_path: Path) -> None:
    baseline = ss.Baseline.load(FOLDER / "rig.json")
    assert "checks" not in baseline.loop.to_dict()  # hashes of loops without it stay
    table = {"leakage": ["seal of cylinder 3", "drain line"], "pump": "pump P2"}
    loop = ss.Loop.from_dict(baseline.loop.to_dict() | {"checks": table})
    assert loop.checks == {"leakage": ("seal of cylinder 3", "drain line"), "pump": ("pump P2",)}
    assert ss.Loop.from_dict(loop.to_dict()) == loop
    own = baseline.model_copy(update={"loop": loop})
    found = ss.diagnose(own, ss.read(FOLDER / "suspect.parquet", loop))
    assert [str(each) for each in found.checks] == ["seal of cylinder 3", "drain line"]
