"""Other languages than English: complete, with the same fields, on the terminal, in reports and their pictures."""

from __future__ import annotations

import io
import re
import string
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import servoscope as ss
from golden.results import FOLDER
from servoscope.assessment.assess import assess
from servoscope.cli.render import history, results
from servoscope.cli.render.assessment import print_assessment
from servoscope.cli.render.diagnosis import print_diagnosis
from servoscope.cli.render.fleet import print_fleet
from servoscope.cli.service import COLUMNS
from servoscope.core import messages
from servoscope.core.messages import catalogue, languages, message, render, translate
from servoscope.diagnosis.diagnose import diagnose_with_trace
from servoscope.fleet.common_cause import Cause
from servoscope.fleet.report import render_fleet_page
from servoscope.fleet.summary import AssetSummary, Fleet
from servoscope.learning.inspection import inspect
from servoscope.models import plants
from servoscope.models.plants import axis
from servoscope.prognosis.forecast import prognose
from servoscope.prognosis.series import SizeSeries
from servoscope.report import diagnosis_page as report
from servoscope.report.document import DETAILS
from servoscope.report.inspection_page import render_inspection_page
from servoscope.service.assets.reception import Reception
from servoscope.service.commissioning import CommissioningRow

NOW = 1767225690.0
OPEN, CLOSE = "\N{MATHEMATICAL LEFT WHITE SQUARE BRACKET}", "\N{MATHEMATICAL RIGHT WHITE SQUARE BRACKET}"
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


def written_sentences(source: str) -> Iterator[str]:
    """Sentences and phrases that a module of the pages writes out, each value in them as 7."""
    source = re.sub(r"(^|\s)//.*$|class: \"[^\"]*\"", "", source, flags=re.M)
    source = re.sub(r"\$\{[^{}]*: \"s\"\}", "s", source)  # of a plural
    templates = re.compile(r"`((?:[^`\\]|\\.)*)`")
    texts = [re.sub(r"\$\{[^{}]*(\{[^{}]*\}[^{}]*)*\}", "7", text) for text in templates.findall(source)]
    texts += re.findall(r'"((?:[^"\\\n]|\\.)*)"', templates.sub("", source))
    code = re.compile(r"^(plot tall|servoscope run|color-mix|no such)|  # |\$\{")
    for words in (text.strip().removeprefix("*") for text in texts):
        if re.search(r"[a-z]{2,} [a-z]{2,}", words) and not code.search(words):
            yield words


@pytest.mark.parametrize("language", OTHERS)
def test_the_pages_write_no_sentence_that_the_catalogue_lacks(language: str) -> None:
    texts = [key.partition(".")[2] for key in catalogue(language) if key.startswith(("word.", "page."))]
    shapes = [re.compile(re.sub(r"\\{\d(\\#|!w)?\\}", ".*", re.escape(text))) for text in texts]

    def is_known(words: str) -> bool:
        own = re.escape(words).replace("7", ".*")  # a part of a sentence, or one whose value is a word
        small = words[:1].lower() + words[1:]
        return any(shape.fullmatch(words) or shape.fullmatch(small) for shape in shapes) or any(
            re.search(own, text) for text in texts
        )

    pages = sorted(Path(str(messages.FOLDER)).parents[1].glob("web/pages/*.js"))
    written = [(path.name, words) for path in pages for words in written_sentences(path.read_text(encoding="utf-8"))]
    assert len(written) > 200
    assert [(name, words) for name, words in written if not is_known(words)] == []


def outside_of_messages(text: str) -> str:
    """What of a text in the marked language no message and no word of the catalogue says."""
    depth, left = 0, list[str]()
    for letter in text:
        depth += (letter == OPEN) - (letter == CLOSE)
        left.append(letter if depth == 0 else " ")
    return "".join(left)


def add_marked_language(monkeypatch: pytest.MonkeyPatch) -> None:
    """Add the language zz, in which each message and each word stands between marks."""
    english = {key: text.replace("|", f"{CLOSE}|{OPEN}") if key.startswith("count.") else text
               for key, text in catalogue("en").items()}  # fmt: skip
    words = {key: key.partition(".")[2] for key in catalogue("de") if key.startswith("word.")}
    marked = {key: f"{OPEN}{text}{CLOSE}" for key, text in {**english, **words}.items()}
    monkeypatch.setattr(
        messages, "catalogue", lambda language="en": marked if language == "zz" else catalogue(language)
    )


STATUS = {
    "verdict": "fault", "since": NOW, "statistic": 2.0, "level": 0.5, "ne107": "failure", "counted": {"t": NOW},
    "alarms": {"data_quality": {"state": "returned_unacknowledged"}, "fault": {"state": "shelved"}},
    "residual": [(1.0, 1.0, 1.0, 2.0)], "summary": "",
}  # fmt: skip
FLOOD = {"service": True, "flood": {"since": NOW, "held": 2}, "alarms": {"buffering": {"state": "unacknowledged"}}}


def test_no_word_of_assess_trend_watch_history_and_arm_is_left_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    add_marked_language(monkeypatch)
    monkeypatch.setattr(messages, "LANGUAGE", "zz")
    terminal = io.StringIO()
    console = Console(file=terminal, width=250)
    statuses = {"P1": {"at": NOW, "status": STATUS}, "H": {"at": NOW, "status": FLOOD}}
    console.print(history.status_page(statuses, 250))
    heard = Reception("silent", "")
    console.print(history.commissioning_table([CommissioningRow("P1", "S", heard, 3, 100.0, 100.0, 2.0)]))
    for kind, columns in COLUMNS.items():
        row = dict.fromkeys(columns, "") | {"event": {}, "outcome": "", "document": {}}
        row |= {"what": "note", "after": "shelved", "grounds": "full", "t": NOW, "statistic": 1.0, "level": 1.0}
        assert kind
        console.print(history.row_table([row], columns))
    t = np.arange(0.0, 60.0, 0.1)
    for wave in (0.1 * np.sin(t), 0.0 * t):
        log = {"t": t, "r": np.ones_like(t), "u": 0.5 - wave, "y": 1.0 + wave}
        print_assessment(console, assess(log))
    months = 2.6e6 * np.arange(12.0)
    for growth in (0.02, 0.0):
        ratio = 1.0 + growth * np.arange(12.0)
        found = prognose(SizeSeries("P1", months, ratio, np.full(12, 0.01)), 2.0)
        console.print(found.summary, *found.explanation, sep="\n")
    assert len(terminal.getvalue()) > 2000
    left = sorted(set(re.findall(r"[a-z]{3,}", outside_of_messages(terminal.getvalue()))))
    left = [word for word in left if word not in ("arrays", "note")]
    assert " ".join(left) == ""


def test_no_sentence_is_left_outside_of_the_catalogue(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports and terminal, in a language made of the keys: each message and each word stands between marks."""
    add_marked_language(monkeypatch)
    baseline = ss.Baseline.load(FOLDER / "rig.json")
    recording = ss.read(FOLDER / "healthy.parquet", baseline.loop)
    # in English first: a template is compiled once, and its words must follow the reader all the same
    report.render_diagnosis_page(*diagnose_with_trace(baseline, recording), recording, baseline.loop, {})
    monkeypatch.setattr(messages, "LANGUAGE", "zz")
    baseline = baseline.model_copy(update={"notes": ()})  # kept as they were written
    terminal, pages = io.StringIO(), list[str]()
    console = Console(file=terminal, width=200)
    results.print_baseline(console, baseline)
    for name in ("healthy", "suspect"):
        recording = ss.read(FOLDER / f"{name}.parquet", baseline.loop)
        diagnosis, trace = diagnose_with_trace(baseline, recording)
        print_diagnosis(console, diagnosis, DETAILS)
        pages.append(report.render_diagnosis_page(diagnosis, trace, recording, baseline.loop, {}))
        inspection = inspect(recording, baseline.loop)
        results.print_inspection(console, inspection)
        pages.append(render_inspection_page(inspection, recording))
    settings = f"<style>.*?</style>|<svg.*?</svg>|<h2>{OPEN}Settings{CLOSE}</h2>.*?</section>|<[^>]*>"
    text = terminal.getvalue() + re.sub(settings, " ", "".join(pages), flags=re.S)
    data = {
        "healthy.parquet",
        "suspect.parquet",
        "healthy",
        "suspect",
        "parquet",
        "reference",
        "rig",
        "beta",
        "theta",
        "model",
        "error",
    }
    assert set(re.findall(r"[a-z]{3,}", outside_of_messages(text))) - data == set()


def test_no_word_of_a_fleet_is_left_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    add_marked_language(monkeypatch)
    monkeypatch.setattr(messages, "LANGUAGE", "zz")
    cause = Cause("K", "G", ("P1", "P2"), (0.5, 0.5), 0.99, "p_s", 0.9, 0.8, (0.7, 0.9))
    row = {"groups": {"K": "G"}, "probability": 0.9, "fault": "", "sure": 0.9, "since_us": 0, "said": ""}
    change = {"parameter": "p_s", "ratio": 0.8, "interval": (0.7, 0.9)}
    ill = [AssetSummary(asset=f"P{i}", day="D2", state="fault", before="healthy", **row, **change) for i in range(400)]
    states = {f"P{i}": {"D1": "healthy", "D2": "fault"} for i in range(400)}
    lost, names = (("P1", "D1", ""),), tuple(states)
    fleet = Fleet(tuple(ill), (cause,) * 4, ("D1",) * 4, states, lost, {"G": ""}, {"P1": 5}, names)
    terminal = io.StringIO()
    pages = []
    for shown in (fleet, Fleet((), (), (), {}, (), {}, {})):
        print_fleet(Console(file=terminal, width=250), shown)
        pages.append(render_fleet_page(shown, "L"))
    text = terminal.getvalue() + re.sub("<style>.*?</style>|<[^>]*>", " ", "".join(pages), flags=re.S)
    assert set(re.findall(r"[a-z]{3,}", outside_of_messages(text))) == set()


def visible(page: str) -> str:
    """The words of a page that are sentences and headings: neither settings nor identifiers."""
    page = re.sub(r"<style>.*?</style>|<h2>Einstellungen</h2>.*?</section>", " ", page, flags=re.S)
    return re.sub(r"<[^>]*>", " ", page).replace("reference rig", "")  # the name of the loop


def test_a_report_is_german_throughout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    baseline = ss.Baseline.load(FOLDER / "rig.json")
    recording = ss.read(FOLDER / "suspect.parquet", baseline.loop)
    ss.write_report(tmp_path / "english.html", baseline, recording)  # what a page leaves behind is not the next one's
    monkeypatch.setattr(messages, "LANGUAGE", "de")
    diagnosis = ss.write_report(tmp_path / "report.html", baseline, recording)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert '<html lang="de">' in page and "Fehler: die innere Leckage ist um ein Fünftel" in diagnosis.summary
    assert "<li>Kolbendichtung" in page and "Seit wann" in page and "Sollwert r" in page
    found = re.findall(ENGLISH, visible(page))
    assert found == []
    again = ss.Diagnosis.model_validate_json(diagnosis.model_dump_json())
    assert render(again.headline, "en").startswith(
        "Fault: leakage has risen by a fifth"
    )  # keys and values have no language


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
    assert done.returncode == 3 and done.stdout.index("zu prüfen") < done.stdout.index(
        "95-%-Intervall"
    ) < done.stdout.index("Warum")
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


def faults_of_kinds() -> Iterator[plants.Fault]:
    """All faults that the plants of this project know, in whatever form they are declared."""
    terms = list(axis.TERMS)
    rig = ss.Baseline.load(FOLDER / "rig.json").loop.plant
    yield from rig.faults
    for kept in (terms, [term for term in terms if term != "viscous_by_direction"]):
        named = [term for term in kept if term != "viscous" or "viscous_by_direction" not in kept]
        table = {"kind": "axis", "terms": named, "stribeck_speed": 1.0, "period": 1.0}
        for more in ({}, {"payload_arm": 1.0}):
            yield from plants.parse_plant(table | more).faults
    for friction in ("coulomb", "directional"):
        table = {"kind": "polynomial", "order": 2, "stiffness": True, "friction": friction, "offset": True}
        yield from plants.parse_plant(table).faults


@pytest.mark.parametrize("language", OTHERS)
def test_faults_of_plants_have_names_words_and_checks(language: str) -> None:
    faults = list(faults_of_kinds())
    known = catalogue(language)
    said = {text for fault in faults for text in (fault.name, fault.words.partition(" (")[0], fault.checks)}
    said |= {re.sub("^more ", "less ", text) for text in said}
    assert "" not in said and sorted(text for text in said if f"word.{text}" not in known) == []


@pytest.mark.parametrize("language", OTHERS)
def test_no_two_plants_translate_the_same_words_in_two_ways(language: str) -> None:
    words: dict[str, set[str]] = {}
    for kind in plants.plant_kinds():
        for english, text in plants.plant_class(kind).translations[language].items():
            words.setdefault(english, set()).add(text)
    assert [english for english, texts in words.items() if len(texts) > 1] == []


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
